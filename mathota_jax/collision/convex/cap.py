"""Directions around a local minimum of the depth in which nothing is less deep, in closed form.

Along the great circle ``n(t) = n cos t + v sin t`` the support function h_i of a tied piece pair fulfils
``h_i'' + h_i = k_i``. Its radius of curvature k_i is zero for points, at least ``radius * ((axis x n) . v)^2`` for rims, at
every t (``f = |axis x n|`` has ``f'' + f = (axis . (n x v))^2 / f^3`` and f <= 1). Hence
``h_i >= d cos t + (g_i . v) sin t + k_i (1 - cos t)`` with the depth d and the part g_i of the support point across n. In an
average with the weights of the closest point the g_i cancel: in directions v in which the average k is at least d nothing is
less deep than d. In the others the largest of the ``g_i . v``, rho, keeps h above d for ``tan(t / 2) <= rho / d``: up to 90
degrees if rho is at least d.

Shallow contacts are mostly proved so, or but for the far half of the directions, which are far deeper: the search there has
next to nothing to do, whereas the bounds of an expanding polytope approach a curved minimum slowly.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.convex.difference import Difference, Weights, barycentric
from mathota_jax.collision.convex.polish import Solution, rim_radii, stacked_differences
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.vector import Vec3, cross, dot, tangent_basis


class Cap(NamedTuple):
    """Where the depth is proved to be no less than along the normal of a solution, to within the tolerance.

    Attributes:
        half: bool, in the directions up to 90 degrees from it. Smaller caps are not worth their place: the triangles beside
            them are long and thin, and the search among these is longer.
        whole: bool, in all directions.
    """

    half: Array
    whole: Array


class _Tangents(NamedTuple):
    """Components in the tangent plane of the support points of the ties, and which of these are used."""

    points: list[tuple[Array, Array]]
    used: list[Array]

    def reach(self, x: Array, y: Array) -> Array:
        """How far the farthest of the points lies along a direction."""
        (first_x, first_y), *others = self.points
        farthest = first_x * x + first_y * y
        for used, (px, py) in zip(self.used[1:], others, strict=True):
            farthest = jnp.where(used, jnp.maximum(farthest, px * x + py * y), farthest)
        return farthest


class _Form(NamedTuple):
    """Quadratic form of the tangent plane: the average radius of curvature in each direction, from below."""

    xx: Array
    xy: Array
    yy: Array

    def along(self, x: Array, y: Array) -> Array:
        return self.xx * x * x + 2.0 * self.xy * x * y + self.yy * y * y


def proved_cap(shapes: Difference, found: Solution, tolerance: float) -> Cap:
    """What is proved around a solution; nothing where that is not a local minimum to within half the tolerance.

    Args:
        shapes: The shapes, not differentiated.
        found: Normal and ties of a local minimum of the depth.
        tolerance: Nothing there is less deep by more than this share of the size.
    """
    normal, ties, depth = found.normal, found.ties, -found.separation
    points = stacked_differences(shapes, ties, normal)
    weights: Weights = compute_once(barycentric(points, ties.two, ties.three), depth)
    u, v = tangent_basis(normal)
    tangents = _Tangents(
        compute_once([(-dot(point, u), -dot(point, v)) for point in points], depth),
        [jnp.ones_like(ties.two), ties.two, ties.three],
    )
    error = sum(jnp.abs(sum(w * p[k] for w, p in zip(weights, tangents.points, strict=True))) for k in range(2))
    for used, weight, point in zip(tangents.used, weights, points, strict=True):
        unequal = jnp.abs(dot(point, normal) + depth) + jnp.maximum(-weight, 0.0)
        error = error + jnp.where(used, unequal, 0.0)
    form = _Form(*compute_once(tuple(_curvature(shapes, found, weights, u, v)), depth))
    flattest, rho = _least_reach(tangents, form, depth)
    certain = error <= 0.5 * tolerance
    whole, half = certain & (flattest >= depth), certain & (rho >= depth)
    code = settle_code((2.0 * whole + (half & ~whole)).astype(depth.dtype))
    return Cap(code > 0, code == 2)


def _curvature(shapes: Difference, found: Solution, weights: Weights, u: Vec3, v: Vec3) -> _Form:
    zero = jnp.zeros_like(found.separation)
    form = _Form(zero, zero, zero)
    normal = found.normal
    for of_b, radius in rim_radii(shapes, found.ties, weights):
        axis = shapes.rotation.column_y if of_b else Vec3(zero, zero + 1.0, zero)
        across = cross(axis, normal)
        x, y = dot(across, u), dot(across, v)
        form = _Form(form.xx + radius * x * x, form.xy + radius * x * y, form.yy + radius * y * y)
    return form


def _least_reach(tangents: _Tangents, form: _Form, depth: Array) -> tuple[Array, Array]:
    """Least curvature, and the least rho where the curvature is less than the depth.

    Between directions in which two points reach equally far rho is concave, hence least there or at the ends of the range,
    which lies around the direction of least curvature.
    """
    middle, half = 0.5 * (form.xx + form.yy), 0.5 * (form.xx - form.yy)
    spread = jnp.sqrt(half * half + form.xy * form.xy)
    safe_spread = jnp.where(spread > 0, spread, 1.0)
    cosine = jnp.where(spread > 0, half / safe_spread, 1.0)  # of twice the angle of the roundest direction
    round_x = jnp.sqrt(jnp.maximum(0.5 + 0.5 * cosine, 0.0))
    round_y = jnp.sqrt(jnp.maximum(0.5 - 0.5 * cosine, 0.0)) * jnp.where(form.xy < 0, -1.0, 1.0)
    flattest = middle - spread
    squared = jnp.clip((depth - flattest) / (2.0 * safe_spread), 0.0, 1.0)
    sine, cosine = jnp.sqrt(jnp.where(spread > 0, squared, 1.0)), jnp.sqrt(jnp.where(spread > 0, 1.0 - squared, 0.0))

    candidates = [(-round_y, round_x)]
    for sign in (1.0, -1.0):
        candidates.append((sign * sine * round_x - cosine * round_y, sign * sine * round_y + cosine * round_x))
    least = jnp.full_like(depth, jnp.inf)
    for x, y in candidates:
        least = jnp.minimum(least, jnp.minimum(tangents.reach(x, y), tangents.reach(-x, -y)))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        x, y = (b - a for a, b in zip(tangents.points[i], tangents.points[j], strict=True))
        squared = x * x + y * y
        inverse = 1.0 / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
        x, y = y * inverse, -x * inverse
        edge = tangents.used[i] & tangents.used[j] & (squared > 0) & (form.along(x, y) < depth)
        reach = jnp.minimum(tangents.reach(x, y), tangents.reach(-x, -y))
        least = jnp.where(edge, jnp.minimum(least, reach), least)
    return flattest, least
