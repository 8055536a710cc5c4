"""Sphere against box (guide 6.5: closest point of the box to the centre)."""

from typing import Any

import jax.numpy as jnp

from mathota_jax.collision.closest import clamp_to_box, round_point
from mathota_jax.collision.manifold import Manifold
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import settle_code, store_cotangents
from mathota_jax.spatial.vector import Vec3, dot, where


def sphere_box(sphere: dict[str, Any], pose_a: Pose, box: dict[str, Any], pose_b: Pose) -> Manifold:
    """One contact; exact outside and inside: a centre inside the box leaves through the nearest face."""
    assert pose_b.rotation is not None
    half = box["half_extents"]
    center = store_cotangents(pose_b.point_to_local(pose_a.position))
    nearest = clamp_to_box(center, half)
    outward = center - nearest
    squared = dot(outward, outward)
    size = sphere["radius"] + jnp.minimum(half.x, jnp.minimum(half.y, half.z))
    tiny = (16.0 * jnp.finfo(squared.dtype).eps * size) ** 2
    face = _exit_face(center, half)
    code = settle_code(jnp.where(squared > tiny, -1.0, face))
    outside, axis = code < 0, code >> 1
    sign = jnp.where((code & 1) == 1, 1.0, -1.0).astype(squared.dtype)
    zero = jnp.zeros_like(squared)
    face_normal = Vec3(*(jnp.where(axis == k, sign, zero) for k in range(3)))
    inverse = jnp.where(outside, 1.0 / jnp.sqrt(jnp.where(outside, squared, 1.0)), 0.0)
    normal = where(outside, outward * inverse, face_normal)
    surface = Vec3(
        *(jnp.where(~outside & (axis == k), sign * h, q) for k, (q, h) in enumerate(zip(nearest, half, strict=True)))
    )
    normal_w = store_cotangents(-pose_b.rotation.apply(normal))
    point = round_point(pose_a.position, pose_b.point_to_world(surface), normal_w, sphere["radius"], 0.0)
    return Manifold(normal_w, (point,))


def _exit_face(center: Vec3, half: Vec3) -> Any:
    """Code ``2 * axis + (1 if the positive face)`` of the face nearest to a point inside the box."""
    depth = half.x - jnp.abs(center.x)
    code = jnp.where(center.x > 0, 1.0, 0.0).astype(depth.dtype)
    for axis, c, h in ((1, center.y, half.y), (2, center.z, half.z)):
        shallower = h - jnp.abs(c) < depth
        code = jnp.where(shallower, 2.0 * axis + (c > 0), code)
        depth = jnp.where(shallower, h - jnp.abs(c), depth)
    return code
