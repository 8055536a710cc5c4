"""The direction that separates two convex polytopes best, by trying all that can: exact, and proved by completeness.

The separation along a direction is linear over each cell of the common refinement of both Gauss maps, so its maximum over
the unit sphere, where the polytopes overlap (the depth), lies at a corner of the refinement: at a face normal of A, at one
of B reversed, or where an arc of A crosses a reversed arc of B, along the cross product of two edges. Source: D. Gregorius,
"The Separating Axis Test between Convex Polyhedra" (Game Developers Conference 2013).
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.candidates import best_candidate, pick
from mathota_jax.collision.convex.difference import Difference
from mathota_jax.collision.convex.polytope import Edges, Polytope, row_count
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.vector import Mat3, Vec3, cross, dot, where

EDGES = 256 * 42
"""Edges of B in all pairs that are tested at a time: they fit into the cache of a core (42: of 16 corners)."""
ARC_ROUNDING = 8.0
"""Arcs must cross by this many round-offs. A crossing within less of an end is no deeper than the face there, to the same
round-off of the size, while its direction may be noise."""


class Axis(NamedTuple):
    """Unit direction from A to B and the separation [size] along it, components of shape ``(pair, world)``."""

    direction: Vec3
    separation: Array


class _Placed(NamedTuple):
    a: Polytope
    b: Polytope
    rotation: Mat3
    position: Vec3


def separating_axis(shapes: Difference, a: Polytope, b: Polytope, wanted: Array) -> Axis:
    """Direction of largest separation of two polytopes, over all directions if they overlap.

    Args:
        shapes: The shapes, not differentiated.
        a: The core of A, in its own frame and in units of the size.
        b: The core of B.
        wanted: bool ``(pair, world)``, False where the result is not needed. Those pairs cost next to nothing.

    Returns:
        The axis, in the frame of A; anything finite where it is not wanted.
    """
    placed = _Placed(a, b, shapes.rotation, shapes.position)
    none = jax.tree.map(jnp.zeros_like, Axis(shapes.position, shapes.position.x))
    lanes = EDGES // (1 if b.edges is None else row_count(b.edges))
    test = _best if wanted.size <= lanes else functools.partial(_best_of_some, wanted, lanes)
    return lax.cond(jnp.any(wanted), test, lambda _: none, placed)


def _best_of_some(wanted: Array, lanes: int, placed: _Placed) -> Axis:
    """`_best` of the pairs that are wanted, `lanes` at a time."""
    flat = jax.tree.map(lambda x: _flatten(x, wanted.shape), placed)
    order = jnp.argsort(~wanted.reshape(-1), stable=True)
    count = jnp.sum(wanted, dtype=jnp.int32)

    def test_some(state: tuple[Array, Axis]) -> tuple[Array, Axis]:
        turn, found = state
        chosen = lax.dynamic_slice_in_dim(order, turn * lanes, lanes)
        some = jax.tree.map(lambda x: x if x.shape[-1] == 1 else jnp.take(x, chosen, axis=-1), flat)
        axis = _best(some)
        return turn + 1, jax.tree.map(lambda all_, new: all_.at[0, chosen].set(new[0]), found, axis)

    zero = jnp.zeros((1, wanted.size), placed.position.x.dtype)
    state = jnp.zeros((), jnp.int32), Axis(Vec3(zero, zero, zero), zero)
    _, found = lax.while_loop(lambda s: s[0] * lanes < count, test_some, state)
    return jax.tree.map(lambda x: x.reshape(wanted.shape), found)


def _flatten(values: Array, lanes: tuple[int, ...]) -> Array:
    """(..., pair, world) as (..., 1, lane); what all share stays as it is."""
    if values.shape[-2:] == (1, 1):
        return values
    return jnp.broadcast_to(values, (*values.shape[:-2], *lanes)).reshape(*values.shape[:-2], 1, -1)


def _best(placed: _Placed) -> Axis:
    """`separating_axis` of all pairs of a table."""
    a, b, rotation, position = placed
    number = position.x.dtype
    normals_b = compute_once(rotation.apply(b.normals), position.x)
    separation_a = dot(a.normals, position) - _support(a.vertices, a.normals)
    separation_a -= _support(b.vertices, -rotation.apply_transposed(a.normals))
    separation_b = -dot(normals_b, position) - _support(b.vertices, b.normals) - _support(a.vertices, -normals_b)
    best_a, face_a = best_candidate(separation_a)
    best_b, face_b = best_candidate(separation_b)
    by_b = settle_code((best_b > best_a).astype(number)) == 1
    direction = where(by_b, -pick(normals_b, face_b), pick(a.normals, face_a))
    best = jnp.where(by_b, best_b, best_a)
    if a.edges is None or b.edges is None:
        return Axis(direction, best)
    crossed = _best_crossing(a.edges, _turned(b.edges, rotation, position))
    by_edges = settle_code((crossed.separation > best).astype(number)) == 1
    return Axis(where(by_edges, crossed.direction, direction), jnp.where(by_edges, crossed.separation, best))


def _support(vertices: Vec3, directions: Vec3) -> Array:
    """Largest height of the vertices along each direction (row, pair, world)."""
    return jnp.max(dot(vertices.map(lambda c: c[:, None]), directions.map(lambda c: c[None])), axis=0)


def _turned(edges: Edges, rotation: Mat3, position: Vec3) -> Edges:
    turned = Edges(rotation.apply(edges.start) + position, *(rotation.apply(v) for v in edges[1:]))
    return compute_once(turned, position.x)


def _best_crossing(a: Edges, b: Edges) -> Axis:
    """Best direction across an edge of A and one of B; the separation is the lowest number if no arcs cross."""

    def of_edge(_: None, edge: Edges) -> tuple[None, Array]:
        return None, jnp.max(_crossing(edge, b)[1], axis=0)

    count = row_count(a)
    rows = jax.tree.map(lambda c: jnp.broadcast_to(c, (count, *c.shape[1:])), a)
    _, scores = lax.scan(of_edge, None, rows)
    _, chosen = best_candidate(scores)
    edge_a = compute_once(pick(rows, chosen), scores)
    score, chosen = best_candidate(_crossing(edge_a, b)[1])
    count = row_count(b)
    edge_b = pick(jax.tree.map(lambda c: jnp.broadcast_to(c, (count, *c.shape[1:])), b), chosen)
    across, _ = _crossing(edge_a, edge_b)
    squared = dot(across, across)
    usable = score > jnp.finfo(score.dtype).min
    direction = across * lax.rsqrt(jnp.where(usable, squared, 1.0))
    separation = dot(direction, edge_b.start - edge_a.start)
    return Axis(direction, jnp.where(usable, separation, score))


def _crossing(a: Edges, b: Edges) -> tuple[Vec3, Array]:
    """Cross product of two edges, outward from A, and a number that grows with the separation along it.

    The number is ``separation * |separation|``, which needs no root, or the lowest one if the arcs do not cross.
    """
    from_left, from_right = dot(a.left, b.along), dot(a.right, b.along)
    to_left, to_right = dot(b.left, a.along), dot(b.right, a.along)
    number = from_left.dtype
    least = ARC_ROUNDING * float(jnp.finfo(number).eps)
    # Outward from A the product runs along a.along x b.along if A's left normal looks along B's edge.
    sign = jnp.where(from_left > 0, 1.0, -1.0).astype(number)
    crossing = jnp.minimum(
        jnp.minimum(sign * from_left, -sign * from_right), jnp.minimum(sign * to_left, -sign * to_right)
    )
    across = cross(a.along, b.along) * sign
    height = dot(across, b.start - a.start)
    squared = dot(across, across)
    usable = (crossing > least) & (squared > 0)
    score = height * jnp.abs(height) / jnp.where(usable, squared, 1.0)
    return across, jnp.where(usable, score, jnp.finfo(number).min)
