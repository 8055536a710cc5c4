"""Plane against box: the corners of the face that looks most against the normal (guide 6.5)."""

from typing import Any

import jax.numpy as jnp

from mathota_jax.collision.closest import round_point
from mathota_jax.collision.manifold import Manifold
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.vector import dot, where


def plane_box(plane: dict[str, Any], _: Pose, box: dict[str, Any], pose: Pose) -> Manifold:
    """Four contacts; the deepest corner of the box is always among them.

    The feature is the corner index: bit 0, 1, 2 set where the corner lies on the positive side of local x, y, z.
    """
    assert pose.rotation is not None
    normal, rotation, half = plane["normal"], pose.rotation, box["half_extents"]
    local = rotation.apply_transposed(normal)
    face = _opposed_face(local)
    axis, positive = face >> 1, face & 1
    is_x, is_y = axis == 0, axis == 1
    x, y, z = rotation.column_x * half.x, rotation.column_y * half.y, rotation.column_z * half.z
    # The face's own axis, and the next two in cyclic order.
    outward = where(is_x, x, where(is_y, y, z)) * jnp.where(positive == 1, 1.0, -1.0).astype(local.x.dtype)
    first = where(is_x, y, where(is_y, z, x))
    second = where(is_x, z, where(is_y, x, y))
    first_bit, second_bit = jnp.where(is_x, 2, jnp.where(is_y, 4, 1)), jnp.where(is_x, 4, jnp.where(is_y, 1, 2))
    base = positive << axis
    # Each of the four points reads them.
    center, first, second = compute_once((pose.position + outward, first, second), pose.position.x)
    points = []
    for sign_1, sign_2 in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        corner = center + first * float(sign_1) + second * float(sign_2)
        foot = corner - normal * (dot(normal, corner) - plane["offset"])
        feature = base + (first_bit if sign_1 > 0 else 0) + (second_bit if sign_2 > 0 else 0)
        points.append(round_point(foot, corner, normal, 0.0, 0.0, feature))
    return Manifold(normal, tuple(points))


def _opposed_face(local: Any) -> Any:
    """Code ``2 * axis + (1 if the positive face)`` of the face whose outward normal is most against `local`."""
    code = jnp.where(local.x < 0, 1.0, 0.0).astype(local.x.dtype)
    best = jnp.abs(local.x)
    for axis, component in ((1, local.y), (2, local.z)):
        better = jnp.abs(component) > best
        code = jnp.where(better, 2.0 * axis + (component < 0), code)
        best = jnp.where(better, jnp.abs(component), best)
    return settle_code(code)
