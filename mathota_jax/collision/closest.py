"""Closest-point helpers shared by the analytic pairs; worlds last, finite with finite derivatives everywhere."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.manifold import ContactPoint, Manifold
from mathota_jax.spatial.settle import settle, store_cotangents
from mathota_jax.spatial.vector import Vec3, dot, tangent_basis, where


def clamp(value: Any, low: Any, high: Any) -> Array:
    """`value` held in [low, high].

    Unlike `jnp.clip`, whose derivative compares the result with its arguments for equality: if the compiler rounds a
    recomputed argument differently (see `settle`) neither is equal and the derivative is lost.
    """
    return jnp.where(value < low, low, jnp.where(value > high, high, value))


def clamp_to_box(point: Vec3, half: Vec3) -> Vec3:
    """Point of the box ``|x_i| <= half_i`` closest to `point`."""
    return Vec3(*(clamp(p, -h, h) for p, h in zip(point, half, strict=True)))


def direction(difference: Vec3, fallback: Vec3, size: Any) -> Vec3:
    """Unit vector along `difference`, or the unit `fallback` where its length is round-off against `size`.

    The dot product of the result with `difference` is the length, with the right derivative on both branches.
    """
    squared = dot(difference, difference)
    tiny = (16.0 * jnp.finfo(squared.dtype).eps * size) ** 2
    usable = settle((squared > tiny).astype(squared.dtype)) > 0.5
    inverse = jnp.where(usable, 1.0 / jnp.sqrt(jnp.where(usable, squared, 1.0)), 0.0)
    return where(usable, difference * inverse, fallback)


def perpendicular(axis: Vec3) -> Vec3:
    """Some unit vector perpendicular to the unit vector `axis`."""
    return tangent_basis(axis)[0]


def round_manifold(a: Vec3, b: Vec3, radius_a: Any, radius_b: Any, fallback: Vec3) -> Manifold:
    """Single contact of two spheres around the closest core points `a` and `b` (guide 6.5)."""
    difference = b - a
    normal = direction(difference, fallback, radius_a + radius_b)
    return Manifold(normal, (round_point(a, b, normal, radius_a, radius_b),))


def round_point(
    a: Vec3, b: Vec3, normal: Vec3, radius_a: Any, radius_b: Any, feature: Array | int | None = None, active: Any = True
) -> ContactPoint:
    """Contact of two core points inflated by their radii, measured along a given unit `normal`."""
    separation = dot(normal, b - a) - radius_a - radius_b
    middle = (a + b + normal * (radius_a - radius_b)) * 0.5
    zero = jnp.zeros_like(separation, dtype=jnp.int32)
    return ContactPoint(
        position=middle,
        separation=separation,
        feature=zero if feature is None else feature + zero,
        active=jnp.broadcast_to(active, jnp.shape(separation)),
    )


def closest_parameters(
    offset: Vec3, axis_a: Vec3, axis_b: Vec3, half_length_a: Any, half_length_b: Any, level: bool = False
) -> tuple[Array, Array]:
    """Parameters of the closest points of two segments with unit axes; `offset` leads from A's centre to B's.

    Source: C. Ericson, "Real-Time Collision Detection" (2005), section 5.1.9. The determinant is taken from the
    rejected component rather than as ``1 - cos^2``, which cancels, and the way to the closest points from the middle of the
    overlap, where those of parallel axes are.

    Args:
      offset, axis_a, axis_b: the axes.
      half_length_a, half_length_b: of the segments.
      level: whether axes count as parallel that are so to half of the digits. They come closer towards one end by their
        angle times the way to it, in float32 by 1e-3 of a length, but the direction between the closest points turns
        sideways by their pitch over that angle.
    """
    cosine = store_cotangents(dot(axis_a, axis_b))
    along_a = store_cotangents(dot(axis_a, offset))
    along_b = store_cotangents(dot(axis_b, offset))
    across = axis_a - axis_b * cosine
    sine_squared = store_cotangents(dot(across, across))
    eps = jnp.finfo(sine_squared.dtype).eps
    least = 64.0 * eps if level else (8.0 * eps) ** 2
    parallel = settle((sine_squared < least).astype(sine_squared.dtype)) > 0.5
    # The middle of the overlap of B's shadow on A.
    reach = half_length_b * jnp.abs(cosine)
    low = clamp(along_a - reach, -half_length_a, half_length_a)
    high = clamp(along_a + reach, -half_length_a, half_length_a)
    middle = 0.5 * (low + high)
    # The unconstrained minimum: offset + b * axis_b - a * axis_a is perpendicular to both axes. It is the same from wherever
    # one looks for it.
    base = lax.stop_gradient(middle)
    partner = lax.stop_gradient(clamp(cosine * base - along_b, -half_length_b, half_length_b))
    between = offset + axis_b * partner - axis_a * base
    line_a = base + dot(between, across) / jnp.where(parallel, 1.0, sine_squared)
    a = jnp.where(parallel, middle, clamp(line_a, -half_length_a, half_length_a))
    b = clamp(cosine * a - along_b, -half_length_b, half_length_b)
    a = clamp(cosine * b + along_a, -half_length_a, half_length_a)
    return store_cotangents(a), store_cotangents(b)
