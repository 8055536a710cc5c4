"""Where the two frames of a joint are in the world, and the row parts that joints are composed of."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mathota_jax.bodies import Bodies, quaternion, vector
from mathota_jax.constraints.assembly import Side
from mathota_jax.model import Model
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.quaternion import Quaternion, multiply, to_matrix
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Mat3, Vec3, cross, dot


class JointFrames(NamedTuple):
    """Joints of one kind; components of shape (joint, world), all in the world frame.

    Attributes:
      arm_parent: from the parent's centre of mass to the *child's* anchor, where the parent is acted upon.
      arm_child: from the child's centre of mass to its anchor.
      offset: from the parent's anchor to the child's.
      parent, child: joint frames; the first column is the axis of the joint.
      relative: orientation of the child's joint frame seen from the parent's.
    """

    arm_parent: Vec3
    arm_child: Vec3
    offset: Vec3
    parent: Mat3
    child: Mat3
    relative: Quaternion


class JointRow(NamedTuple):
    """One row of each joint of a kind.

    Attributes:
      parent, child: Jacobians.
      error: position error, to become 0 (or not negative, if `one_sided`) [m] or [rad].
      one_sided: whether the row only pushes.
      damping: viscous coefficient of a damping row, None for a row with a position error.
    """

    parent: Side
    child: Side
    error: Array
    one_sided: bool = False
    damping: Array | None = None


def joint_frames(model: Model, bodies: Bodies, joints: tuple[int, ...]) -> JointFrames:
    """Frames of the given joints at the poses of all bodies."""
    entries = [model.scene.joints[joint] for joint in joints]
    parents, children = [entry.parent for entry in entries], [entry.child for entry in entries]
    parent_position, parent_orientation = take((bodies.position, bodies.orientation), parents)
    child_position, child_orientation = take((bodies.position, bodies.orientation), children)
    anchor_parent, anchor_child, frame_parent, frame_child = take(
        (
            vector(model.joint_anchor_parent),
            vector(model.joint_anchor_child),
            quaternion(model.joint_frame_parent),
            quaternion(model.joint_frame_child),
        ),
        joints,
    )
    arm_parent = to_matrix(parent_orientation).apply(anchor_parent)
    arm_child = to_matrix(child_orientation).apply(anchor_child)
    offset = (child_position + arm_child) - (parent_position + arm_parent)
    parent, child = multiply(parent_orientation, frame_parent), multiply(child_orientation, frame_child)
    inverse = Quaternion(parent.w, -parent.x, -parent.y, -parent.z)
    frames = JointFrames(
        arm_parent + offset, arm_child, offset, to_matrix(parent), to_matrix(child), multiply(inverse, child)
    )
    return compute_once(frames, offset.x)


def translation_sides(frames: JointFrames, direction: Vec3) -> tuple[Side, Side]:
    """Jacobian of the offset along a direction fixed in the parent."""
    return Side(-direction, -cross(frames.arm_parent, direction)), Side(direction, cross(frames.arm_child, direction))


def rotation_sides(direction: Vec3) -> tuple[Side, Side]:
    """Jacobian of the relative rotation about a world direction."""
    zero = direction * 0.0
    return Side(zero, -direction), Side(zero, direction)


def translation_row(frames: JointFrames, direction: Vec3) -> JointRow:
    """Holds the anchors together along one direction (guide 9.4, position constraint)."""
    return JointRow(*translation_sides(frames, direction), dot(frames.offset, direction))


def axis_row(frames: JointFrames, normal: Vec3) -> JointRow:
    """Keeps the child's axis perpendicular to one direction of the parent (guide 9.4, rotation constraint)."""
    axis = frames.child.column_x
    return JointRow(*rotation_sides(cross(axis, normal)), dot(axis, normal))


def orientation_rows(frames: JointFrames) -> list[JointRow]:
    """Holds the two joint frames parallel: three rows about the parent's axes."""
    relative = frames.relative
    # q and -q are the same rotation; the short way round has w > 0.
    twice = jnp.where(relative.w < 0, -2.0, 2.0)
    components = (relative.x * twice, relative.y * twice, relative.z * twice)
    return [JointRow(*rotation_sides(column), error) for column, error in zip(frames.parent, components, strict=True)]


def limit_rows(sides: tuple[Side, Side], coordinate: Array, limits: Array) -> list[JointRow]:
    """Stops at a lower and an upper limit; `limits` is (joint, 2, world)."""
    parent, child = sides
    against = [Side(-side.linear, None if side.angular is None else -side.angular) for side in sides]
    return [
        JointRow(parent, child, coordinate - limits[:, 0], one_sided=True),
        JointRow(against[0], against[1], limits[:, 1] - coordinate, one_sided=True),
    ]


def damping_row(sides: tuple[Side, Side], damping: Array) -> JointRow:
    """Viscous resistance along the free coordinate."""
    return JointRow(*sides, jnp.zeros_like(damping), damping=damping)
