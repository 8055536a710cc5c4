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


def finite_array(name: str, value: Any) -> np.ndarray:
    """Returns `value` as a float64 array of any shape.

    Raises:
        ValueError: if it is not an array of finite numbers; the message says where the first bad one stands.
    """
    array = _floats(name, value)
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        place = tuple(int(index) for index in bad[0])
        raise ValueError(f"{name} must be finite, got {array[place]} at {place}")
    return array


def unit_quaternion(name: str, value: Any) -> np.ndarray:
    """Returns `value` as a normalised float64 quaternion (w, x, y, z).

    Raises:
        ValueError: if it is not four finite numbers, not all zero.
    """
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (4,) or not np.all(np.isfinite(array)) or not np.any(array):
        raise ValueError(f"{name} must be a finite, nonzero quaternion (w, x, y, z), got {value!r}")
    return array / np.linalg.norm(array)


def _floats(name: str, value: Any) -> np.ndarray:
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numeric, got {value!r}") from error
