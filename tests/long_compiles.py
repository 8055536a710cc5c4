"""Tests that only `make test-slow` runs because they compile for long and the quick suite has one much like them.

Each with what of it the quick suite keeps. A single parameter of a test whose others stay quick is named with its brackets.
"""

from __future__ import annotations

OTHER_PRECISION = "the other precision"

LONG_COMPILES: dict[str, str] = {
    "tests/gradients/test_collision_impulse.py::test_rod_struck_off_centre[float32]": OTHER_PRECISION,
    "tests/gradients/test_known_forces.py::test_derivatives_are_those_of_a_step_that_solves_again[damped chain]": "chain",
    "tests/gradients/test_known_forces.py::test_forward_mode_in_worlds_that_share_the_motion[damped chain]": "chain",
    "tests/gradients/test_known_forces.py::test_second_derivatives_through_a_joint": "second derivatives of a shortcut",
    "tests/gradients/test_long_rollout.py::test_same_values_and_gradients_as_rollout[float32-7]": OTHER_PRECISION,
    "tests/gradients/test_long_rollout.py::test_same_values_and_gradients_as_rollout[float32-100]": OTHER_PRECISION,
    "tests/gradients/test_long_rollout.py::test_same_values_and_gradients_as_rollout[float32-None]": OTHER_PRECISION,
    "tests/gradients/test_loop_gradient.py::test_forward_mode_is_reverse_mode": "reverse mode",
    "tests/gradients/test_loop_gradient.py::test_no_derivative_is_nan": "derivatives by some leaves",
    "tests/gradients/test_small_steps.py::test_a_pendulum_by_its_parameters": "derivatives of a slide by small steps",
    "tests/gradients/test_small_steps.py::test_central_differences": "derivatives of a slide by small steps",
    "tests/gradients/test_stick_slip.py::test_at_the_threshold_the_derivative_is_a_sub_gradient[float64]": OTHER_PRECISION,
    "tests/physics/test_chain.py::test_four_bar_loop": "the linkage of test_loops",
    "tests/physics/test_chain.py::test_chain_with_a_heavy_end[float64]": OTHER_PRECISION,
    "tests/physics/test_converged.py::test_heavy_cube_on_a_light_one[float64-0.001]": OTHER_PRECISION,
    "tests/physics/test_joints.py::test_damping_decays_at_its_rate[float32]": OTHER_PRECISION,
    "tests/physics/test_joints.py::test_double_pendulum_keeps_its_joints_closed[float64]": OTHER_PRECISION,
    "tests/physics/test_joints.py::test_joint_and_motor_act_with_equal_reaction[float64-Hinge-torque]": OTHER_PRECISION,
    "tests/physics/test_joints.py::test_joint_and_motor_act_with_equal_reaction[float32-Slider-torque]": OTHER_PRECISION,
    "tests/physics/test_loops.py::test_a_free_ring_keeps_its_momenta": "the linkage and the catenary",
    "tests/physics/test_loops.py::test_catenary[float64]": OTHER_PRECISION,
    "tests/physics/test_mechanism_steps.py::test_a_loop_with_too_many_joints_stays_finite[float32-hinge twice]": "linkage "
    "and rod",
    "tests/physics/test_mechanisms.py::test_a_chain_that_starts_open_is_closed_and_not_whipped[float64]": OTHER_PRECISION,
    "tests/physics/test_neutral.py::test_zero_friction_equals_no_friction[float32]": OTHER_PRECISION,
}
