"""Plane against cylinder: four points of the lower rim, or the two ends of the lowest generator."""

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


def plane_cylinder(plane: dict[str, Any], _: Pose, cylinder: dict[str, Any], pose: Pose) -> Manifold:
    """Four contacts while the cylinder stands, two while it lies; the deepest point is always the first.

    It lies when the upper end of its lowest generator is below the highest point of its lower disc. The feature is
    ``quadrant + 4 * (1 for the disc at +Y)``; quadrants are numbered +x, +z, -x, -z.
    """
    assert pose.rotation is not None
    normal, rotation = plane["normal"], pose.rotation
    radius, half_height = cylinder["radius"], cylinder["half_height"]
    local = rotation.apply_transposed(normal)
    rim = rim_points(-local.x, -local.z)
    frozen, frozen_radius, frozen_height = lax.stop_gradient((local, radius, half_height))
    lateral = safe_sqrt(frozen.x * frozen.x + frozen.z * frozen.z)
    lies = frozen_height * jnp.abs(frozen.y) < frozen_radius * lateral
    code = settle_code((frozen.y < 0).astype(local.y.dtype) + 2.0 * lies)
    upper_disc, lying = code & 1, code >= 2
    end = jnp.where(upper_disc == 1, 1.0, -1.0).astype(local.y.dtype) * half_height

    points = []
    for index, (x, z, quadrant) in enumerate(zip(*rim, strict=True)):
        height, disc = end, upper_disc
        if index == 1:
            x, z = jnp.where(lying, rim.x[0], x), jnp.where(lying, rim.z[0], z)
            height, disc = jnp.where(lying, -end, end), jnp.where(lying, 1 - upper_disc, upper_disc)
            quadrant = jnp.where(lying, rim.quadrant[0], quadrant)
        corner = pose.point_to_world(Vec3(radius * x, height, radius * z))
        foot = corner - normal * (dot(normal, corner) - plane["offset"])
        points.append(round_point(foot, corner, normal, 0.0, 0.0, quadrant + 4 * disc, True if index < 2 else ~lying))
    return Manifold(normal, tuple(points))
