"""Argument checks shared by the shapes. Build-time code on NumPy values."""

from typing import Any

import numpy as np


def positive_number(name: str, value: Any) -> np.ndarray:
    """Returns `value` as a float64 scalar array.

    Raises:
        ValueError: if it is not one positive finite number.
    """
    number = _floats(name, value)
    if number.shape != () or not np.isfinite(number) or number <= 0:
        raise ValueError(f"{name} must be a positive finite number, got {value!r}")
    return number


def finite_number(name: str, value: Any) -> np.ndarray:
    """Returns `value` as a float64 scalar array.

    Raises:
        ValueError: if it is not one finite number.
    """
    number = _floats(name, value)
    if number.shape != () or not np.isfinite(number):
        raise ValueError(f"{name} must be a finite number, got {value!r}")
    return number


def finite_vector(name: str, value: Any) -> np.ndarray:
    """Returns `value` as a float64 array of shape ``(3,)``.

    Raises:
        ValueError: if it is not three finite numbers.
    """
    vector = _floats(name, value)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise ValueError(f"{name} must be three finite numbers, got {value!r}")
    return vector


def _floats(name: str, value: Any) -> np.ndarray:
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numeric, got {value!r}") from error
