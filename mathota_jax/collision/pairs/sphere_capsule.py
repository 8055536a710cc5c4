"""Sphere against capsule (guide 6.5: closest point of a segment to a point)."""

from typing import Any

from mathota_jax.collision.closest import closest_on_segment, perpendicular, round_manifold
from mathota_jax.collision.manifold import Manifold
from mathota_jax.spatial.pose import Pose


def sphere_capsule(sphere: dict[str, Any], pose_a: Pose, capsule: dict[str, Any], pose_b: Pose) -> Manifold:
    """One contact. A sphere centred on the capsule's segment is pushed out perpendicular to it."""
    assert pose_b.rotation is not None
    axis = pose_b.rotation.column_y
    core = closest_on_segment(pose_a.position, pose_b.position, axis, capsule["half_height"])
    return round_manifold(pose_a.position, core, sphere["radius"], capsule["radius"], perpendicular(axis))
