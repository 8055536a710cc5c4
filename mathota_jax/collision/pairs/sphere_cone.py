"""Sphere against cone: closest point of the cone to the centre."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.closest import direction, round_point
from mathota_jax.collision.manifold import Manifold
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import settle_code
from mathota_jax.spatial.vector import Vec3, dot, where

BASE, SIDE, RIM, APEX = 0, 1, 2, 3


def sphere_cone(sphere: dict[str, Any], pose_a: Pose, cone: dict[str, Any], pose_b: Pose) -> Manifold:
    """One contact; exact outside and inside: a centre inside the cone leaves through its side or its base.

    A centre on the axis that leaves through the side goes toward local x: every direction is equally right.
    """
    assert pose_b.rotation is not None
    radius, height = cone["radius"], 2.0 * cone["half_height"]
    center = pose_b.point_to_local(pose_a.position)
    one, zero = jnp.ones_like(center.x), jnp.zeros_like(center.x)
    size = radius + height
    radial = direction(Vec3(center.x, zero, center.z), Vec3(one, zero, zero), size)
    up = Vec3(zero, one, zero)
    # In the half plane through the axis and the centre: from the rim point to the centre, and the side's normal.
    across, above = dot(radial, center) - radius, center.y + 0.25 * height
    slant = jnp.sqrt(radius * radius + height * height)
    side_normal = radial * (height / slant) + up * (radius / slant)

    feature = settle_code(_feature(across, above, radius, height, slant))
    on_base, on_side, on_rim = feature == BASE, feature == SIDE, feature == RIM
    side_gap = (across * height + above * radius) / slant
    rim_point = radial * radius - up * (0.25 * height)
    apex_point = up * (0.75 * height)
    surface = where(
        on_base,
        Vec3(center.x, zero - 0.25 * height, center.z),
        where(on_side, center - side_normal * side_gap, where(on_rim, rim_point, apex_point)),
    )
    # Exactly on the rim: halfway between the normals of the two faces; exactly on the apex: along the axis.
    rim_normal = direction(side_normal - up, radial, 1.0)
    corner_normal = where(on_rim, rim_normal, up)
    away = where(on_base | on_side, corner_normal, center - surface)
    outward = where(on_base, -up, where(on_side, side_normal, direction(away, corner_normal, size)))
    normal = -pose_b.rotation.apply(outward)
    point = round_point(pose_a.position, pose_b.point_to_world(surface), normal, sphere["radius"], 0.0)
    return Manifold(normal, (point,))


def _feature(across: Array, above: Array, radius: Any, height: Any, slant: Any) -> Array:
    """What is closest to a point given from the rim outward and along the axis: the Voronoi regions of a triangle."""
    across, above, radius, height, slant = lax.stop_gradient((across, above, radius, height, slant))
    side_gap = (across * height + above * radius) / slant
    along = (above * height - across * radius) / slant  # from the rim toward the apex
    inside = jnp.where(side_gap > -above, SIDE, BASE)
    outside = jnp.where(
        (above < 0) & (across <= 0), BASE, jnp.where(along > slant, APEX, jnp.where(along < 0, RIM, SIDE))
    )
    return jnp.where((side_gap <= 0) & (above >= 0), inside, outside).astype(across.dtype)
