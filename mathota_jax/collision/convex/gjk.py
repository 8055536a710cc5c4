"""Distance of two convex shapes: the GJK algorithm with a bounded number of iterations, worlds last.

Sources: E. Gilbert, D. Johnson, S. Keerthi, IEEE J. Robotics and Automation 4(2), 1988; G. van den Bergen, "Collision
Detection in Interactive 3D Environments" (2003), chapter 4. Only sub-simplices that contain the newest point are
evaluated; a triangle's closest point is ``n (n . w) / |n|^2``, which stays exact when it is small.

Nothing here is differentiated: the result is a discrete one, the piece pairs of the closest simplex, with a direction.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.convex.difference import Difference, barycentric, combine, unit
from mathota_jax.collision.convex.polytope import are_polytopes
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.vector import Vec3, cross, dot, norm, where

OVERLAP_ROUNDING = 64.0
"""Distances below this many round-offs of the size count as overlap: their direction is noise."""
FLAT_ROUNDING = 8.0
"""Three points whose angle is below this many round-offs span no triangle: their normal is noise."""
VERTEX, EDGE, TRIANGLE, INSIDE, KEEP = 0, 1, 4, 7, 8
"""Choices: the newest point alone; with slot 0, 1, 2; with slots (0, 1), (0, 2), (1, 2); all four; the old simplex."""
NEW = 3
"""In place of the number of a slot: the newest point."""
OVERLAPPED = -4.0
"""Less than any separation, in units of the size."""
TRIANGLE_SLOTS = ((0, 1), (0, 2), (1, 2))


class Simplex(NamedTuple):
    """Closest simplex of B - A, and how the search ended.

    Attributes:
        direction: Unit vector from A towards B, shape ``(pair, world)`` a component.
        pieces: Three int32 piece pairs; unused slots repeat the first.
        points: Points of B - A of the piece pairs; None for shapes with rims, where they depend on the direction.
        point_a: The closest point of A, in the frame of A; None for polytopes, whose pieces say where it is.
        point_b: The closest point of B (before the shift), in the frame of A; None for polytopes.
        distance: Length of the vector between the closest points (after the shift).
        overlap: bool, the shapes touch or overlap.
        extreme: Point of B - A that is extreme along the direction; any where they overlap.
        extreme_pieces: int32, its piece pair.
        reach: True separation along the direction, a lower bound; `OVERLAPPED` where they overlap.
    """

    direction: Vec3
    pieces: tuple[Array, ...]
    points: tuple[Vec3, ...] | None
    point_a: Vec3 | None
    point_b: Vec3 | None
    distance: Array
    overlap: Array
    extreme: Vec3
    extreme_pieces: Array
    reach: Array


class _State(NamedTuple):
    """The slots of the simplex side by side, ``(slot, pair, world)``: a third of the kernels."""

    turn: Array
    closest: Vec3
    squared: Array
    points: Vec3
    points_a: Vec3 | None
    pieces: Array
    count: Array
    overlap: Array
    done: Array
    extreme: Vec3
    extreme_pieces: Array


def gjk(shapes: Difference, start: Vec3, shift: Vec3, wanted: Array, iterations: int) -> Simplex:
    """Closest simplex of ``B + shift - A``.

    Args:
        shapes: The shapes, not differentiated.
        start: First search direction, any length.
        shift: Displacement of B in the frame of A.
        wanted: bool, False where the result is not needed: those lanes stop at once.
        iterations: Most iterations. All lanes stop as soon as they have converged. One more sees how far the shapes reach
            along the last direction.
    """
    tracked = not are_polytopes((shapes.kind_a, shapes.kind_b))
    eps = float(jnp.finfo(start.x.dtype).eps)
    noise = (OVERLAP_ROUNDING * eps) ** 2

    def advance(state: _State) -> _State:
        pieces = shapes.pieces(state.closest)
        point_a, point_b = shapes.points(pieces, state.closest)
        if tracked:
            point_a, point_b = compute_once((point_a, point_b), start.x)
        point = compute_once(point_b - point_a + shift, start.x)
        # Lanes whose new point does not come closer along the direction have converged.
        gain = state.squared - dot(state.closest, point)
        reached = (state.count > 0) & (gain <= 8.0 * eps * state.squared + 4.0 * eps * jnp.sqrt(state.squared))
        choice = _choose(state, state.points - point, point, reached | state.done | (state.turn == iterations))
        source = _sources(choice)
        points, points_a, new_pieces = jax.tree.map(
            functools.partial(_follow, source),
            (state.points, state.points_a, state.pieces),
            (point, point_a if tracked else None, pieces),
        )
        closest = _closest(state, points, choice, tracked)
        count = jnp.where(choice >= TRIANGLE, 3, jnp.where(choice >= EDGE, 2, 1))
        overlap = (choice == INSIDE) | ((choice < INSIDE) & (dot(closest, closest) <= noise))
        keep = choice == KEEP
        return _State(
            turn=state.turn + 1,
            closest=closest,
            squared=jnp.where(keep, state.squared, dot(closest, closest)),
            points=points,
            points_a=points_a,
            pieces=new_pieces,
            count=jnp.where(choice >= INSIDE, state.count, count),
            overlap=state.overlap | overlap,
            done=state.done | keep | overlap,
            # A lane that is done keeps its direction, and with it these.
            extreme=point,
            extreme_pieces=pieces,
        )

    zero = jnp.zeros_like(start.x)
    one = zero + 1.0
    first = unit(start, Vec3(one, zero, zero))
    none = jnp.zeros(jnp.shape(zero), jnp.int32)
    slots = first.map(lambda c: jnp.broadcast_to(c, (3, *c.shape)))
    state = _State(
        jnp.zeros((), jnp.int32),
        first,
        zero + jnp.inf,
        slots,
        slots if tracked else None,
        jnp.broadcast_to(none, (3, *none.shape)),
        none,
        none < 0,
        ~wanted | (none < 0),
        first,
        none,
    )
    state = lax.while_loop(lambda s: (s.turn <= iterations) & ~jnp.all(s.done), advance, state)
    used = state.count > lax.broadcasted_iota(jnp.int32, (3, *none.shape), 0)
    slots = jax.tree.map(lambda x: jnp.where(used, x, x[0]), (state.pieces, state.points, state.points_a))
    pieces, points, points_a = zip(*(_slot(slots, k) for k in range(3)), strict=True)
    point_a = point_b = None
    if tracked:
        weights = compute_once(barycentric(points, state.count > 1, state.count > 2), start.x)
        point_a = combine(weights, points_a)
        point_b = point_a + combine(weights, points) - shift
    direction, distance = unit(state.closest, first), norm(state.closest)
    extreme = state.extreme - shift
    return Simplex(
        direction,
        pieces,
        None if tracked else tuple(point - shift for point in points),
        point_a,
        point_b,
        distance,
        state.overlap,
        extreme,
        state.extreme_pieces,
        jnp.where(state.overlap, OVERLAPPED, dot(direction, extreme)),
    )


def _choose(state: _State, edges: Vec3, point: Vec3, stop: Array) -> Array:
    """Settled choice of the sub-simplex of {newest point, slots} closest to the origin, by the edges to the slots."""
    best, code = dot(point, point), jnp.zeros_like(point.x)
    flatness = (FLAT_ROUNDING * float(jnp.finfo(best.dtype).eps)) ** 2
    slots = [_slot(edges, k) for k in range(3)]
    for k, edge in enumerate(slots):
        squared = dot(edge, edge)
        filled = (state.count > k) & (squared > 0)
        t = -dot(point, edge) / jnp.where(filled, squared, 1.0)
        foot = point + edge * t
        distance = dot(foot, foot)
        better = filled & (t > 0) & (t < 1) & (distance < best)
        best, code = jnp.where(better, distance, best), jnp.where(better, float(EDGE + k), code)
    inside = state.count > 2
    for k, (i, j) in enumerate(TRIANGLE_SLOTS):
        normal = cross(slots[i], slots[j])
        squared = dot(normal, normal)
        flat = squared <= flatness * dot(slots[i], slots[i]) * dot(slots[j], slots[j])
        filled = (state.count > j) & ~flat
        inverse = 1.0 / jnp.where(filled, squared, 1.0)
        height = dot(normal, point)
        u = dot(normal, cross(slots[j], point)) * inverse
        v = dot(normal, cross(point, slots[i])) * inverse
        distance = height * height * inverse
        better = filled & (u > 0) & (v > 0) & (u + v < 1) & (distance < best)
        best, code = jnp.where(better, distance, best), jnp.where(better, float(TRIANGLE + k), code)
        # The origin lies on the same side of this face as the fourth vertex.
        inside &= dot(normal, slots[3 - i - j]) * height < 0
    code = jnp.where(inside, float(INSIDE), code)
    stalled = stop | (~inside & (best >= state.squared))
    return settle_code(jnp.where(stalled, float(KEEP), code))


def _slot(values: Any, slot: int) -> Any:
    return jax.tree.map(lambda x: x[slot], values)


def _sources(choice: Array) -> Array:
    """For each slot of the simplex of a choice the slot whose content it takes, `NEW` for the newest point."""
    on_edge = (choice >= EDGE) & (choice < TRIANGLE)
    second = jnp.where(on_edge, choice - EDGE, jnp.where(choice == TRIANGLE + 2, 1, 0))
    third = jnp.where(choice == TRIANGLE, 1, 2)
    slot = lax.broadcasted_iota(jnp.int32, (3, *choice.shape), 0)
    return jnp.where(choice >= INSIDE, slot, jnp.where(slot == 0, NEW, jnp.where(slot == 1, second, third)))


def _follow(source: Array, old: Array, new: Array) -> Array:
    """The slots ``(slot, pair, world)`` of a simplex from those before and the newest point."""
    return jnp.where(source == NEW, new, jnp.where(source == 0, old[0], jnp.where(source == 1, old[1], old[2])))


def _closest(state: _State, points: Vec3, choice: Array, tracked: bool) -> Vec3:
    """Point of a chosen simplex closest to the origin."""
    on_edge, on_triangle = (choice >= EDGE) & (choice < TRIANGLE), (choice >= TRIANGLE) & (choice < INSIDE)
    point = _slot(points, 0)
    edge, other = _slot(points, 1) - point, _slot(points, 2) - point
    squared = dot(edge, edge)
    inverse = 1.0 / jnp.where(on_edge, squared, 1.0)
    foot = point - edge * (dot(point, edge) * inverse)
    if not tracked:
        # Across the edge also where cancellation left little. Not for rims: a direction that misses their axis by less
        # than round-off has derivatives that overflow.
        foot = foot - edge * (dot(foot, edge) * inverse)
    normal = cross(edge, other)
    height = normal * (dot(normal, point) / jnp.where(on_triangle, dot(normal, normal), 1.0))
    closest = where(on_triangle, height, where(on_edge, foot, point))
    return where(choice >= INSIDE, state.closest, closest)
