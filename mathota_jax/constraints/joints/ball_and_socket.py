"""Ball and socket: all relative rotation is free (guide 9.3)."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
from jax import Array

from mathota_jax.constraints.joints.frames import JointFrames, twist
from mathota_jax.constraints.joints.kind import Coordinate, JointKind
from mathota_jax.constraints.joints.rows import STOP, JointRow, Sides, point_rows, rotation_sides
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.vector import cross, dot, norm, where


@dataclasses.dataclass(frozen=True)
class BallAndSocket:
    """Joint that holds one point of each body together, such as a shoulder.

    The coordinate is the twist: the angle about the axis that is left of the relative rotation when the child's axis has
    been swung back, the shortest way, onto the parent's.

    Args:
      parent, child: handles or names of the two bodies; the parent may be static.
      anchor: (3,) common point [m], world frame at build time.
      axis: (3,) direction that `swing` and `twist` refer to, world frame at build time; need not be a unit vector. None
        if there are no such limits.
      swing: largest angle between the child's axis and the parent's [rad], between 0 and pi; None for no limit.
      twist: smallest and largest twist [rad], between -pi and pi, infinite for an open side; None for no limits.
      damping: viscous coefficient about every axis [N m s/rad].
      friction: dry friction about each of the three axes of the parent's joint frame [N m].
    """

    parent: Any
    child: Any
    anchor: Any
    axis: Any = None
    swing: float | None = None
    twist: Any = None
    damping: float = 0.0
    friction: float = 0.0


def twist_sides(frames: JointFrames) -> Sides:
    """Jacobian of the twist: ``(a + b) / (1 + a . b)`` for the axes a and b, along their bisector."""
    parent, child = frames.parent.column_x, frames.child.column_x
    # Half a turn of swing leaves the twist undefined; the Jacobian stays bounded.
    scale = 1.0 / jnp.maximum(1.0 + dot(parent, child), 1e-3)
    return rotation_sides((parent + child) * scale)


def rotation_axes(frames: JointFrames) -> list[Sides]:
    """Jacobians of the rotations about the parent's three axes."""
    return [rotation_sides(column) for column in frames.parent]


def swing_row(frames: JointFrames, limit: Array) -> JointRow:
    """Keeps the angle between the axes below the half angle of the cone."""
    parent, child = frames.parent.column_x, frames.child.column_x
    normal = cross(parent, child)
    sine = norm(normal)
    inverse = safe_divide(jnp.ones_like(sine), sine)
    # Where the axes agree the swing has no direction, and any will do: the stop is far.
    direction = where(inverse > 0, normal * inverse, frames.parent.column_y)
    angle = jnp.arctan2(sine, dot(parent, child))
    return JointRow(*rotation_sides(-direction), limit - angle, STOP)


KIND = JointKind(
    BallAndSocket,
    point_rows,
    3,
    3,
    Coordinate(twist, twist_sides, angular=True),
    rotation_axes,
    3,
    swing_row,
)
