"""Proof of a penetration depth: an expanding polytope kept as a partition of directions, worlds last.

The depth is the least value of the support function h of A - B over all unit directions. The expanding polytope algorithm
(G. van den Bergen, Game Developers Conference 2001) bounds h from below by that of the hull of the support points found so
far and samples it where the bound is low, until none is lower than the best sample: then that is the *global* minimum. Its
usual form rebuilds the hull, with a horizon of varying length, at every step. Here the sphere of directions is cut into
spherical triangles with sampled corners instead. Inside a triangle h is bounded by its three support points alone, so a
sample touches one triangle, which is replaced by three (two if the sample lies on a side): no adjacency and no horizon. The
triangles cover all directions from the start, so no simplex that contains the origin is needed either.

A triangle whose bound is not below the best depth is never looked at again; the others wait on a stack. Since the search
starts from a local minimum, which nearly always is the global one, they have to be cut whatever their order. Taking the
lowest first would need a table of all of them.

Every triangle proves something for itself, so a minimum in the middle of one, with the three points of its face in three
different triangles, is approached from all sides for ever. A minimum at a *corner* of the partition is settled at once.
Hence the frame of the first eight triangles is turned to the seed.

Over a triangle the maximum of its three linear functions is least at a corner (sampled), at the crossing of two of them
on a side, or where all three are equal: the normal of the face they span.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.collision.convex.difference import Difference, unit
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.vector import Vec3, cross, dot, tangent_basis, where

CORNERS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
OCTANTS = ((0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5))
"""Counter-clockwise seen from outside, and so are their descendants."""
STACK = 32
"""Most triangles that wait. What does not fit is not proved."""
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
        direction: Unit direction from A to B of the least overlap seen.
        depth: Depth [size] along it: an upper bound of the least depth.
        lower: Proved lower bound [size] of the least depth.
        seed_depth: Depth [size] along the seed.
    """

    direction: Vec3
    depth: Array
    lower: Array
    seed_depth: Array


class _Stack(NamedTuple):
    """Triangles that wait: names and bounds (row, pair, world), how many (pair, world), and the least bound left out."""

    names: Array
    bounds: Array
    size: Array
    lower: Array

    def push(self, names: Sequence[Array], bounds: Sequence[Array], limit: Array) -> _Stack:
        """With the triangles whose bound is below the limit on top."""
        rows = jnp.arange(self.names.shape[0], dtype=jnp.int32)[:, None, None]
        all_names, all_bounds, size, lower = self
        for name, bound in zip(names, bounds, strict=True):
            fits = (bound < limit) & (size < self.names.shape[0])
            slot = settle_code(jnp.where(fits, size, -1).astype(bound.dtype))
            lower = jnp.where(slot >= 0, lower, jnp.minimum(lower, bound))
            here = rows == slot
            all_names, all_bounds = jnp.where(here, name, all_names), jnp.where(here, bound, all_bounds)
            size = size + (slot >= 0)
        return _Stack(all_names, all_bounds, size, lower)


class _State(NamedTuple):
    turn: Array
    corners: Vec3
    points: Vec3
    stack: _Stack
    best: Array
    direction: Vec3
    done: Array


