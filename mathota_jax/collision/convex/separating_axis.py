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
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.settle import compute_once, materialize, settle_code, store
from mathota_jax.spatial.spread import largest_row
from mathota_jax.spatial.vector import Mat3, Vec3, cross, dot, where

EDGES = 64 * 30
"""Edges of B in all pairs that are tested at a time: they stay in the cache beside the core (30: of 12 corners)."""
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
    place = jnp.cumsum(wanted.reshape(-1), dtype=jnp.int32)
    count = place[-1]
    order = jnp.zeros(wanted.size, jnp.int32)
    order = order.at[jnp.where(wanted.reshape(-1), place - 1, wanted.size)].set(jnp.arange(wanted.size), mode="drop")
    by_pair, by_lane = _tables(placed, wanted.shape)

    def test_some(state: tuple[Array, Array]) -> tuple[Array, Array]:
        turn, found = state
        chosen = lax.dynamic_slice_in_dim(order, turn * lanes, lanes)
        leaves = jax.tree.leaves(placed)
        for tables, index in ((by_pair, chosen // wanted.shape[1]), (by_lane, chosen)):
            for places, table in tables:
                some = jnp.take(table, index, axis=-1)
                for at, leaf in zip(places, unstack(some, 0), strict=True):
                    leaves[at] = leaf[..., None, :]
        axis = materialize(_best(jax.tree.unflatten(jax.tree.structure(placed), leaves)))
        return turn + 1, found.at[:, chosen].set(jnp.stack([*axis.direction, axis.separation])[:, 0])

    state = jnp.zeros((), jnp.int32), jnp.zeros((4, wanted.size), placed.position.x.dtype)
    _, found = lax.while_loop(lambda s: s[0] * lanes < count, test_some, state)
    x, y, z, separation = (row.reshape(wanted.shape) for row in unstack(found, 0))
    return Axis(Vec3(x, y, z), separation)


_Tables = list[tuple[list[int], Array]]


def _tables(placed: _Placed, shape: tuple[int, ...]) -> tuple[_Tables, _Tables]:
    """Leaves of one shape stacked, and their numbers: (leaf, ..., pair), and (leaf, ..., lane) where worlds differ.

    What all pairs share is in no table.
    """
    leaves = jax.tree.leaves(placed)
    by_pair, by_lane = [], []
    for size in dict.fromkeys(leaf.shape for leaf in leaves if leaf.shape[-2:] != (1, 1)):
        places = [place for place, leaf in enumerate(leaves) if leaf.shape == size]
        stacked = jnp.stack([leaves[place] for place in places])
        if size[-1] == 1:
            by_pair.append((places, stacked[..., 0]))
        else:
            stacked = jnp.broadcast_to(stacked, (*stacked.shape[:-2], *shape))
            by_lane.append((places, stacked.reshape(*stacked.shape[:-2], -1)))
    return by_pair, by_lane


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
    turned = compute_once(rotation.apply(_packed(b.edges)), position.x)
    crossed = _best_crossing(_packed(a.edges), turned, position)
    by_edges = settle_code((crossed.separation > best).astype(number)) == 1
    return Axis(where(by_edges, crossed.direction, direction), jnp.where(by_edges, crossed.separation, best))


def _support(vertices: Vec3, directions: Vec3) -> Array:
    """Largest height of the vertices along each direction (row, pair, world)."""
    corners = zip(*(unstack(component, 0) for component in vertices), strict=True)
    largest = functools.reduce(jnp.maximum, [dot(Vec3(*corner), directions) for corner in corners])
    return store(largest, largest)


def _packed(edges: Edges) -> Vec3:
    """The four vectors of each edge as one, components (edge, 4, pair, world): a fourth of the kernels to compile."""
    return Vec3(*(jnp.stack(jnp.broadcast_arrays(*components), axis=1) for components in zip(*edges, strict=True)))


def _unpacked(packed: Vec3) -> Edges:
    return Edges(*(packed.map(lambda c, k=k: c[..., k, :, :]) for k in range(4)))


def _best_crossing(a: Vec3, b: Vec3, position: Vec3) -> Axis:
    """Best direction across an edge of A and one of B; the separation is the lowest number if no arcs cross.

    Args:
        a: Packed edges of A.
        b: Packed edges of B, turned into the frame of A.
        position: Of B in the frame of A.
    """

    def of_edge(_: None, edge: Vec3) -> tuple[None, Array]:
        # Stored: a kernel that slices by the counter of the loop is not vectorised.
        score = _crossing(compute_once(edge, position.x), b, position)[1]
        return None, largest_row(compute_once(score, score))

    _, scores = lax.scan(of_edge, None, a)
    _, chosen = best_candidate(scores)
    edge_a = compute_once(pick(a, chosen), scores)
    score, chosen = best_candidate(_crossing(edge_a, b, position)[1])
    edge_b = pick(b, chosen)
    across, _ = _crossing(edge_a, edge_b, position)
    squared = dot(across, across)
    usable = score > jnp.finfo(score.dtype).min
    direction = across * lax.rsqrt(jnp.where(usable, squared, 1.0))
    separation = dot(direction, _unpacked(edge_b).start + position - _unpacked(edge_a).start)
    return Axis(direction, jnp.where(usable, separation, score))


def _crossing(edge_a: Vec3, edge_b: Vec3, position: Vec3) -> tuple[Vec3, Array]:
    """Cross product of two edges, outward from A, and a number that grows with the separation along it.

    The number is ``separation * |separation|``, which needs no root, or the lowest one if the arcs do not cross.
    """
    a, b = _unpacked(edge_a), _unpacked(edge_b)
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
    height = dot(across, b.start + position - a.start)
    squared = dot(across, across)
    usable = (crossing > least) & (squared > 0)
    score = height * jnp.abs(height) / jnp.where(usable, squared, 1.0)
    return across, jnp.where(usable, score, jnp.finfo(number).min)
