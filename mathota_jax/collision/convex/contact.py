"""The closest points of two convex shapes, apart or overlapping; worlds last and differentiable."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.convex.difference import CODES, Difference, difference
from mathota_jax.collision.convex.epa import epa
from mathota_jax.collision.convex.gjk import Simplex, gjk
from mathota_jax.collision.convex.polish import Closest, Ties, polish
from mathota_jax.collision.convex.support import SUPPORT
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Vec3, dot, norm

POLYTOPE_ITERATIONS = 16
CURVED_ITERATIONS = {"float32": 24, "float64": 40}
"""Most iterations of the distance search."""
GLANCE, POLYTOPE_PROOF, CURVED_PROOF = 16, 48, 110
"""Most iterations of the penetration search: of the first, which looks for a seed, and of those that prove it."""
PROOFS = 2
"""Proofs in a row: each starts from what the one before found in place of its seed."""
LIFT = 0.01
"""Overlapping shapes are pulled apart, along the direction of least overlap, to this gap (share of the size): their
closest points are then those of the overlap, and the distance search finds the pieces they lie on."""
LIFT_RATIO = {"float32": 0.3, "float64": 0.01}
"""Each later search lifts less: from a direction that is no minimum yet the answer moves the further the lower the lift,
while its rounding grows."""
CLOSE = 1e-3
"""Shapes that are apart by less than this share of the size are searched like overlapping ones if the distance search
fails to prove its answer; further apart the polish repairs it."""
PROVED = {"float32": (1e-5, 1e-5), "float64": (1e-10, 5e-7)}
"""A separation counts as converged if it is proved to this share of the size: polytopes; pairs with a cylinder or cone,
where the bounds of the search approach each other slowly while the answer is exact long before."""


class ConvexContact(NamedTuple):
    """Closest points of two shapes; components of shape ``(pair, world)``.

    Attributes:
        normal: Unit vector from A to B, world frame.
        separation: Signed gap [m] along the normal, negative when overlapping.
        point_a: World point [m] on the surface of A; ``point_b = point_a + separation * normal``.
        point_b: World point [m] on the surface of B.
        feature: int32 id of the pieces in contact, the same whatever the order in which the search found them.
        converged: bool, the separation is proved: by closest points inside both shapes if they are apart, by the bound of
            the penetration search if they overlap. Elsewhere the result is the best found: a lower bound.
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
    searched, upper = _search(frozen)
    closest = polish(shapes, searched)
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
        proved(frozen, lax.stop_gradient(closest), upper),
    )


class _Search(NamedTuple):
    simplex: Simplex
    start: Vec3
    shift: Vec3
    lift: Array
    overlap: Array
    upper: Array
    done: Array


def _search(shapes: Difference) -> tuple[Simplex, Array]:
    """Closest simplex of two shapes, and an upper bound of their separation.

    Overlapping shapes are searched again after pulling them apart along the least overlap. Where the penetration search
    was not done, that yields a direction that is at least a local minimum: the seed of the next one. All searches are
    turns of one loop, so that they are compiled once.
    """
    number = shapes.position.x.dtype
    curved, tolerance = _curved(shapes), _tolerance(shapes)
    iterations = CURVED_ITERATIONS[str(number)] if curved else POLYTOPE_ITERATIONS
    proof = CURVED_PROOF if curved else POLYTOPE_PROOF

    def turn(index: Array, state: _Search) -> _Search:
        found = gjk(shapes, state.start, state.shift, ~state.done, iterations)
        simplex = jax.tree.map(lambda new, old: jnp.where(state.done, old, new), found, state.simplex)
        first = index == 0
        apart = norm(found.point_b - found.point_a)
        # Close to touch the distance search may stall on a needle of a simplex: it proves nothing about the direction.
        stalled = (apart < CLOSE) & (dot(found.direction, shapes.least(found.direction)[0]) < apart - tolerance)
        overlap = jnp.where(first, found.overlap, state.overlap)
        wanted = jnp.where(first, found.overlap | stalled, ~state.done)
        limit = jnp.where(first, GLANCE, jnp.where(index <= PROOFS, proof, 0))
        least = epa(shapes, simplex.direction, wanted, limit, proof, tolerance)
        upper = jnp.where(first, jnp.where(overlap, jnp.inf, apart), state.upper)
        upper = jnp.where(overlap & wanted, jnp.minimum(upper, -least.lower), upper)
        # The first seed is none. Later a lane keeps the simplex of its seed unless the search found a better direction.
        done = ~wanted | (~first & (least.depth >= least.seed_depth - tolerance))
        lift = state.lift * LIFT_RATIO[str(number)]
        return _Search(
            simplex, least.direction, least.direction * (least.depth + state.lift), lift, overlap, upper, done
        )

    zero = jnp.zeros_like(shapes.position.x)
    vector = Vec3(zero, zero, zero)
    none = jnp.zeros(zero.shape, jnp.int32)
    simplex = Simplex(vector, (none, none, none), vector, vector, none < 0)
    state = _Search(simplex, shapes.position, vector, jnp.asarray(LIFT, number), none < 0, zero + jnp.inf, none < 0)
    state = lax.fori_loop(0, PROOFS + 2, turn, state)
    return state.simplex, state.upper


def _curved(shapes: Difference) -> bool:
    return any(SUPPORT[kind].rim_radius is not None for kind in (shapes.kind_a, shapes.kind_b))


def _tolerance(shapes: Difference) -> float:
    return PROVED[str(shapes.position.x.dtype)][int(_curved(shapes))]


def proved(shapes: Difference, closest: Closest, upper: Array) -> Array:
    """Whether the separation along the normal, a lower bound, reaches an upper one.

    Args:
        shapes: The shapes, not differentiated.
        closest: The closest points, not differentiated; points outside of their shapes prove nothing.
        upper: Upper bound of the separation [size] from the search.
    """
    lower = dot(closest.normal, shapes.least(closest.normal)[0])
    between = norm(closest.point_b - closest.point_a)
    upper = jnp.minimum(upper, jnp.where(closest.inside, between, jnp.inf))
    return closest.consistent & (lower >= upper - _tolerance(shapes))


def _feature(ties: Ties) -> Array:
    """Least and largest of the tied piece pairs, which name the feature pair."""
    first, second, third = ties.pieces
    second = jnp.where(ties.two, second, first)
    third = jnp.where(ties.three, third, first)
    low = jnp.minimum(first, jnp.minimum(second, third))
    high = jnp.maximum(first, jnp.maximum(second, third))
    return low + CODES * CODES * high