def epa(
    shapes: Difference, seed: Vec3, half_proved: Array, wanted: Array, capacity: int, tolerance: float
) -> Penetration:
    """Least overlap of two shapes that overlap.

    Args:
        shapes: The shapes, not differentiated.
        seed: Unit direction from A to B, a local minimum of the depth.
        half_proved: bool, nothing within 90 degrees of the seed is less deep by more than the tolerance (`cap`).
        wanted: bool ``(pair, world)``, False where the result is not needed. Those lanes stop at once.
        capacity: Most triangles that are cut, at most ``BASE - 6``. All lanes stop as soon as they have converged.
        tolerance: The depth is searched to this share of the size.
    """
    number = shapes.position.x.dtype
    lanes = jnp.shape(wanted)
    nowhere = float(jnp.finfo(number).max)
    frame = (seed, *tangent_basis(seed))
    assert len(CORNERS) + capacity <= BASE

    def sample_corner(corner: Array) -> tuple[Vec3, Vec3, Array]:
        direction = compute_once(frame[0] * corner[0] + frame[1] * corner[1] + frame[2] * corner[2], seed.x)
        return direction, *_sample(shapes, direction)

    axes, points, heights = lax.map(sample_corner, jnp.asarray(CORNERS, number))
    octants = np.array(OCTANTS)

    def of_octants(vectors: Vec3) -> tuple[Vec3, ...]:
        return tuple(vectors.map(lambda c, k=k: c[octants[:, k]]) for k in range(3))

    bounds, _ = _least(of_octants(axes), of_octants(points))
    at_seed = jnp.asarray((octants == 0).any(1))[:, None, None]
    bounds = compute_once(jnp.where(at_seed & half_proved, nowhere, bounds), seed.x)
    seed_depth = best = heights[0]
    direction = seed
    for corner in range(1, len(CORNERS)):
        better = heights[corner] < best - tolerance
        best = jnp.where(better, heights[corner], best)
        direction = where(better, axes.map(lambda c, k=corner: c[k]), direction)
    rest = jnp.zeros((capacity, *lanes), number)
    nothing = jnp.zeros((STACK, *lanes), number)
    empty = _Stack(nothing, nothing, jnp.zeros(lanes, jnp.int32), jnp.full(lanes, nowhere, number))
    names = [jnp.asarray(float(name), number) for name in octants @ [1, BASE, BASE * BASE]]
    state = _State(
        turn=jnp.zeros((), jnp.int32),
        corners=axes.map(lambda c: jnp.concatenate([c, rest])),
        points=points.map(lambda c: jnp.concatenate([c, rest])),
        stack=empty.push(names, list(bounds), best - tolerance),
        best=best,
        direction=direction,
        done=~wanted,
    )

    def advance(state: _State) -> _State:
        stack, best = state.stack, state.best
        done = state.done | (stack.size == 0)
        top = jnp.maximum(stack.size - 1, 0)
        name = _row(stack.names, top).astype(jnp.int32)
        indices = [name % BASE, name // BASE % BASE, name // (BASE * BASE)]
        corners = tuple(state.corners.map(lambda c, i=i: _row(c, i)) for i in indices)
        points = tuple(state.points.map(lambda c, i=i: _row(c, i)) for i in indices)
        _, choice = _least(corners, points)
        direction = compute_once(_split(corners, points, choice), best)
        point, height = _sample(shapes, direction)

        new = state.turn + len(CORNERS)
        first_corners, second_corners = (_stack([corners[i] for i in ids]) for ids in ((1, 2, 0), (2, 0, 1)))
        first_points, second_points = (_stack([points[i] for i in ids]) for ids in ((1, 2, 0), (2, 0, 1)))
        child_bounds, _ = _least((first_corners, second_corners, direction), (first_points, second_points, point))
        # A sample on a side makes two triangles, not three.
        void = (jnp.arange(3)[:, None, None] == choice) | done
        child_bounds = compute_once(jnp.where(void, nowhere, child_bounds), best)
        names = [indices[i] + BASE * indices[j] + BASE * BASE * new for i, j in ((1, 2), (2, 0), (0, 1))]
        names = [name.astype(number) for name in names]
        improves = ~done & (height < best - tolerance)
        best = jnp.where(improves, height, best)
        popped = stack._replace(size=jnp.where(done, stack.size, top))
        return _State(
            turn=state.turn + 1,
            corners=_put(state.corners, direction, new),
            points=_put(state.points, point, new),
            stack=popped.push(compute_once(names, best), list(child_bounds), best - tolerance),
            best=best,
            direction=where(improves, direction, state.direction),
            done=done,
        )

    state = lax.while_loop(lambda s: (s.turn < capacity) & ~jnp.all(s.done | (s.stack.size == 0)), advance, state)
    waiting = jnp.arange(STACK, dtype=jnp.int32)[:, None, None] < state.stack.size
    lower = jnp.min(jnp.where(waiting, state.stack.bounds, nowhere), axis=0)
    lower = jnp.minimum(jnp.minimum(lower, state.stack.lower), jnp.minimum(state.best, jnp.min(heights, axis=0)))
    return Penetration(state.direction, state.best, lower, seed_depth)


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
    point = compute_once(-shapes.least(direction)[0], direction.x)
    return point, compute_once(dot(point, direction), direction.x)


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
    return direction, jnp.where(proper, bound, float(jnp.finfo(squared.dtype).max)), proper


def _least(corners: tuple, points: tuple) -> tuple[Array, Array]:
    """Least bound of h inside a triangle (the largest number if that is at its corners), and the settled place of it."""
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
    return best, settle_code(jnp.where(best < jnp.finfo(best.dtype).max, code, float(VOID)))


def _split(corners: tuple, points: tuple, choice: Array) -> Vec3:
    """Unit direction of the place `choice` of a triangle."""
    normal = cross(points[1] - points[0], points[2] - points[0])
    middle = corners[0] + corners[1] + corners[2]
    sign = jnp.where(dot(normal, middle) < 0, -1.0, 1.0)
    direction = normal * sign
    for side, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        direction = where(choice == side, _crossing(corners, points, i, j)[0], direction)
    return unit(where(choice == VOID, middle, direction), middle)
