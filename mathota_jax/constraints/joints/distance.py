"""Distance: the length between two points is held (a rod) or limited (a rope) (guide 9.3)."""

from __future__ import annotations

import dataclasses
from typing import Any

from jax import Array

from mathota_jax.constraints.joints.frames import JointFrames
from mathota_jax.constraints.joints.kind import Coordinate, scalar_kind
from mathota_jax.constraints.joints.rows import JointRow, Sides, translation_sides
from mathota_jax.spatial.vector import norm, normalize, where


@dataclasses.dataclass(frozen=True)
class Distance:
    """Joint between one point of each body that a rod, a rope or a spring connects.

    The coordinate is the length between the points [m]. All else is free. The joint may be built at a length outside its
    limits; it then closes the gap.

    Args:
      parent, child: handles or names of the two bodies; the parent may be static.
      anchor: (3,) point of the parent [m], world frame at build time.
      child_anchor: (3,) point of the child [m], world frame at build time; None for the child's centre of mass.
      lengths: (smallest, largest) length [m]: a rope is ``(0, length)``, a spring alone ``(0, inf)``. A number is the
        length of a rod, as are equal lengths; None is a rod of the built length.
      damping: viscous coefficient along the line [N s/m]; this and the rest not for rods.
      friction: dry friction along the line [N].
      stiffness: of a spring [N/m], which pulls and pushes.
      rest: length at which the spring is slack [m]; None for the built length.
      armature: inertia that moves with the length, such as that of a winch [kg].
    """

    parent: Any
    child: Any
    anchor: Any
    child_anchor: Any = None
    lengths: Any = None
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    rest: float | None = None
    armature: float = 0.0


def fixed_rows(frames: JointFrames) -> list[JointRow]:
    """None: a rod is a coordinate whose limits are equal."""
    return []


def length(frames: JointFrames) -> Array:
    """Distance of the anchors [m]."""
    return norm(frames.offset)


def length_sides(frames: JointFrames) -> Sides:
    """Jacobian of the length; along the parent's x axis where the anchors coincide."""
    return translation_sides(frames, where(length(frames) > 0, normalize(frames.offset), frames.parent.column_x))


KIND = scalar_kind(Distance, fixed_rows, 0, 0, Coordinate(length, length_sides, angular=False))
