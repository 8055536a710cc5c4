"""Distance of two convex shapes: the GJK algorithm with a bounded number of iterations, worlds last.

Sources: E. Gilbert, D. Johnson, S. Keerthi, IEEE J. Robotics and Automation 4(2), 1988; G. van den Bergen, "Collision
Detection in Interactive 3D Environments" (2003), chapter 4. Only sub-simplices that contain the newest point are
evaluated; a triangle's closest point is ``n (n . w) / |n|^2``, which stays exact when it is small.

Nothing here is differentiated: the result is a discrete one, the piece pairs of the closest simplex, with a direction.
"""

from __future__ import annotations

from typing import NamedTuple

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
TRIANGLE_SLOTS = ((0, 1), (0, 2), (1, 2))


class Simplex(NamedTuple):
    """Closest simplex of B - A, and how the search ended.

    Attributes:
        direction: Unit vector from A towards B, shape ``(pair, world)`` a component.
        pieces: Three int32 piece pairs; unused slots repeat the first.
        point_a: The closest point of A, in the frame of A; None for polytopes, whose pieces say where it is.
        point_b: The closest point of B (before the shift), in the frame of A; None for polytopes.
        distance: Length of the vector between the closest points (after the shift).
        overlap: bool, the shapes touch or overlap.
    """

    direction: Vec3
    pieces: tuple[Array, ...]
    point_a: Vec3 | None
    point_b: Vec3 | None
    distance: Array
    overlap: Array


class _State(NamedTuple):
    turn: Array
    closest: Vec3
    squared: Array
    points: tuple[Vec3, ...]
    points_a: tuple[Vec3, ...] | None
    pieces: tuple[Array, ...]
    count: Array
    overlap: Array
    done: Array


