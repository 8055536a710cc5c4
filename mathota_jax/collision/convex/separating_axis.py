"""The direction that separates two convex polytopes best, among all that can: exact, and proved by completeness.

The separation along a direction is linear over each cell of the common refinement of both Gauss maps, so its maximum over
the unit sphere, where the polytopes overlap (the depth), lies at a corner of the refinement: at a face normal of A, at one
of B reversed, or where an arc of A crosses a reversed arc of B, along the cross product of two edges. Source: D. Gregorius,
"The Separating Axis Test between Convex Polyhedra" (Game Developers Conference 2013).

Few edges need a test. A direction n between the normals l and r of the faces beside an edge of A is ``a l + b r`` with
a, b >= 0 and ``a + b >= 1``, and any point of B bounds the separation along it: if that point lies below both faces by d or
more, the separation is at most ``-(a + b) d <= -d``. Where d is the depth along the best face normal, such an edge can not
do better. Bodies that touch keep an edge or none of each, hulls of twelve corners that overlap by half their size four.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.candidates import best_candidate, pick
from mathota_jax.collision.convex.difference import Difference
from mathota_jax.collision.convex.polytope import Edges, Polytope
from mathota_jax.spatial.indexing import gather, unstack
from mathota_jax.spatial.settle import compute_once, settle_code, store
from mathota_jax.spatial.vector import Mat3, Vec3, cross, dot, normalize, where
from mathota_jax.spatial.wanted import of_wanted

EDGES = 4
"""Edges of each shape that are tested against each other at a time."""
BITS = 24
"""Of a word of a set: as many as a float32 holds, in which form words are settled."""
ARC_ROUNDING = 8.0
"""Arcs must cross by this many round-offs. A crossing within less of an end is no deeper than the face there, to the same
round-off of the size, while its direction may be noise."""
DEPTH_ROUNDING = 8.0
"""Points count as far below a face as the deepest if they miss it by this many round-offs: corners of a face that lies
flat on another."""


class Axis(NamedTuple):
    """Unit direction from A to B and the separation [size] along it, components of shape ``(pair, world)``."""

    direction: Vec3
    separation: Array


class _Placed(NamedTuple):
    """Polytopes with components (row, lane), B's in its own frame, and its pose in the frame of A.

    Their edges are (4, edge, lane or 1).
    """

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
        The axis, in the frame of A; zeros where it is not wanted.
    """
    (a, edges_a), (b, edges_b) = a.without_edges(), b.without_edges()

    def best(values: tuple[Polytope, Polytope, Mat3, Vec3], wanted: Array) -> Axis:
        a, b, rotation, position = values
        shape = wanted.shape
        a, b = _of_lanes(a, edges_a, shape), _of_lanes(b, edges_b, shape)
        rotation, position, wanted = jax.tree.map(lambda c: _flat(c, shape), (rotation, position, wanted))
        axis = _best(_Placed(a, b, rotation, position), wanted)
        return jax.tree.map(lambda c: c.reshape(shape), axis)

    none = jax.tree.map(jnp.zeros_like, Axis(shapes.position, shapes.position.x))
    return of_wanted(best, wanted, (a, b, shapes.rotation, shapes.position), none)


def _of_lanes(polytope: Polytope, edges: Edges | None, shape: tuple[int, ...]) -> Polytope:
    """A polytope `without_edges`, and theirs, with components (row, lane or 1)."""
    if edges is not None:
        edges = jnp.asarray(edges)
        if polytope.row is not None:
            edges = jnp.take(edges, _flat(polytope.row, shape), axis=-1, mode="clip")
    vertices, normals = jax.tree.map(lambda c: _flat(c, shape), (polytope.vertices, polytope.normals))
    return Polytope(vertices, normals, edges)


def _flat(values: Array, shape: tuple[int, ...]) -> Array:
    """Values (..., pair, world) as (..., lane), or (..., 1) where all pairs share them."""
    if values.shape[-2:] == (1, 1):
        return values[..., 0]
    return jnp.broadcast_to(values, (*values.shape[:-2], *shape)).reshape(*values.shape[:-2], -1)


