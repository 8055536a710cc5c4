"""Sphere against capsule (guide 6.5: closest point of a segment to a point)."""

from typing import Any

import jax.numpy as jnp

from mathota_jax.collision.closest import clamp, direction, perpendicular, round_point
from mathota_jax.collision.manifold import Manifold
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import dot


def sphere_capsule(sphere: dict[str, Any], pose_a: Pose, capsule: dict[str, Any], pose_b: Pose) -> Manifold:
    """One contact. A sphere centred on the capsule's segment is pushed out perpendicular to it."""
    assert pose_b.rotation is not None
    axis, half_height = pose_b.rotation.column_y, capsule["half_height"]
    along = dot(axis, pose_a.position - pose_b.position)
    core = pose_b.position + axis * clamp(along, -half_height, half_height)
    difference = core - pose_a.position
    # Round-off tilts what is left of the difference beside the segment: the more the shorter it is.
    beside = jnp.where(jnp.abs(along) < half_height, 1.0, 0.0).astype(along.dtype)
    difference = difference - axis * (beside * dot(axis, difference))
    normal = direction(difference, perpendicular(axis), sphere["radius"] + capsule["radius"])
    return Manifold(normal, (round_point(pose_a.position, core, normal, sphere["radius"], capsule["radius"]),))
