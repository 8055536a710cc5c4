"""Settings that several test files share."""

import pytest

QUICK_AND_SLOW_PRECISION = ["float32", pytest.param("float64", marks=pytest.mark.slow)]
"""Values of the fixture `precision` for tests that take long in each."""

QUICK_COMPILER = "--xla_cpu_use_fusion_emitters=false"
"""XLA's older code generator: 0.5 to 0.7 of the compile time, which is most of the suite's; runs 0.8 to 1.5 times as long.

Programs differ by round-off.
"""