def _best(placed: _Placed, wanted: Array) -> Axis:
    """`separating_axis` of all lanes; of those that are not wanted (lane,) among the faces alone."""
    a, b, rotation, position = placed
    number = position.x.dtype
    normals_b = compute_once(rotation.apply(b.normals), position.x)
    of_a = _walls(a, dot(a.normals, position), -rotation.apply_transposed(a.normals), b.vertices)
    of_b = _walls(b, -dot(normals_b, position), -normals_b, a.vertices)
    (best_a, face_a), (best_b, face_b) = best_candidate(of_a.separation), best_candidate(of_b.separation)
    by_b = settle_code((best_b > best_a).astype(number)) == 1
    direction = where(by_b, -pick(normals_b, face_b), pick(a.normals, face_a))
    best = jnp.where(by_b, best_b, best_a)
    if a.edges is None or b.edges is None:
        return Axis(direction, best)
    depth = jnp.maximum(-best, 0.0) - DEPTH_ROUNDING * float(jnp.finfo(number).eps)
    crossed = _best_crossing(placed, _untested(of_a, depth, a.edges), _untested(of_b, depth, b.edges), wanted)
    by_edges = settle_code((crossed.separation > best).astype(number)) == 1
    return Axis(where(by_edges, crossed.direction, direction), jnp.where(by_edges, crossed.separation, best))


class _Walls(NamedTuple):
    """Faces of a polytope and the corners of the other.

    Attributes:
        touch: How far a corner must reach inward to touch each face; (face, lane).
        inward: Unit vectors against the normals, in the frame of the corners; components (face, lane).
        corners: Of the other polytope, in its frame; components (corner, lane).
        separation: Along the normal of each face; (face, lane).
    """

    touch: Array
    inward: Vec3
    corners: Vec3
    separation: Array


def _walls(polytope: Polytope, offset: Array, inward: Vec3, corners: Vec3) -> _Walls:
    inward = compute_once(inward, offset)
    touch = offset - _reach(polytope.vertices, polytope.normals)
    touch = store(touch, touch)
    return _Walls(touch, inward, corners, touch - _reach(corners, inward))


def _rows_of(vectors: Vec3) -> list[Vec3]:
    """The vectors (row, lane), one by one."""
    return [Vec3(*row) for row in zip(*(unstack(component, 0) for component in vectors), strict=True)]


def _reach(corners: Vec3, directions: Vec3) -> Array:
    """Largest height of the corners along each direction (row, lane)."""
    largest = functools.reduce(jnp.maximum, [dot(corner, directions) for corner in _rows_of(corners)])
    return store(largest, largest)


Set = list[Array]
"""Numbers from 0 as bits of words, int32."""


def _as_set(members: Sequence[Array], number: Any) -> Set:
    """The set of those k for which ``members[k]`` holds, settled: it is looked up more than once."""
    bits = [jnp.where(member, 2.0 ** (k % BITS), 0.0).astype(number) for k, member in enumerate(members)]
    return [settle_code(functools.reduce(jnp.add, bits[start : start + BITS])) for start in range(0, len(bits), BITS)]


def _untested(walls: _Walls, depth: Array, edges: Any) -> Set:
    """Edges (of each lane) such that no corner of the other polytope lies below both of their faces by `depth` or more."""
    # Summed in another order than in `_reach`: XLA would compute a sum that both need in a kernel for each corner.
    x, y, z = walls.inward
    least = walls.touch + depth
    below = _as_set([(c.z * z - least) + c.y * y + c.x * x >= 0 for c in _rows_of(walls.corners)], depth.dtype)
    pruned = [gather(word, edges[2]) & gather(word, edges[3]) for word in below]
    return _as_set(unstack(functools.reduce(jnp.bitwise_or, pruned) == 0, 0), depth.dtype)


def _lowest(members: Set) -> tuple[Array, Set]:
    """The `EDGES` lowest numbers (place, lane) of a set, if need be the last again or 0, and the set without them."""
    members, number, numbers = list(members), jnp.zeros(members[0].shape, jnp.int32), []
    for _ in range(EDGES):
        found = jnp.zeros(number.shape, bool)
        for k, word in enumerate(members):
            lowest = jnp.where(found, 0, word & -word)
            number = jnp.where(lowest > 0, lax.population_count(lowest - 1) + BITS * k, number)
            members[k] = word ^ lowest
            found |= lowest > 0
        numbers.append(number)
    return jnp.stack(numbers), members


def _is_empty(members: Set) -> Array:
    return functools.reduce(jnp.bitwise_or, members) == 0


class _Edges(NamedTuple):
    """Edges with the outward normals on both sides; components (edge, lane).

    `along` is a unit vector, parallel to ``left x right``.
    """

    start: Vec3
    along: Vec3
    left: Vec3
    right: Vec3


