"""What a builder has been told, checked: bodies, joints and motors, in NumPy float64."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from jax import Array

from mathota_jax.geometry import Compound, Shape
from mathota_jax.geometry.inertia import principal_axes

OUT_OF_REACH = 1e9
"""Joint limit [m] that stands for none."""

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


@dataclasses.dataclass
class Joint:
    """A joint; anchors from the centres of mass and frames in the body frames."""

    name: str
    kind: str
    parent: int
    child: int
    anchor_parent: np.ndarray
    anchor_child: np.ndarray
    frame_parent: np.ndarray
    frame_child: np.ndarray
    limits: np.ndarray | None
    damping: float


@dataclasses.dataclass
class Motor:
    """A motor on the free coordinate of a joint."""

    joint: int
    limit: float
    gear: float


def mass_properties(
    label: str, shape: Shape | Compound, mass: float | None, density: float | None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, principal moments and principal axes (quaternion) of a body that moves."""
    if (mass is None) == (density is None):
        raise ValueError(f"{label}: give exactly one of mass and density (or static=True)")
    key, value = ("mass", mass) if density is None else ("density", density)
    given = number(f"{label}: {key}", value, 0.0, math.inf)
    if given == 0:
        raise ValueError(f"{label}: {key} must be positive, got 0")
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


def boolean(label: str, value: Any) -> bool:
    """True or False."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{label} must be True or False, got {value!r}")
    return bool(value)


def limits(label: str, value: Any, angular: bool) -> np.ndarray | None:
    """Lower and upper limit of a joint, or None."""
    if value is None:
        return None
    try:
        pair = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        pair = np.zeros(0)
    if pair.shape != (2,) or np.any(np.isnan(pair)):
        raise ValueError(f"{label}: limits must be a pair (lower, upper) of numbers, got {value!r}")
    if pair[0] > pair[1]:
        raise ValueError(f"{label}: lower limit {pair[0]:g} is larger than upper limit {pair[1]:g}; swap them")
    if angular and (pair[0] < -math.pi or pair[1] > math.pi):
        raise ValueError(f"{label}: limits of a hinge must lie between -pi and pi rad, got {value!r}")
    # An open side becomes a stop out of reach: an infinite error would turn into NaN in derivatives.
    return np.clip(pair, -OUT_OF_REACH, OUT_OF_REACH)


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
