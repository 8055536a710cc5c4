"""The closest points of two convex shapes, apart or overlapping; worlds last and differentiable."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.convex.difference import CODES, Difference, difference
from mathota_jax.collision.convex.polish import Closest, polish
from mathota_jax.collision.convex.polytope import are_polytopes, polytope
from mathota_jax.collision.convex.polytope_solution import solve_polytopes
from mathota_jax.collision.convex.search import search_curved, search_polytopes
from mathota_jax.collision.convex.support import SUPPORT
from mathota_jax.collision.convex.ties import Ties
from mathota_jax.collision.polyhedron import TOPOLOGY
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Vec3, dot, norm

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
        a: Parameters of A, components of shape ``(pair, world)``; of a polyhedron vertices ``(vertex, pair, world)`` and
            static "faces", int32 ``(pair, face, corner)``, or as in `collision.polyhedron.polyhedra_of_places`.
        pose_a: Pose of A; its rotation may be missing where the shape needs none.
        kind_b: Kind of B.
        b: Parameters of B.
        pose_b: Pose of B.
    """
    shapes = difference(kind_a, a, pose_a, kind_b, b, pose_b)
    tolerance = PROVED[str(shapes.position.x.dtype)][0 if are_polytopes((kind_a, kind_b)) else 1]
    frozen: Difference = compute_once(lax.stop_gradient(shapes), shapes.position.x)
    if are_polytopes((kind_a, kind_b)):
        core_a, core_b = polytope(kind_a, frozen.a | _topology(a)), polytope(kind_b, frozen.b | _topology(b))
        searched, upper = search_polytopes(frozen, core_a, core_b, tolerance)
        solution = solve_polytopes(frozen, searched)
    else:
        searched, solution, upper = search_curved(frozen, tolerance)
    closest = polish(shapes, searched, solution)
    # Stored, as the result is: each kernel of the faces would polish again for itself.
    fields = {"normal": closest.normal, "point_a": closest.point_a, "point_b": closest.point_b}
    closest = closest._replace(**compute_once(fields, shapes.position.x))
    gap = dot(closest.normal, closest.point_b - closest.point_a)
    point_a, point_b = closest.point_a * shapes.scale, closest.point_b * shapes.scale
    separation = gap * shapes.scale
    if (inflation := SUPPORT[kind_a].inflation) is not None:
        point_a, separation = point_a + closest.normal * inflation(a), separation - inflation(a)
    if (inflation := SUPPORT[kind_b].inflation) is not None:
        point_b, separation = point_b - closest.normal * inflation(b), separation - inflation(b)

    def to_world(vector: Vec3) -> Vec3:
        return vector if pose_a.rotation is None else pose_a.rotation.apply(vector)

    point_a, point_b = pose_a.position + to_world(point_a), pose_a.position + to_world(point_b)
    normal, separation, point_a, point_b = compute_once(
        (to_world(closest.normal), separation, point_a, point_b), separation
    )
    return ConvexContact(
        normal,
        separation,
        point_a,
        point_b,
        _feature(closest.ties),
        _proved(lax.stop_gradient(closest), upper, tolerance),
    )


def _proved(closest: Closest, upper: Array, tolerance: float) -> Array:
    """Whether the separation along the normal, a lower bound, reaches an upper one.

    Args:
        closest: The closest points, not differentiated; points outside of their shapes prove nothing.
        upper: Upper bound of the separation [size] from the search.
        tolerance: The two count as equal to this share of the size.
    """
    between = norm(closest.point_b - closest.point_a) + closest.excess
    upper = jnp.minimum(upper, jnp.where(closest.inside, between, jnp.inf))
    return closest.consistent & (closest.reach >= upper - tolerance)


def _topology(shape: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in shape.items() if name in TOPOLOGY}


def _feature(ties: Ties) -> Array:
    """Least and largest of the tied piece pairs, which name the feature pair."""
    first, second, third = ties.pieces
    second = jnp.where(ties.two, second, first)
    third = jnp.where(ties.three, third, first)
    low = jnp.minimum(first, jnp.minimum(second, third))
    high = jnp.maximum(first, jnp.maximum(second, third))
    return low + CODES * CODES * high
