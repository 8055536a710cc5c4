"""Gates that are not met yet: tests that run and must fail, each with what was measured and why.

A test that starts to pass fails the suite (strict xfail), so that its entry is removed the same day.
"""

from __future__ import annotations

EVENTS = "contacts are taken at the start of the step, not at the time of impact, and one impact is resolved per step; "
SWEEPS = "not converged with the default 10 sweeps; "

SHORTFALLS: dict[str, str] = {
    "tests/physics/test_soft_step.py::test_chain_holds[10]": "the whip of the free end opens a joint by 1.41 % of a link "
    "for one step of 600, gate 1 %",
    "tests/physics/test_soft_step.py::test_third_apex_of_a_dropped_sphere": "the impulse of an impact starts the next "
    "substep too, and the ball sinks by up to 0.07 mm: at e = 0.25 the third apex, 0.24 mm high, is 1.5 % off, gate 1 %",
    "tests/gradients/test_stick_slip.py::test_both_sides_of_the_threshold[float64]": SWEEPS
    + "dv/dF of a slipping box is 0.36 % off, gate 0.1 %",
    "tests/physics/test_billiards.py::test_oblique_collision": EVENTS + "positions 6.6e-3 m off at dt 1/240, gate 1e-3",
    "tests/physics/test_billiards.py::test_cradle_passes_the_whole_velocity_on": EVENTS
    + "the last ball leaves with 0.71 of the velocity, gate 0.999",
    "tests/physics/test_momentum.py::test_collisions_keep_the_invariants": EVENTS
    + "angular momentum 0.013 to 0.025 kg m^2/s off, gate 1e-9",
    "tests/physics/test_joints.py::test_hinge_limits_hold[float32-1.0]": SWEEPS
    + "joint gap 5.6e-3 of the arm, gate 5e-3",
    "tests/physics/test_joints.py::test_hinge_limits_hold[float64-1.0]": SWEEPS
    + "joint gap 5.6e-3 of the arm, gate 5e-3",
    "tests/physics/test_joints.py::test_double_pendulum_keeps_its_joints_closed[float32]": SWEEPS
    + "a link ten times as heavy as the one that holds it makes the world diverge after 640 steps",
    "tests/envs/test_ball_balance.py::test_gimbal_holds_the_plate": SWEEPS
    + "the plate turns 1.27e-4 rad out of its gimbal, gate 1e-4, since damping is of second order and takes less energy",
    "tests/unit/test_state.py::test_nothing_assumes_an_up_axis": "the order of the sweeps follows the axes of the tangents: "
    "3e-6 to 3e-5 rad/s apart after the impact of a box, gate 1e-6",
    "tests/physics/test_stack.py::test_ten_boxes_stand": "the stack dips 2.3 mm while the first sweeps start from nothing, "
    "then stands 0.5 mm below its start (see test_ten_boxes_stay_in_place), gate 1 mm at any time",
    "tests/physics/test_warm_start.py::test_order_of_the_bodies_does_not_matter": SWEEPS
    + "positions differ by 0.03 to 0.7 m after a pile has settled, gate 1e-4",
}

# Limits in CPU seconds, which depend on the machine: a pass is welcome and does not fail the suite.
TIMINGS: dict[str, str] = {
    "tests/compile/test_compile_time.py::test_compile_time_of_a_step[1-2.0]": "3 to 4 CPU-s measured, most of it in XLA's "
    "code generation of 150 kernels, target 2",
    "tests/compile/test_compile_time.py::test_compile_time_of_a_step[10-6.0]": "11 to 13 CPU-s measured, target 6",
}
