"""Settings that several test files share."""

from collections.abc import Collection, Iterable

import pytest

QUICK_AND_SLOW_PRECISION = ["float32", pytest.param("float64", marks=pytest.mark.slow)]
"""Values of the fixture `precision` for tests that take long in each."""

QUICK_IN_FLOAT64 = [pytest.param("float32", marks=pytest.mark.slow), "float64"]
"""The same where derivatives are compared more closely than float32 allows."""

QUICK_COMPILER = "--xla_cpu_use_fusion_emitters=false --xla_backend_extra_options=xla_cpu_disable_loop_unrolling"
"""XLA's older code generator: 0.5 to 0.7 of the compile time, which is most of the suite's; runs 0.8 to 1.5 times as long.
Without unrolled loops it takes another 0.7 of that for batches; they run 0.9 to 1.2 times as long.

Programs differ by round-off.
"""


def slow_but(quick: Collection[str], names: Iterable[str]) -> list:
    """All names; those that are not `quick` compile a program much like one that is."""
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in names]
