"""Hinge: one relative rotation is free (guide 9.3 and 9.4)."""

from __future__ import annotations

import dataclasses
from typing import Any

from mathota_jax.constraints.joints.frames import JointFrames, twist
from mathota_jax.constraints.joints.kind import Coordinate, scalar_kind
from mathota_jax.constraints.joints.rows import JointRow, Sides, axis_row, point_rows, rotation_sides


@dataclasses.dataclass(frozen=True)
class Hinge:
    """Joint that leaves a rotation about one axis free.

    The coordinate is the angle of the child about the axis [rad] from the built pose, in (-pi, pi].

    Args:
      parent, child: handles or names of the two bodies; the parent may be static.
      anchor: (3,) point on the axis [m], world frame at build time.
      axis: (3,) direction of the axis, world frame at build time; need not be a unit vector.
      limits: smallest and largest angle [rad], between -pi and pi, infinite for an open side; None for no limits. Stops
        without restitution; equal limits hold the angle. The angle is known but for full turns: with one side open, an
        arm that comes round a whole turn passes the stop, with a jolt.
      damping: viscous coefficient [N m s/rad].
      friction: dry friction [N m]: the torque, at most this, that keeps the angle or resists its change.
      stiffness: of a torsion spring [N m/rad].
      rest: angle at which the spring is slack [rad].
      armature: inertia of a rotor that turns with the angle [kg m^2].
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
    """Three rows hold the anchors together, two the axes parallel."""
    return [*point_rows(frames), axis_row(frames, frames.parent.column_y), axis_row(frames, frames.parent.column_z)]


def angle_sides(frames: JointFrames) -> Sides:
    """Jacobian of the angle."""
    return rotation_sides(frames.parent.column_x)


KIND = scalar_kind(Hinge, fixed_rows, 5, 3, Coordinate(twist, angle_sides, angular=True))
