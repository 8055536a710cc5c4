"""Tests that only `make test-slow` runs because they compile for long and the quick suite has one much like them."""

from __future__ import annotations

IN_FLOAT32 = (
    "tests/physics/test_general_shapes.py",
    "tests/physics/test_joint_drives.py",
    "tests/physics/test_joint_kinds.py",
    "tests/physics/test_joints.py",
    "tests/physics/test_stack.py",
    "tests/physics/test_warm_start.py",
    "tests/stability/test_bad_worlds.py",
    "tests/unit/test_broadphase.py",
)
"""Files whose tests with the fixture `precision` are quick in float32 alone, which is what users run."""

OTHER_PRECISION = "the other precision"

LONG_COMPILES: dict[str, str] = {
    "tests/gradients/test_collision_impulse.py::test_rod_struck_off_centre[float32]": OTHER_PRECISION,
    "tests/gradients/test_known_forces.py::test_derivatives_are_those_of_a_step_that_solves_again[damped chain]": "chain",
    "tests/gradients/test_known_forces.py::test_derivatives_are_those_of_a_step_that_solves_again[listed pairs]": "stack",
    "tests/gradients/test_known_forces.py::test_forward_mode_in_worlds_that_share_the_motion": "single worlds",
    "tests/gradients/test_known_forces.py::test_second_derivatives_through_a_joint": "second derivatives of a shortcut",
    "tests/gradients/test_long_rollout.py::test_same_values_and_gradients_as_rollout[float32-100]": OTHER_PRECISION,
    "tests/gradients/test_long_rollout.py::test_same_values_and_gradients_as_rollout[float32-7]": OTHER_PRECISION,
    "tests/gradients/test_long_rollout.py::test_same_values_and_gradients_as_rollout[float32-None]": OTHER_PRECISION,
    "tests/gradients/test_loop_gradient.py::test_forward_mode_is_reverse_mode": "reverse mode",
    "tests/gradients/test_loop_gradient.py::test_no_derivative_is_nan": "derivatives by some leaves",
    "tests/gradients/test_slide_gradient.py::test_forward_mode_equals_reverse_mode": "forward mode of other scenes",
    "tests/gradients/test_small_steps.py::test_a_pendulum_by_its_parameters": "derivatives of a slide by small steps",
    "tests/gradients/test_small_steps.py::test_central_differences": "derivatives of a slide by small steps",
    "tests/gradients/test_stick_slip.py::test_at_the_threshold_the_derivative_is_a_sub_gradient[float64]": OTHER_PRECISION,
    "tests/physics/test_chain.py::test_chain_with_a_heavy_end[float64]": OTHER_PRECISION,
    "tests/physics/test_chain.py::test_four_bar_loop": "the linkage of test_loops",
    "tests/physics/test_converged.py::test_heavy_cube_on_a_light_one[float64-0.001]": OTHER_PRECISION,
    "tests/physics/test_fast_bodies.py::test_a_jointed_pair_that_hits_a_wall_gains_no_energy[continuous]": "[default]",
    "tests/physics/test_fast_bodies.py::test_a_jointed_pair_that_hits_a_wall_gains_no_energy[soft_step]": "[default]",
    "tests/physics/test_fast_bodies.py::test_a_spinning_plank_gains_no_energy[0.3-0.5]": "without friction",
    "tests/physics/test_hard_scenes.py::test_gates_in_a_short_run[B7b bridge of 160 links-pgs-3.5]": "shorter loops",
    "tests/physics/test_loops.py::test_a_frame_slides_over_a_plane[pgs]": "the linkage",
    "tests/physics/test_loops.py::test_a_free_ring_keeps_its_momenta": "the linkage",
    "tests/physics/test_loops.py::test_catenary": "the linkage",
    "tests/physics/test_many_bodies.py::test_cloud_conserves_momentum_and_does_not_gain_energy[float64-64]": OTHER_PRECISION,
    "tests/physics/test_mechanism_steps.py::test_a_loop_with_too_many_joints_stays_finite[float32-hinge twice]": "linkage "
    "and rod",
    "tests/physics/test_mechanisms.py::test_a_chain_that_starts_open_is_closed_and_not_whipped[float64]": OTHER_PRECISION,
    "tests/physics/test_neutral.py::test_zero_friction_equals_no_friction[float32]": OTHER_PRECISION,
    "tests/physics/test_soft_step.py::test_gradient_through_the_broadphase": "the gradient with the default solver",
    "tests/physics/test_soft_step.py::test_sleep_fast_bodies_and_a_step_of_no_time": "the default solver",
    "tests/physics/test_soft_step.py::test_springs_and_servos_of_any_stiffness_come_to_rest": "the default solver",
    "tests/stability/test_scale.py::test_penetration_scales_with_size[float32-cards-dt unchanged, gravity scaled]": "stack",
    "tests/training/test_cube_toss.py::test_whole_motions_show_friction_restitution_and_inertia": "fits of first impacts",
    "tests/unit/test_batching.py::test_jacobians[jacrev(vmap)]": "gradients against finite differences",
    "tests/unit/test_batching.py::test_jacobians[vmap(jacfwd)]": "jacrev(vmap)",
}
"""Each with what of it the quick suite keeps. A single parameter of a test whose others stay quick has its brackets."""
