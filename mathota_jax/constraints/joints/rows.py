"""Rows of joints: their Jacobians, and which law each obeys."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mathota_jax.constraints.assembly import Side
from mathota_jax.constraints.joints.frames import JointFrames
from mathota_jax.spatial.vector import Vec3, cross, dot

HOLD, STOP, VISCOUS, ELASTIC, DRY, DRIVE, SERVO = "hold", "stop", "viscous", "elastic", "dry", "drive", "servo"
"""Laws of rows, see `row_laws`."""

Sides = tuple[Side, Side]


class JointRow(NamedTuple):
    """One row of each joint of a group.

    Attributes:
      parent, child: Jacobians.
      error: what the law acts on [m] or [rad]: the position error of a row that holds, the room left before a stop, the
        coordinate of a spring or servo.
      law: one of the laws above.
    """

    parent: Side
    child: Side
    error: Array
    law: str = HOLD


def translation_sides(frames: JointFrames, direction: Vec3) -> Sides:
    """Jacobian of the offset along a direction fixed in the parent."""
    return Side(-direction, -cross(frames.arm_parent, direction)), Side(direction, cross(frames.arm_child, direction))


def rotation_sides(direction: Vec3) -> Sides:
    """Jacobian of the relative rotation about a world direction."""
    zero = direction * 0.0
    return Side(zero, -direction), Side(zero, direction)


def translation_row(frames: JointFrames, direction: Vec3) -> JointRow:
    """Holds the anchors together along one direction (guide 9.4, position constraint)."""
    return JointRow(*translation_sides(frames, direction), dot(frames.offset, direction))


def point_rows(frames: JointFrames) -> list[JointRow]:
    """Three rows hold the anchors together."""
    return [translation_row(frames, direction) for direction in frames.parent]


def axis_row(frames: JointFrames, normal: Vec3) -> JointRow:
    """Keeps the child's axis perpendicular to one direction of the parent (guide 9.4, rotation constraint)."""
    axis = frames.child.column_x
    return JointRow(*rotation_sides(cross(axis, normal)), dot(axis, normal))


def orientation_rows(frames: JointFrames) -> list[JointRow]:
    """Holds the two joint frames parallel: three rows about the parent's axes.

    The Jacobian is that at parallel frames. The exact one, ``w e + v x e`` for the relative quaternion (w, v), loses rank
    half a turn away, where a correction is needed most.
    """
    relative = frames.relative
    # q and -q are the same rotation; the short way round has w > 0.
    twice = jnp.where(relative.w < 0, -2.0, 2.0)
    components = (relative.x * twice, relative.y * twice, relative.z * twice)
    return [JointRow(*rotation_sides(column), error) for column, error in zip(frames.parent, components, strict=True)]


def lower_row(sides: Sides, coordinate: Array, limit: Array) -> JointRow:
    """Stop at a lower limit."""
    return JointRow(*sides, coordinate - limit, STOP)


def upper_row(sides: Sides, coordinate: Array, limit: Array) -> JointRow:
    """Stop at an upper limit."""
    return JointRow(*_against(sides), limit - coordinate, STOP)


def free_row(sides: Sides, law: str) -> JointRow:
    """Row of a law that acts on the velocity alone."""
    return JointRow(*sides, jnp.zeros((1, 1), sides[0].linear.x.dtype), law)


def _against(sides: Sides) -> Sides:
    against = (Side(-side.linear, None if side.angular is None else -side.angular) for side in sides)
    return tuple(against)  # type: ignore[return-value]
