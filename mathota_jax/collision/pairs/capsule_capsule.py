"""Capsule against capsule (guide 6.5: closest points of two segments)."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.closest import clamp, closest_parameters, direction, perpendicular, round_point
from mathota_jax.collision.manifold import Manifold, Nearest
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import settle, settle_code, store_cotangents
from mathota_jax.spatial.vector import Vec3, cross, dot, where

PARALLEL_SINE = 0.02
"""Below this sine of the angle between the axes the capsules touch along a line: two contacts."""


def capsule_capsule(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
    """One contact at the closest points; two, at the ends of the overlap, where the axes are nearly parallel.

    Features: 0 for crossing axes; else the end of a segment that bounds the overlap (1, 2: A at -Y, +Y; 3, 4: B).
    Segments that cross are pushed apart along the normal of their plane, coaxial ones perpendicular to the axis.
    """
    assert pose_a.rotation is not None
    assert pose_b.rotation is not None
    axis_a, axis_b = pose_a.rotation.column_y, pose_b.rotation.column_y
    length_a, length_b = a["half_height"], b["half_height"]
    radius_a, radius_b = a["radius"], b["radius"]
    offset = pose_b.position - pose_a.position
    axis_a, axis_b, offset = (v.map(store_cotangents) for v in (axis_a, axis_b, offset))
    t_a, t_b = closest_parameters(offset, axis_a, axis_b, length_a, length_b, level=True)

    across = cross(axis_a, axis_b).map(store_cotangents)
    fallback = direction(across, perpendicular(axis_a).map(store_cotangents), 1.0)
    difference = (offset + axis_b * t_b - axis_a * t_a).map(store_cotangents)
    inner = (jnp.abs(t_a) < length_a) & (jnp.abs(t_b) < length_b)
    normal = _normal(difference, across, fallback, inner, radius_a + radius_b)

    # The overlap on A's axis: both shadows are intervals, each bound carries the end it comes from.
    cosine = dot(axis_a, axis_b)
    along = dot(axis_a, offset)
    reach = length_b * jnp.abs(cosine)
    low, high = jnp.maximum(-length_a, along - reach), jnp.minimum(length_a, along + reach)
    # Only where the normal is perpendicular to the axes do both ends face each other (else: end against end).
    sideways = jnp.abs(dot(normal, axis_a)) < PARALLEL_SINE
    parallel = (dot(across, across) < PARALLEL_SINE**2) & (high - low > 1e-3 * (radius_a + radius_b)) & sideways
    low_from_b, high_from_b = along - reach > -length_a, along + reach < length_a
    code = settle_code(
        jnp.where(parallel, 1.0 + 2.0 * low_from_b + 4.0 * high_from_b + 8.0 * (cosine < 0), 0.0).astype(low.dtype)
    )
    two, flipped = code > 0, (code - 1) & 8
    low_from_b, high_from_b = ((code - 1) & 2) > 0, ((code - 1) & 4) > 0
    b_low, b_high = jnp.where(flipped > 0, 4, 3), jnp.where(flipped > 0, 3, 4)

    first = jnp.where(two, jnp.where(low_from_b, along - reach, -length_a), t_a)
    second = jnp.where(high_from_b, along + reach, length_a)
    features = (
        jnp.where(two, jnp.where(low_from_b, b_low, 1), 0),
        jnp.where(high_from_b, b_high, 2),
    )
    points = []
    for index, (t, feature) in enumerate(zip((first, second), features, strict=True)):
        partner = _partner(t, along, cosine, length_b)
        partner = jnp.where(two, partner, t_b) if index == 0 else partner
        core_a, core_b = pose_a.position + axis_a * t, pose_b.position + axis_b * partner
        points.append(round_point(core_a, core_b, normal, radius_a, radius_b, feature, True if index == 0 else two))
    return Manifold(normal, tuple(points))


def capsule_distance(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Nearest:
    """Exact signed distance: the closest points of the axes, also where the manifold has two points beside them."""
    assert pose_a.rotation is not None
    assert pose_b.rotation is not None
    axis_a, axis_b = pose_a.rotation.column_y, pose_b.rotation.column_y
    offset = pose_b.position - pose_a.position
    t_a, t_b = closest_parameters(offset, axis_a, axis_b, a["half_height"], b["half_height"])
    core_a, core_b = axis_a * t_a, axis_b * t_b
    across = cross(axis_a, axis_b)
    fallback = direction(across, perpendicular(axis_a), 1.0)
    inner = (jnp.abs(t_a) < a["half_height"]) & (jnp.abs(t_b) < b["half_height"])
    normal = _normal(offset + core_b - core_a, across, fallback, inner, a["radius"] + b["radius"])
    shares = tuple(safe_divide(t, shape["half_height"]) for t, shape in ((t_a, a), (t_b, b)))
    gap = _gap((normal, *shares), (offset, axis_a, axis_b, a["half_height"], b["half_height"]))
    return Nearest(
        gap - a["radius"] - b["radius"],
        normal,
        pose_a.position + core_a + normal * a["radius"],
        pose_b.position + core_b - normal * b["radius"],
    )


def _normal(difference: Vec3, across: Vec3, fallback: Vec3, inner: Array, size: Any) -> Vec3:
    """Unit direction between the closest points, or across both axes where these all but meet inside of both.

    There the two are the same, but round-off turns the difference the more the shorter it is.
    """
    squared, product = dot(difference, difference), dot(difference, across)
    meet = inner & (squared < size * size * dot(across, across))
    turn = settle(jnp.where(meet, jnp.where(product < 0, -1.0, 1.0), 0.0).astype(squared.dtype))
    return where(turn != 0, fallback * turn, direction(difference, fallback, size))


@jax.custom_jvp
def _gap(found: tuple[Vec3, Array, Array], axes: tuple[Vec3, Vec3, Vec3, Array, Array]) -> Array:
    """Gap of two axes along a normal at shares of their half lengths.

    At the closest points it does not change with normal and shares (envelope theorem): they have no part in its first
    derivative, of which a fourth of the work is left. They are arguments of that derivative, so the second is whole.
    """
    return _along(found, axes)


@_gap.defjvp
def _gap_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    found, axes = primals
    return jax.jvp(lambda moved: _along(found, moved), (axes,), (tangents[1],))


def _along(found: tuple[Vec3, Array, Array], axes: tuple[Vec3, Vec3, Vec3, Array, Array]) -> Array:
    (normal, share_a, share_b), (offset, axis_a, axis_b, length_a, length_b) = found, axes
    return dot(normal, offset + axis_b * (share_b * length_b) - axis_a * (share_a * length_a))


def _partner(t: Array, along: Array, cosine: Array, length_b: Any) -> Array:
    """Parameter on B whose point lies level with parameter `t` on A."""
    return clamp(safe_divide(t - along, cosine), -length_b, length_b)
