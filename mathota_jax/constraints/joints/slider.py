"""Slider: one relative translation is free (guide 9.3)."""

from __future__ import annotations

import dataclasses
from typing import Any

from jax import Array

from mathota_jax.constraints.assembly import Side
from mathota_jax.constraints.joints.frames import (
    JointFrames,
    JointRow,
    orientation_rows,
    translation_row,
    translation_sides,
)
from mathota_jax.spatial.vector import dot


@dataclasses.dataclass(frozen=True)
class Slider:
    """Joint that leaves a translation along one axis of the parent free.

    Args:
      parent, child: handles or names of the two bodies; the parent may be static.
      anchor: (3,) point [m], world frame at build time; forces of the joint act there.
      axis: (3,) direction of the motion, world frame at build time; need not be a unit vector.
      limits: smallest and largest displacement [m] from the built pose; None for no limits.
      damping: viscous coefficient [N s/m].
    """

    parent: Any
    child: Any
    anchor: Any
    axis: Any
    limits: Any = None
    damping: float = 0.0


def fixed_rows(frames: JointFrames) -> list[JointRow]:
    """Two rows hold the anchors on the axis, three the orientation."""
    across = [translation_row(frames, frames.parent.column_y), translation_row(frames, frames.parent.column_z)]
    return [*across, *orientation_rows(frames)]


def free_sides(frames: JointFrames) -> tuple[Side, Side]:
    """Jacobian of the displacement."""
    return translation_sides(frames, frames.parent.column_x)


def coordinate(frames: JointFrames) -> Array:
    """Displacement of the child along the axis [m]."""
    return dot(frames.offset, frames.parent.column_x)
