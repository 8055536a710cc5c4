"""Where the two frames of a joint are in the world."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mathota_jax.bodies import Bodies, quaternion, vector
from mathota_jax.model import Model
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.quaternion import Quaternion, multiply, to_matrix
from mathota_jax.spatial.settle import compute_once, store_cotangents
from mathota_jax.spatial.vector import Mat3, Vec3


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


def joint_frames(model: Model, bodies: Bodies, joints: tuple[int, ...]) -> JointFrames:
    """Frames of the given joints at the poses of all bodies."""
    entries = [model.scene.joints[joint] for joint in joints]
    parents, children = [entry.parent for entry in entries], [entry.child for entry in entries]
    # The derivative by a pose goes through all rows of its joints: once for each component is enough.
    parent_pose, child_pose = (
        store_cotangents(take((bodies.position, bodies.orientation), side), for_one_reader=True)
        for side in (parents, children)
    )
    (parent_position, parent_orientation), (child_position, child_orientation) = parent_pose, child_pose
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
    parent, child = store_cotangents(
        (multiply(parent_orientation, frame_parent), multiply(child_orientation, frame_child))
    )
    inverse = Quaternion(parent.w, -parent.x, -parent.y, -parent.z)
    frames = JointFrames(
        arm_parent + offset, arm_child, offset, to_matrix(parent), to_matrix(child), multiply(inverse, child)
    )
    return compute_once(frames, offset.x)


def twist(frames: JointFrames) -> Array:
    """Angle of the child about the axis [rad], in (-pi, pi], without the shortest turn between the two axes."""
    relative = frames.relative
    sign = jnp.where(relative.w < 0, -1.0, 1.0)
    return 2.0 * jnp.arctan2(relative.x * sign, relative.w * sign)
