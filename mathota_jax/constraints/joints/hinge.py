"""Hinge: one relative rotation is free (guide 9.3 and 9.4)."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
from jax import Array

from mathota_jax.constraints.assembly import Side
from mathota_jax.constraints.joints.frames import (
    JointFrames,
    JointRow,
    axis_row,
    rotation_sides,
    translation_row,
)


@dataclasses.dataclass(frozen=True)
class Hinge:
    """Joint that leaves a rotation about one axis free.

    Args:
      parent, child: handles or names of the two bodies; the parent may be static.
      anchor: (3,) point on the axis [m], world frame at build time.
      axis: (3,) direction of the axis, world frame at build time; need not be a unit vector.
      limits: smallest and largest angle [rad] from the built pose, between -pi and pi; None for no limits.
      damping: viscous coefficient [N m s/rad].
    """

    parent: Any
    child: Any
    anchor: Any
    axis: Any
    limits: Any = None
    damping: float = 0.0


def fixed_rows(frames: JointFrames) -> list[JointRow]:
    """Three rows hold the anchors together, two the axes parallel."""
    points = [translation_row(frames, direction) for direction in frames.parent]
    return [*points, axis_row(frames, frames.parent.column_y), axis_row(frames, frames.parent.column_z)]


def free_sides(frames: JointFrames) -> tuple[Side, Side]:
    """Jacobian of the angle."""
    return rotation_sides(frames.parent.column_x)


def coordinate(frames: JointFrames) -> Array:
    """Angle of the child about the axis [rad], in (-pi, pi]."""
    relative = frames.relative
    sign = jnp.where(relative.w < 0, -1.0, 1.0)
    return 2.0 * jnp.arctan2(relative.x * sign, relative.w * sign)
