"""What a builder has been told of bodies, checked, in NumPy float64; checks of numbers, flags and handles."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from jax import Array

from mathota_jax.geometry import Compound, Shape
from mathota_jax.geometry.inertia import principal_axes

UNTURNED = np.asarray([1.0, 0.0, 0.0, 0.0])


@dataclasses.dataclass
class Body:
    """A body; `position` is that of its centre of mass, which lies at `center` in the body frame.

    `inertia` holds the principal moments, `inertia_frame` the principal axes in the body frame (quaternion).
    """

    name: str
    shape: Shape | Compound
    static: bool
    collides: bool
    mass: float
    inertia: np.ndarray
    inertia_frame: np.ndarray
    center: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    friction: float
    restitution: float


def mass_properties(
    label: str, shape: Shape | Compound, mass: float | None, density: float | None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, principal moments and principal axes (quaternion) of a body that moves."""
    if (mass is None) == (density is None):
        raise ValueError(f"{label}: give exactly one of mass and density (or static=True)")
    key, value = ("mass", mass) if density is None else ("density", density)
    given = positive(f"{label}: {key}", value)
    properties = shape.mass_properties()
    total = given if density is None else given * float(properties.volume)
    moments, frame = principal_axes(np.asarray(properties.unit_inertia))
    return total, total * moments, frame


def number(label: str, value: Any, lower: float, upper: float) -> float:
    """A finite number within bounds."""
    is_number = (
        np.ndim(value) == 0 and isinstance(value, int | float | np.number | Array) and not isinstance(value, bool)
    )
    found = float(value) if is_number else math.nan
    if not math.isfinite(found) or not lower <= found <= upper:
        bounds = f"between {lower:g} and {upper:g}" if math.isfinite(upper) else f"of at least {lower:g}"
        bounds = "" if math.isinf(lower) else f" {bounds}"
        raise ValueError(f"{label} must be a finite number{bounds}, got {value!r}")
    return found


def positive(label: str, value: Any) -> float:
    """A finite number above 0."""
    found = number(label, value, -math.inf, math.inf)
    if found <= 0:
        raise ValueError(f"{label} must be positive, got {found:g}")
    return found


def boolean(label: str, value: Any) -> bool:
    """True or False."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{label} must be True or False, got {value!r}")
    return bool(value)


def look_up(label: str, handle: Any, names: list[str], noun: str) -> int:
    """Index of what a handle or a name stands for."""
    known = ", ".join(f"{index} '{name}'" for index, name in enumerate(names)) or "none yet"
    if isinstance(handle, str):
        if handle not in names:
            raise ValueError(f"{label}: no {noun} is called '{handle}'; known: {known}")
        return names.index(handle)
    if not isinstance(handle, int | np.integer) or isinstance(handle, bool) or not 0 <= handle < len(names):
        raise ValueError(f"{label}: no {noun} has the handle {handle!r}; known: {known}")
    return int(handle)


def look_up_all(label: str, handles: Any, names: list[str], noun: str) -> list[int]:
    """Indices of what one handle or name, or a sequence of them, stands for."""
    if isinstance(handles, str) or not isinstance(handles, Iterable):
        handles = [handles]
    return [look_up(label, handle, names, noun) for handle in handles]
