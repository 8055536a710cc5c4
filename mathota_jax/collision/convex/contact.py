"""The closest points of two convex shapes, apart or overlapping; worlds last and differentiable."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.convex.difference import CODES, Difference, difference
from mathota_jax.collision.convex.epa import epa
from mathota_jax.collision.convex.gjk import Simplex, gjk
from mathota_jax.collision.convex.polish import Ties, polish
from mathota_jax.collision.convex.support import SUPPORT
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Vec3, dot, where

POLYTOPE_ITERATIONS = 16
CURVED_ITERATIONS = {"float32": 24, "float64": 40}
PENETRATION_ITERATIONS = 60
LIFT = 0.1
"""Overlapping shapes are pulled apart, along the direction of least overlap, to this gap (share of the size): their
closest points are then those of the overlap, and the distance search finds the pieces they lie on."""


class ConvexContact(NamedTuple):
    """Closest points of two shapes; components of shape ``(pair, world)``.

    Attributes:
        normal: Unit vector from A to B, world frame.
        separation: Signed gap [m] along the normal, negative when overlapping.
        point_a: World point [m] on the surface of A; ``point_b = point_a + separation * normal``.
        point_b: World point [m] on the surface of B.
        feature: int32 id of the pieces in contact, the same whatever the order in which the search found them.
        converged: bool, False if an iteration limit was reached; the result is then the best bound found.
    """

    normal: Vec3
    separation: Array
    point_a: Vec3
    point_b: Vec3
    feature: Array
    converged: Array


def convex_distance(
    kind_a: str, a: dict[str, Any], pose_a: Pose, kind_b: str, b: dict[str, Any], pose_b: Pose
) -> ConvexContact:
    """Signed distance of two convex shapes, with normal and witness points.

    Differentiable in all poses and shape parameters, away from changes of feature; values and derivatives are finite
    everywhere.

    Args:
        kind_a: Kind of A, a key of `SUPPORT`.
        a: Parameters of A, components of shape ``(pair, world)`` (vertices ``(vertex, pair, world)``).
        pose_a: Pose of A; its rotation may be missing where the shape needs none.
        kind_b: Kind of B.
        b: Parameters of B.
        pose_b: Pose of B.
    """
    shapes = difference(kind_a, a, pose_a, kind_b, b, pose_b)
    frozen: Difference = compute_once(lax.stop_gradient(shapes), shapes.position.x)
    closest = polish(shapes, _search(frozen))
    gap = dot(closest.normal, closest.point_b - closest.point_a)
    point_a, point_b = closest.point_a * shapes.scale, closest.point_b * shapes.scale
    separation = gap * shapes.scale
    if (inflation := SUPPORT[kind_a].inflation) is not None:
        point_a, separation = point_a + closest.normal * inflation(a), separation - inflation(a)
    if (inflation := SUPPORT[kind_b].inflation) is not None:
        point_b, separation = point_b - closest.normal * inflation(b), separation - inflation(b)

    def to_world(vector: Vec3) -> Vec3:
        return vector if pose_a.rotation is None else pose_a.rotation.apply(vector)

    return ConvexContact(
        to_world(closest.normal),
        separation,
        pose_a.position + to_world(point_a),
        pose_a.position + to_world(point_b),
        _feature(closest.ties),
        closest.converged,
    )


def _search(shapes: Difference) -> Simplex:
    """Closest simplex of two shapes; of overlapping ones after pulling them apart along the least overlap.

    Both searches are turns of one loop, so that they are compiled once.
    """
    number = shapes.position.x.dtype
    curved = any(SUPPORT[kind].rim_radius is not None for kind in (shapes.kind_a, shapes.kind_b))
    iterations = CURVED_ITERATIONS[str(number)] if curved else POLYTOPE_ITERATIONS

    def turn(index: Array, state: tuple[Simplex, Vec3, Vec3]) -> tuple[Simplex, Vec3, Vec3]:
        before, start, shift = state
        wanted = (index == 0) | before.overlap
        found = gjk(shapes, start, shift, wanted, iterations)
        kept = jax.tree.map(lambda new, old: jnp.where(wanted, new, old), found, before)
        deep = (index == 0) & found.overlap
        least = epa(shapes, deep, PENETRATION_ITERATIONS)
        kept = kept._replace(overlap=jnp.where(index == 0, found.overlap, before.overlap))
        return kept, least.direction, where(deep, least.direction * (least.depth + LIFT), shift)

    zero = jnp.zeros_like(shapes.position.x)
    vector = Vec3(zero, zero, zero)
    none = jnp.zeros(zero.shape, jnp.int32)
    simplex = Simplex(vector, (none, none, none), vector, vector, none < 0, none < 0)
    return lax.fori_loop(0, 2, turn, (simplex, shapes.position, vector))[0]


def _feature(ties: Ties) -> Array:
    """Least and largest of the tied piece pairs, which name the feature pair."""
    first, second, third = ties.pieces
    second = jnp.where(ties.two, second, first)
    third = jnp.where(ties.three, third, first)
    low = jnp.minimum(first, jnp.minimum(second, third))
    high = jnp.maximum(first, jnp.maximum(second, third))
    return low + CODES * CODES * high
