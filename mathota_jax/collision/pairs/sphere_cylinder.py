"""Sphere against cylinder: closest point of the cylinder to the centre."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import lax

from mathota_jax.collision.closest import direction, round_point
from mathota_jax.collision.manifold import Manifold
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import settle_code
from mathota_jax.spatial.vector import Vec3, dot, where

CAP, SIDE, RIM = 0, 1, 2


def sphere_cylinder(sphere: dict[str, Any], pose_a: Pose, cylinder: dict[str, Any], pose_b: Pose) -> Manifold:
    """One contact; exact outside and inside: a centre inside the cylinder leaves through its side or a cap.

    A centre on the axis that leaves through the side goes along local x: every direction is equally right.
    """
    assert pose_b.rotation is not None
    radius, half_height = cylinder["radius"], cylinder["half_height"]
    center = pose_b.point_to_local(pose_a.position)
    one, zero = jnp.ones_like(center.x), jnp.zeros_like(center.x)
    size = radius + half_height
    radial = direction(Vec3(center.x, zero, center.z), Vec3(one, zero, zero), size)
    distance = dot(radial, center)

    beyond_side, beyond_cap = lax.stop_gradient((distance - radius, jnp.abs(center.y) - half_height))
    inside_or_face = jnp.where(beyond_side > beyond_cap, SIDE, CAP)
    feature = jnp.where((beyond_side > 0) & (beyond_cap > 0), RIM, inside_or_face)
    code = settle_code((2 * feature + (center.y > 0)).astype(center.y.dtype))
    feature, up = code >> 1, jnp.where((code & 1) == 1, 1.0, -1.0).astype(center.y.dtype)
    on_cap, on_side = feature == CAP, feature == SIDE

    cap_point = Vec3(center.x, up * half_height, center.z)
    side_point = Vec3(radius * radial.x, center.y, radius * radial.z)
    rim_point = Vec3(radius * radial.x, up * half_height, radius * radial.z)
    cap_normal = Vec3(zero, up, zero)
    # Exactly on the rim: halfway between the normals of the two faces.
    between = (radial + cap_normal) * jnp.sqrt(0.5).astype(center.y.dtype)
    away = where(feature == RIM, center - rim_point, between)
    outward = where(on_cap, cap_normal, where(on_side, radial, direction(away, between, size)))
    surface = where(on_cap, cap_point, where(on_side, side_point, rim_point))
    normal = -pose_b.rotation.apply(outward)
    point = round_point(pose_a.position, pose_b.point_to_world(surface), normal, sphere["radius"], 0.0)
    return Manifold(normal, (point,))
