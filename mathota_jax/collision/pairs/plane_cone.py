"""Plane against cone: four points of the base rim, or the lowest rim point and the apex."""

from typing import Any

import jax.numpy as jnp
from jax import lax

from mathota_jax.collision.closest import round_point
from mathota_jax.collision.manifold import Manifold
from mathota_jax.collision.rim import rim_points
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.safe import safe_sqrt
from mathota_jax.spatial.settle import settle_code
from mathota_jax.spatial.vector import Vec3, dot

APEX = 4
"""Features: 0-3 the quadrants +x, +z, -x, -z of the base rim, then the apex."""


def plane_cone(plane: dict[str, Any], _: Pose, cone: dict[str, Any], pose: Pose) -> Manifold:
    """Four contacts while the cone stands on its base, two once the apex is lower than the highest point of the base.

    The deepest point of the cone is always one of the first two.
    """
    assert pose.rotation is not None
    normal, radius, half_height = plane["normal"], cone["radius"], cone["half_height"]
    local = pose.rotation.apply_transposed(normal)
    rim = rim_points(-local.x, -local.z)
    frozen, frozen_radius, frozen_height = lax.stop_gradient((local, radius, half_height))
    lateral = safe_sqrt(frozen.x * frozen.x + frozen.z * frozen.z)
    apex_is_low = 2.0 * frozen_height * frozen.y < frozen_radius * lateral
    pointed = settle_code(apex_is_low.astype(local.y.dtype)) == 1

    points = []
    for index, (x, z, quadrant) in enumerate(zip(*rim, strict=True)):
        # The centroid is the origin: a quarter of the height above the base.
        corner = Vec3(radius * x, -0.5 * half_height, radius * z)
        if index == 1:
            corner = Vec3(
                jnp.where(pointed, 0.0, corner.x),
                jnp.where(pointed, 1.5, -0.5) * half_height,
                jnp.where(pointed, 0.0, corner.z),
            )
            quadrant = jnp.where(pointed, APEX, quadrant)
        corner = pose.point_to_world(corner)
        foot = corner - normal * (dot(normal, corner) - plane["offset"])
        points.append(round_point(foot, corner, normal, 0.0, 0.0, quadrant, True if index < 2 else ~pointed))
    return Manifold(normal, tuple(points))
