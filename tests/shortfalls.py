"""Gates that are not met yet: tests that run and must fail, each with what was measured and why.

A test that starts to pass fails the suite (strict xfail), so that its entry is removed the same day.
"""

from __future__ import annotations

SHORTFALLS: dict[str, str] = {
    **{
        f"tests/stability/test_bad_worlds.py::test_time_steps_out_of_all_proportion[{scene}-{precision}]": f"two boxes "
        f"{what}, at rest to a micrometre, gain {gain} times the energy of a lift, gate 0.01; none in steps up to 1 s, "
        "and boxes none with the converged solver"
        for scene, precision, what, gain in (
            ("10 and 100 s", "float32", "with a pendulum on one", 537),
            ("10 and 100 s", "float64", "with a pendulum on one", 727),
            ("no joint, 30 and 100 s", "float32", "beside one that falls", 1355),
            ("no joint, 30 and 100 s", "float64", "beside one that falls", 516),
        )
    },
    "tests/unit/test_convex.py::test_many_random_poses[float64-cone_cone]": "one of 952 poses, half overlapped, ends in a "
    "local minimum of the depth 4.3e-3 of the size too deep (flagged, as 2 % of the deep ones are); in float32 none",
}

# Limits in CPU seconds, which depend on the machine: a pass is welcome and does not fail the suite.
TIMINGS: dict[str, str] = {
    f"tests/compile/test_compile_time.py::test_compile_time_of_a_step[{case}]": reason
    for case, reason in {
        "1-2.0-default": "3 to 4 CPU-s measured, most of it in XLA's code generation of 130 kernels, target 2",
        "1-2.0-quick": "1.8 to 1.9 CPU-s measured on a quiet machine, more on a busy one, target 2",
        "10-6.0-default": "8.5 CPU-s measured on a quiet machine (5.6 s of wall time on two cores), target 6",
        "10-6.0-quick": "8 to 10 CPU-s measured on a busy machine, target 6",
    }.items()
}
