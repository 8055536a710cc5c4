"""Penetration depth of two convex shapes: an expanding polytope kept as a partition of directions, worlds last.

The depth is the least value of the support function h of A - B over all unit directions. The expanding polytope algorithm
(G. van den Bergen, Game Developers Conference 2001) bounds h from below by that of the hull of the support points found so
far and samples it where the bound is least, until the two agree: then the depth is the *global* minimum. Its usual form
rebuilds the hull, with a horizon of varying length, at every step. Here the sphere of directions is cut into spherical
triangles with sampled corners instead. Inside a triangle h is bounded by its three support points alone, so a sample
touches one triangle, which is replaced by three (two if the sample lies on a side): no adjacency, no horizon, and the
new entries of the table sit at the same place in every lane. The triangles cover all directions from the start, so no
simplex that contains the origin is needed either.

Every triangle proves something for itself, so a minimum in the middle of one, with the three points of its face in three
different triangles, is approached from all sides for ever. A minimum at a *corner* of the partition is settled at once.
Hence the frame of the first eight triangles is turned to the seed: a direction that is a local minimum already.

Over a triangle the maximum of its three linear functions is least at a corner (sampled), at the crossing of two of them
on a side, or where all three are equal: the normal of the face they span.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.collision.convex.difference import Difference, unit
from mathota_jax.spatial.settle import settle_code
from mathota_jax.spatial.vector import Vec3, cross, dot, tangent_basis, where

CORNERS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
OCTANTS = ((0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5))
"""Counter-clockwise seen from outside, and so are their descendants."""
BASE = 128
"""Corner numbers of a triangle are the digits of one number, exact in float32, in this base."""
INNER, VOID = 3, 4
"""Where the bound of a triangle is least: side 0 (corners 1, 2), 1, 2; the common normal; only at its corners."""
SLIVER_ROUNDING = 256.0
"""The common normal must be lower than a side by this many round-offs of the size to be sampled before it."""
FLAT_ROUNDING = 64.0
"""Three points whose angle is below this many round-offs span no face: their normal is noise."""
SAME_ROUNDING = 16.0
"""Points closer than this many round-offs of the size are the same: where they cross is noise, and a direction that
leaves its triangle would leave a hole in the partition. What is passed over so is lower by no more than that."""


class Penetration(NamedTuple):
    """What a search found.

    Attributes:
        direction: Unit direction of least overlap seen, from A to B.
        depth: Depth [size] along it: an upper bound of the least depth.
        lower: Proved lower bound [size] of the least depth.
        seed_depth: Depth [size] along the seed.
    """

    direction: Vec3
    depth: Array
    lower: Array
    seed_depth: Array


class _State(NamedTuple):
    turn: Array
    corners: Vec3
    points: Vec3
    triangles: Array
    bounds: Array
    best: Array
    direction: Vec3
    done: Array


def epa(
    shapes: Difference, seed: Vec3, wanted: Array, limit: Array | int, capacity: int, tolerance: float
) -> Penetration:
    """Least overlap of two shapes that overlap.

    Args:
        shapes: The shapes, not differentiated.
        seed: Unit direction from A to B, best a local minimum of the depth.
        wanted: bool ``(pair, world)``, False where the result is not needed. Those lanes stop at once.
        limit: Most iterations, at most `capacity`. All lanes stop as soon as they have converged.
        capacity: Static size of the tables in iterations, at most ``BASE - 6``.
        tolerance: The depth is searched to this share of the size.
    """
    number = shapes.position.x.dtype
    lanes = jnp.shape(wanted)
    frame = (seed, *tangent_basis(seed))
    assert len(CORNERS) + capacity <= BASE

    def sample_corner(corner: Array) -> tuple[Vec3, Vec3, Array]:
        direction = frame[0] * corner[0] + frame[1] * corner[1] + frame[2] * corner[2]
        return direction, *_sample(shapes, direction)

    axes, points, heights = lax.map(sample_corner, jnp.asarray(CORNERS, number))
    lowest = settle_code(jnp.argmin(heights, axis=0).astype(number))
    octants = np.array(OCTANTS)

    def of_octants(vectors: Vec3) -> tuple[Vec3, ...]:
        return tuple(vectors.map(lambda c, k=k: c[octants[:, k]]) for k in range(3))

    bounds, _ = _least(of_octants(axes), of_octants(points))
    rest = jnp.zeros((capacity, *lanes), number)
    infinite = jnp.full((3 * capacity, *lanes), jnp.inf, number)
    numbers = np.concatenate([octants @ [1, BASE, BASE * BASE], np.zeros(3 * capacity)])
    state = _State(
        turn=jnp.zeros((), jnp.int32),
        corners=axes.map(lambda c: jnp.concatenate([c, rest])),
        points=points.map(lambda c: jnp.concatenate([c, rest])),
        triangles=jnp.broadcast_to(
            jnp.asarray(numbers, number).reshape(-1, *(1,) * len(lanes)), (len(numbers), *lanes)
        ),
        bounds=jnp.concatenate([bounds, infinite]),
        best=_row(heights, lowest),
        direction=axes.map(lambda c: _row(c, lowest)),
        done=~wanted,
    )

    def advance(state: _State) -> _State:
        slot = settle_code(jnp.argmin(state.bounds, axis=0).astype(number))
        bound = _row(state.bounds, slot)
        done = state.done | (bound >= state.best - tolerance)
        name = _row(state.triangles, slot).astype(jnp.int32)
        indices = [name % BASE, name // BASE % BASE, name // (BASE * BASE)]
        corners = tuple(state.corners.map(lambda c, i=i: _row(c, i)) for i in indices)
        points = tuple(state.points.map(lambda c, i=i: _row(c, i)) for i in indices)
        _, choice = _least(corners, points)
        direction = _split(corners, points, choice)
        point, height = _sample(shapes, direction)

        new = state.turn + len(CORNERS)
        first_corners, second_corners = (_stack([corners[i] for i in ids]) for ids in ((1, 2, 0), (2, 0, 1)))
        first_points, second_points = (_stack([points[i] for i in ids]) for ids in ((1, 2, 0), (2, 0, 1)))
        child_bounds, _ = _least((first_corners, second_corners, direction), (first_points, second_points, point))
        # A sample on a side makes two triangles, not three.
        void = (jnp.arange(3)[:, None, None] == choice) | done
        child_bounds = jnp.where(void, jnp.inf, child_bounds)
        names = [indices[i] + BASE * indices[j] + BASE * BASE * new for i, j in ((1, 2), (2, 0), (0, 1))]
        first = len(OCTANTS) + 3 * state.turn
        bounds = jnp.where((jnp.arange(state.bounds.shape[0])[:, None, None] == slot) & ~done, jnp.inf, state.bounds)
        improves = ~done & (height < state.best)
        return _State(
            turn=state.turn + 1,
            corners=_put(state.corners, direction, new),
            points=_put(state.points, point, new),
            triangles=lax.dynamic_update_slice_in_dim(state.triangles, jnp.stack(names).astype(number), first, 0),
            bounds=lax.dynamic_update_slice_in_dim(bounds, child_bounds, first, 0),
            best=jnp.where(improves, height, state.best),
            direction=where(improves, direction, state.direction),
            done=done,
        )

    state = lax.while_loop(lambda s: (s.turn < limit) & ~jnp.all(s.done), advance, state)
    lower = jnp.minimum(state.best, jnp.min(state.bounds, axis=0))  # the bounds leave out the sampled corners
    return Penetration(state.direction, state.best, lower, heights[0])


def _row(table: Array, index: Array) -> Array:
    return jnp.take_along_axis(table, index[None], axis=0, mode="promise_in_bounds")[0]


def _stack(vectors: list[Vec3]) -> Vec3:
    return Vec3(*(jnp.stack(components) for components in zip(*vectors, strict=True)))


def _put(table: Vec3, value: Vec3, index: Array) -> Vec3:
    return Vec3(
        *(lax.dynamic_update_slice_in_dim(t, v[None], index, axis=0) for t, v in zip(table, value, strict=True))
    )


def _sample(shapes: Difference, direction: Vec3) -> tuple[Vec3, Array]:
    """Support point of A - B along a unit direction from A to B, and its height."""
    point, _ = shapes.least(direction)
    return -point, -dot(point, direction)


def _crossing(corners: tuple, points: tuple, i: int, j: int) -> tuple[Vec3, Array, Array]:
    """Where the functions of corners i and j are equal on the side between them: direction, bound, is it proper."""
    gap = points[j] - points[i]
    # Both are non-negative, for each point is extreme at its own corner; 0 where the points tie there.
    weight_i, weight_j = dot(gap, corners[j]), -dot(gap, corners[i])
    direction = corners[i] * weight_i + corners[j] * weight_j
    squared = dot(direction, direction)
    noise = SAME_ROUNDING * float(jnp.finfo(squared.dtype).eps)
    proper = (weight_i > noise) & (weight_j > noise)
    bound = dot(points[i], direction) * lax.rsqrt(jnp.where(proper, squared, 1.0))
    return direction, jnp.where(proper, bound, jnp.inf), proper


def _least(corners: tuple, points: tuple) -> tuple[Array, Array]:
    """Least bound of h inside a triangle (infinite if that is at its corners), and the settled place of it."""
    best, code = None, None
    for side, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        _, bound, _ = _crossing(corners, points, i, j)
        if best is None or code is None:
            best, code = bound, jnp.zeros_like(bound)
        else:
            better = bound < best
            best, code = jnp.where(better, bound, best), jnp.where(better, float(side), code)
    assert best is not None
    assert code is not None
    eps = float(jnp.finfo(best.dtype).eps)
    edge, other = points[1] - points[0], points[2] - points[0]
    normal = cross(edge, other)
    squared = dot(normal, normal)
    shortest = jnp.minimum(jnp.minimum(dot(edge, edge), dot(other, other)), dot(other - edge, other - edge))
    flat = squared <= (FLAT_ROUNDING * eps) ** 2 * dot(edge, edge) * dot(other, other)
    flat |= shortest <= (SAME_ROUNDING * eps) ** 2
    weights = [dot(normal, cross(corners[i], corners[j])) for i, j in ((1, 2), (2, 0), (0, 1))]
    positive = (weights[0] > 0) & (weights[1] > 0) & (weights[2] > 0)
    negative = (weights[0] < 0) & (weights[1] < 0) & (weights[2] < 0)
    inner = (positive | negative) & ~flat
    height = jnp.where(negative, -1.0, 1.0) * dot(points[0], normal) * lax.rsqrt(jnp.where(inner, squared, 1.0))
    # A normal that all but lies on a side would leave a sliver with the same bound for ever: cut the side instead.
    code = jnp.where(inner & (height < best - SLIVER_ROUNDING * eps), float(INNER), code)
    best = jnp.where(inner, jnp.minimum(height, best), best)
    return best, settle_code(jnp.where(best < jnp.inf, code, float(VOID)))


def _split(corners: tuple, points: tuple, choice: Array) -> Vec3:
    """Unit direction of the place `choice` of a triangle."""
    normal = cross(points[1] - points[0], points[2] - points[0])
    middle = corners[0] + corners[1] + corners[2]
    sign = jnp.where(dot(normal, middle) < 0, -1.0, 1.0)
    direction = normal * sign
    for side, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        direction = where(choice == side, _crossing(corners, points, i, j)[0], direction)
    return unit(where(choice == VOID, middle, direction), middle)