def _edges(polytope: Polytope, numbers: Array) -> _Edges:
    """Edges by number (place, lane)."""
    assert polytope.edges is not None
    ids = _rows(jnp.asarray(polytope.edges), numbers)
    ends = _rows(jnp.stack(polytope.vertices), jnp.concatenate([ids[0], ids[1]]))
    sides = _rows(jnp.stack(polytope.normals), jnp.concatenate([ids[2], ids[3]]))
    count = len(numbers)
    (start, end), (left, right) = ((Vec3(*values[:, :count]), Vec3(*values[:, count:])) for values in (ends, sides))
    return _Edges(start, normalize(end - start), left, right)


def _rows(values: Array, index: Array) -> Array:
    """Rows of (component, row, lane or 1) by number (place, lane): (component, place, lane)."""
    if values.shape[-1] == 1:
        return jnp.take(values[..., 0], index, axis=1, mode="clip")
    return jnp.take_along_axis(values, index[None], axis=1, mode="promise_in_bounds")


class _Search(NamedTuple):
    """What is left of both sets, the edges that are tested next, and the best pair so far."""

    rest: tuple[Set, Set]
    numbers: tuple[Array, Array]
    busy: Array
    best: Array
    pair: tuple[Array, Array]


def _best_crossing(placed: _Placed, left_a: Set, left_b: Set, wanted: Array) -> Axis:
    """Best direction across an edge of A and one of B; the separation is the lowest number if no arcs cross.

    Args:
        placed: The polytopes.
        left_a: Edges of A that are tested.
        left_b: Edges of B that are tested.
        wanted: Lanes whose result is needed. Shapes that are far apart would test every edge.
    """

    def turned(edges: _Edges) -> _Edges:
        return _Edges(*compute_once([placed.rotation.apply(vector) for vector in edges], placed.position.x))

    def test(state: _Search) -> _Search:
        (rest_a, rest_b), (numbers_a, numbers_b) = state.rest, state.numbers
        edges_a, edges_b = _edges(placed.a, numbers_a), turned(_edges(placed.b, numbers_b))
        edges_a = compute_once(jax.tree.map(lambda c: c[:, None], edges_a), placed.position.x)
        score = _crossing(edges_a, jax.tree.map(lambda c: c[None], edges_b), placed.position)[1]
        score, chosen = best_candidate(score.reshape(-1, *score.shape[2:]))
        better = settle_code((score > state.best).astype(score.dtype)) == 1
        found = pick(numbers_a, chosen // EDGES), pick(numbers_b, chosen % EDGES)
        # All edges of B meet some of A, then all of B the next of A.
        done = _is_empty(rest_b)
        busy = state.busy & ~(done & _is_empty(rest_a))
        advanced = _lowest(rest_a)
        numbers_a, rest_a = jax.tree.map(lambda new, old: jnp.where(done, new, old), advanced, (numbers_a, rest_a))
        numbers_b, rest_b = _lowest([jnp.where(done, whole, rest) for whole, rest in zip(left_b, rest_b, strict=True)])
        return _Search(
            (rest_a, rest_b),
            (numbers_a, numbers_b),
            busy,
            jnp.where(better, score, state.best),
            tuple(jnp.where(better, new, old) for new, old in zip(found, state.pair, strict=True)),  # type: ignore[arg-type]
        )

    (numbers_a, rest_a), (numbers_b, rest_b) = _lowest(left_a), _lowest(left_b)
    lowest = jnp.full_like(placed.position.x, jnp.finfo(placed.position.x.dtype).min)
    first = numbers_a[0], numbers_b[0]
    busy = wanted & ~_is_empty(left_a) & ~_is_empty(left_b)
    state = _Search((rest_a, rest_b), (numbers_a, numbers_b), busy, lowest, first)
    state = lax.while_loop(lambda s: jnp.any(s.busy), test, state)
    edge_a, edge_b = (
        jax.tree.map(lambda c: c[0], _edges(polytope, number[None]))
        for polytope, number in zip((placed.a, placed.b), state.pair, strict=True)
    )
    edge_b = turned(edge_b)
    across, _ = _crossing(edge_a, edge_b, placed.position)
    squared = dot(across, across)
    usable = state.best > lowest
    direction = across * lax.rsqrt(jnp.where(usable, squared, 1.0))
    separation = dot(direction, edge_b.start + placed.position - edge_a.start)
    return Axis(direction, jnp.where(usable, separation, lowest))


def _crossing(a: _Edges, b: _Edges, position: Vec3) -> tuple[Vec3, Array]:
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
    height = dot(across, b.start + position - a.start)
    squared = dot(across, across)
    usable = (crossing > least) & (squared > 0)
    score = height * jnp.abs(height) / jnp.where(usable, squared, 1.0)
    return across, jnp.where(usable, score, jnp.finfo(number).min)