def gjk(shapes: Difference, start: Vec3, shift: Vec3, wanted: Array, iterations: int) -> Simplex:
    """Closest simplex of ``B + shift - A``.

    Args:
        shapes: The shapes, not differentiated.
        start: First search direction, any length.
        shift: Displacement of B in the frame of A.
        wanted: bool, False where the result is not needed: those lanes stop at once.
        iterations: Most iterations. All lanes stop as soon as they have converged.
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
        choice = _choose(state, point, reached | state.done)
        closest, points, points_a, new_pieces, count = _apply(
            state, point, point_a if tracked else None, pieces, choice
        )
        overlap = (choice == INSIDE) | ((choice < INSIDE) & (dot(closest, closest) <= noise))
        keep = choice == KEEP
        return _State(
            turn=state.turn + 1,
            closest=closest,
            squared=jnp.where(keep, state.squared, dot(closest, closest)),
            points=points,
            points_a=points_a,
            pieces=new_pieces,
            count=count,
            overlap=state.overlap | overlap,
            done=state.done | keep | overlap,
        )

    zero = jnp.zeros_like(start.x)
    one = zero + 1.0
    first = unit(start, Vec3(one, zero, zero))
    none = jnp.zeros(jnp.shape(zero), jnp.int32)
    state = _State(
        jnp.zeros((), jnp.int32),
        first,
        zero + jnp.inf,
        (first,) * 3,
        (first,) * 3 if tracked else None,
        (none,) * 3,
        none,
        none < 0,
        ~wanted | (none < 0),
    )
    state = lax.while_loop(lambda s: (s.turn < iterations) & ~jnp.all(s.done), advance, state)
    pieces = (
        state.pieces[0],
        jnp.where(state.count > 1, state.pieces[1], state.pieces[0]),
        jnp.where(state.count > 2, state.pieces[2], state.pieces[0]),
    )
    two, three = state.count > 1, state.count > 2
    point_a = point_b = None
    if state.points_a is not None:
        weights = barycentric(state.points, two, three)
        point_a = combine(weights, state.points_a)
        point_b = point_a + combine(weights, state.points) - shift
    return Simplex(unit(state.closest, first), pieces, point_a, point_b, norm(state.closest), state.overlap)


def _choose(state: _State, point: Vec3, stop: Array) -> Array:
    """Settled choice of the sub-simplex of {newest point, slots} closest to the origin."""
    best, code = dot(point, point), jnp.zeros_like(point.x)
    flatness = (FLAT_ROUNDING * float(jnp.finfo(best.dtype).eps)) ** 2
    edges = [slot - point for slot in state.points]
    for k, edge in enumerate(edges):
        squared = dot(edge, edge)
        filled = (state.count > k) & (squared > 0)
        t = -dot(point, edge) / jnp.where(filled, squared, 1.0)
        foot = point + edge * t
        distance = dot(foot, foot)
        better = filled & (t > 0) & (t < 1) & (distance < best)
        best, code = jnp.where(better, distance, best), jnp.where(better, float(EDGE + k), code)
    inside = state.count > 2
    for k, (i, j) in enumerate(TRIANGLE_SLOTS):
        normal = cross(edges[i], edges[j])
        squared = dot(normal, normal)
        flat = squared <= flatness * dot(edges[i], edges[i]) * dot(edges[j], edges[j])
        filled = (state.count > j) & ~flat
        inverse = 1.0 / jnp.where(filled, squared, 1.0)
        height = dot(normal, point)
        u = dot(normal, cross(edges[j], point)) * inverse
        v = dot(normal, cross(point, edges[i])) * inverse
        distance = height * height * inverse
        better = filled & (u > 0) & (v > 0) & (u + v < 1) & (distance < best)
        best, code = jnp.where(better, distance, best), jnp.where(better, float(TRIANGLE + k), code)
        # The origin lies on the same side of this face as the fourth vertex.
        inside &= dot(normal, edges[3 - i - j]) * height < 0
    code = jnp.where(inside, float(INSIDE), code)
    stalled = stop | (~inside & (best >= state.squared))
    return settle_code(jnp.where(stalled, float(KEEP), code))


def _apply(
    state: _State, point: Vec3, point_a: Vec3 | None, pieces: Array, choice: Array
) -> tuple[Vec3, tuple[Vec3, ...], tuple[Vec3, ...] | None, tuple[Array, ...], Array]:
    """Closest point and simplex of a choice: the newest point in slot 0, its companions after it."""
    keep = choice >= INSIDE
    on_edge, on_triangle = (choice >= EDGE) & (choice < TRIANGLE), (choice >= TRIANGLE) & (choice < INSIDE)
    second = jnp.where(on_edge, choice - EDGE, jnp.where(choice == TRIANGLE + 2, 1, 0))
    third = jnp.where(choice == TRIANGLE, 1, 2)

    def pick(index: Array, values: tuple) -> Vec3:
        return where(index == 0, values[0], where(index == 1, values[1], values[2]))

    def pick_code(index: Array, values: tuple) -> Array:
        return jnp.where(index == 0, values[0], jnp.where(index == 1, values[1], values[2]))

    second_point, third_point = pick(second, state.points), pick(third, state.points)
    edge, other = second_point - point, third_point - point
    squared = dot(edge, edge)
    inverse = 1.0 / jnp.where(on_edge, squared, 1.0)
    foot = point - edge * (dot(point, edge) * inverse)
    if point_a is None:
        # Across the edge also where cancellation left little. Not for rims: a direction that misses their axis by less
        # than round-off has derivatives that overflow.
        foot = foot - edge * (dot(foot, edge) * inverse)
    normal = cross(edge, other)
    height = normal * (dot(normal, point) / jnp.where(on_triangle, dot(normal, normal), 1.0))
    closest = where(on_triangle, height, where(on_edge, foot, point))

    def following(new: Vec3, old: tuple[Vec3, ...]) -> tuple[Vec3, ...]:
        return tuple(where(keep, o, n) for o, n in zip(old, (new, pick(second, old), pick(third, old)), strict=True))

    return (
        where(keep, state.closest, closest),
        following(point, state.points),
        None if point_a is None or state.points_a is None else following(point_a, state.points_a),
        (
            jnp.where(keep, state.pieces[0], pieces),
            jnp.where(keep, state.pieces[1], pick_code(second, state.pieces)),
            jnp.where(keep, state.pieces[2], pick_code(third, state.pieces)),
        ),
        jnp.where(keep, state.count, jnp.where(on_triangle, 3, jnp.where(on_edge, 2, 1))),
    )
