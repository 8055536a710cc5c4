"""Parametrisations that several test files share."""

import pytest

QUICK_AND_SLOW_PRECISION = ["float32", pytest.param("float64", marks=pytest.mark.slow)]
"""Values of the fixture `precision` for tests that take long in each."""
