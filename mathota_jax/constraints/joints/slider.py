"""Slider: one relative translation is free (guide 9.3)."""

from __future__ import annotations

import dataclasses
from typing import Any

from jax import Array

from mathota_jax.constraints.joints.frames import JointFrames
from mathota_jax.constraints.joints.kind import Coordinate, scalar_kind
from mathota_jax.constraints.joints.rows import JointRow, Sides, orientation_rows, translation_row, translation_sides
from mathota_jax.spatial.vector import dot


@dataclasses.dataclass(frozen=True)
class Slider:
    """Joint that leaves a translation along one axis of the parent free.

    The coordinate is the displacement of the child along the axis [m] from the built pose.

    Args:
      parent, child: handles or names of the two bodies; the parent may be static.
      anchor: (3,) point [m], world frame at build time; forces of the joint act there.
      axis: (3,) direction of the motion, world frame at build time; need not be a unit vector.
      limits: smallest and largest displacement [m], infinite for an open side; None for no limits. Stops without
        restitution; equal limits hold the displacement.
      damping: viscous coefficient [N s/m].
      friction: dry friction [N]: the force, at most this, that keeps the displacement or resists its change.
      stiffness: of a spring [N/m].
      rest: displacement at which the spring is slack [m].
      armature: inertia that moves with the displacement, such as that of a geared rotor [kg].
    """

    parent: Any
    child: Any
    anchor: Any
    axis: Any
    limits: Any = None
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    armature: float = 0.0


def fixed_rows(frames: JointFrames) -> list[JointRow]:
    """Two rows hold the anchors on the axis, three the orientation."""
    across = [translation_row(frames, frames.parent.column_y), translation_row(frames, frames.parent.column_z)]
    return [*across, *orientation_rows(frames)]


def displacement_sides(frames: JointFrames) -> Sides:
    """Jacobian of the displacement."""
    return translation_sides(frames, frames.parent.column_x)


def displacement(frames: JointFrames) -> Array:
    """Displacement of the child along the axis [m]."""
    return dot(frames.offset, frames.parent.column_x)


KIND = scalar_kind(Slider, fixed_rows, 5, 2, Coordinate(displacement, displacement_sides, angular=False))
