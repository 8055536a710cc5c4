"""Sphere against sphere (guide 6.5: distance minus the sum of the radii)."""

from typing import Any

import jax.numpy as jnp

from mathota_jax.collision.closest import round_manifold
from mathota_jax.collision.manifold import Manifold
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import Vec3


def sphere_sphere(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
    """One contact. Concentric spheres are pushed apart along world x: every direction is equally right."""
    one, zero = jnp.ones_like(pose_a.position.x), jnp.zeros_like(pose_a.position.x)
    return round_manifold(pose_a.position, pose_b.position, a["radius"], b["radius"], Vec3(one, zero, zero))
