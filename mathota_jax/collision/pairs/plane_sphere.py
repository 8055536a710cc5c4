"""Plane against sphere (guide 6.5: point-plane distance)."""

from typing import Any

from mathota_jax.collision.closest import round_point
from mathota_jax.collision.manifold import Manifold
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import dot


def plane_sphere(plane: dict[str, Any], _: Pose, sphere: dict[str, Any], pose: Pose) -> Manifold:
    """One contact at the lowest point of the sphere. Exact at every depth; no rotation needed."""
    normal, center = plane["normal"], pose.position
    foot = center - normal * (dot(normal, center) - plane["offset"])
    return Manifold(normal, (round_point(foot, center, normal, 0.0, sphere["radius"]),))
