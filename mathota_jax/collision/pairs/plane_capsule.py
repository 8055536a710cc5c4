"""Plane against capsule: the two end spheres."""

from typing import Any

from mathota_jax.collision.closest import round_point
from mathota_jax.collision.manifold import Manifold
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import dot


def plane_capsule(plane: dict[str, Any], _: Pose, capsule: dict[str, Any], pose: Pose) -> Manifold:
    """Two contacts, one for each end (feature 0: local -Y, 1: local +Y). Exact at every depth."""
    assert pose.rotation is not None
    normal = plane["normal"]
    reach = pose.rotation.column_y * capsule["half_height"]
    points = []
    for feature, end in enumerate((pose.position - reach, pose.position + reach)):
        foot = end - normal * (dot(normal, end) - plane["offset"])
        points.append(round_point(foot, end, normal, 0.0, capsule["radius"], feature))
    return Manifold(normal, tuple(points))
