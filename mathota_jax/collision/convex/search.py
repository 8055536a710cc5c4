"""The search for the closest simplex of two convex shapes, apart or overlapping; not differentiated.

The distance search (GJK) finds it for shapes that are apart. Overlapping shapes are pulled apart along the direction of
least overlap: their closest points are then those of the overlap. The direction is found among all that can be the one
for polytopes (`separating_axis`), by an expanding polytope for curved shapes (`epa`).
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.candidates import best_candidate, pick
from mathota_jax.collision.convex.cap import proved_cap
from mathota_jax.collision.convex.difference import Difference
from mathota_jax.collision.convex.epa import Penetration, epa
from mathota_jax.collision.convex.gjk import Simplex, gjk
from mathota_jax.collision.convex.polish import Solution, solve
from mathota_jax.collision.convex.polytope import Polytope
from mathota_jax.collision.convex.separating_axis import separating_axis
from mathota_jax.collision.convex.support import SUPPORT, Parameters
from mathota_jax.collision.convex.ties import Ties
from mathota_jax.spatial.vector import Vec3, dot, where
from mathota_jax.spatial.wanted import of_wanted

POLYTOPE_ITERATIONS = 16
CURVED_ITERATIONS = {"float32": 24, "float64": 40}
"""Most iterations of the distance search."""
PROOF = 120
"""Most iterations of the penetration search."""
PROOFS = 3
"""Proofs in a row: each starts from what the one before found in place of its seed."""
SEEDS = [d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)]
"""Directions in the frame of A among which the first local minimum is looked for, besides the axes of B."""
SIDES = 8
"""Normals of each round side among those."""
LIFT = 0.01
"""Overlapping shapes are pulled apart to this gap (share of the size)."""
LIFT_RATIO = {"float32": 0.3, "float64": 0.01}
"""Each later search lifts less: from a direction that is no minimum yet the answer moves the further the lower the lift,
while its rounding grows."""
CLOSE = 1e-3
"""Shapes that are apart by less than this share of the size are searched like overlapping ones if the distance search
fails to prove its answer; further apart the polish repairs it."""
LOST = 0.5
"""So are shapes further apart of which less than this share of the answer is proved: they may overlap."""


class _Lifted(NamedTuple):
    turn: Array
    simplex: Simplex
    start: Vec3
    shift: Vec3
    upper: Array
    done: Array


def search_polytopes(shapes: Difference, a: Polytope, b: Polytope, tolerance: float) -> tuple[Simplex, Array]:
    """Closest simplex of two polytopes, and an upper bound of their separation.

    Where a better direction than that of the simplex is known, it has this direction, and no distance.

    Args:
        shapes: The shapes, not differentiated.
        a: The core of A, in its own frame and in units of the size.
        b: The core of B.
        tolerance: An answer is good to this share of the size.
    """

    def turn(state: _Lifted) -> _Lifted:
        found = gjk(shapes, state.start, state.shift, ~state.done, POLYTOPE_ITERATIONS)
        first = state.turn == 0
        axis_separation = LIFT - dot(state.shift, state.start)
        # From an axis that all but meets a corner the search returns at once, with the round-off of the lift in its angle.
        lost = ~first & (axis_separation > found.reach + tolerance)
        kept = found._replace(
            direction=where(lost, state.start, found.direction),
            distance=jnp.where(lost, 0.0, found.distance),
            reach=jnp.where(lost, axis_separation, found.reach),
        )
        simplex = jax.tree.map(lambda new, old: jnp.where(state.done, old, new), kept, state.simplex)
        tested = first & (found.overlap | _stalled(found, tolerance))
        axis = separating_axis(shapes, a, b, tested)
        # The test knows no axis from a corner: of shapes that are apart it may find less than the search did.
        wanted = tested & (found.overlap | (axis.separation > found.reach))
        # What no axis parts overlaps, and one of the axes is the direction of its depth.
        exact = tested & (found.overlap | (axis.separation < 0))
        upper = jnp.where(first, jnp.where(exact, axis.separation, found.distance), state.upper)
        shift = axis.direction * (LIFT - axis.separation)
        return _Lifted(state.turn + 1, simplex, axis.direction, shift, upper, ~wanted)

    # Both searches are turns of one loop, so that they are compiled once.
    zero = jnp.zeros_like(shapes.position.x)
    vector = Vec3(zero, zero, zero)
    state = _Lifted(
        jnp.zeros((), jnp.int32), _no_simplex(vector, polytopes=True), shapes.position, vector, zero, zero > 0
    )
    state = lax.while_loop(lambda s: (s.turn < 2) & ~jnp.all(s.done), turn, state)
    return state.simplex, state.upper


def _stalled(found: Simplex, tolerance: float) -> Array:
    """Whether the search stalled on a needle of a simplex, close to touch: its direction proves nothing."""
    allowed = jnp.where(found.distance < CLOSE, found.distance - tolerance, LOST * found.distance)
    return found.reach < allowed


def _no_simplex(zero: Vec3, *, polytopes: bool) -> Simplex:
    none = jnp.zeros(zero.x.shape, jnp.int32)
    points, point = ((zero,) * 3, None) if polytopes else (None, zero)
    return Simplex(zero, (none,) * 3, points, point, point, zero.x, none < 0, zero, none, zero.x)


class _Search(NamedTuple):
    turn: Array
    simplex: Simplex
    solution: Solution
    start: Vec3
    shift: Vec3
    lift: Array
    overlap: Array
    upper: Array
    done: Array


def search_curved(shapes: Difference, tolerance: float) -> tuple[Simplex, Solution, Array]:
    """Closest simplex of two shapes of which one has a rim, its solution, and an upper bound of their separation.

    Overlapping shapes are searched again after pulling them apart along the least overlap that a glance found, which
    yields a local minimum. What no cap around it proves is left to the penetration search; a better direction that this
    finds is the start of the next turn. All searches are turns of one loop, so that they are compiled once.

    Args:
        shapes: The shapes, not differentiated.
        tolerance: An answer is good to this share of the size.
    """
    number = shapes.position.x.dtype

    def prove(values: tuple[Difference, Vec3, Array], unproved: Array) -> Penetration:
        shapes, seed, half_proved = values
        return epa(shapes, seed, half_proved, unproved, PROOF, tolerance)

    def turn(state: _Search) -> _Search:
        found = gjk(shapes, state.start, state.shift, ~state.done, CURVED_ITERATIONS[str(number)])
        first = state.turn == 0
        solved = solve(shapes, found, ~state.done & ~(first & found.overlap))
        simplex, solution = jax.tree.map(
            lambda new, old: jnp.where(state.done, old, new), (found, solved), (state.simplex, state.solution)
        )
        overlap = jnp.where(first, found.overlap, state.overlap)
        wanted = jnp.where(first, found.overlap | _stalled(found, tolerance), ~state.done)
        cap = proved_cap(shapes, solution, tolerance)
        unproved = wanted & ~first & ~cap.whole
        nothing = Penetration(vector, zero, zero, zero)
        least = of_wanted(prove, unproved, (shapes, solution.normal, cap.half), nothing)
        upper = jnp.where(first, jnp.where(overlap, jnp.inf, found.distance), state.upper)
        lower = jnp.where(cap.whole, -solution.separation, least.lower)
        # Shapes that are searched because they all but touch overlap for sure only where a depth is proved.
        bounded = wanted & ~first & (overlap | (lower >= 0))
        upper = jnp.where(bounded, jnp.minimum(upper, -lower), upper)
        # A lane keeps the simplex of its seed unless the search found a better direction.
        done = ~wanted | (~first & (cap.whole | (least.depth >= least.seed_depth)))
        start = where(first, seed, least.direction)
        depth = jnp.where(first, seed_depth, least.depth)
        lift = state.lift * jnp.where(first, 1.0, LIFT_RATIO[str(number)])
        return _Search(
            state.turn + 1, simplex, solution, start, start * (depth + state.lift), lift, overlap, upper, done
        )

    seed, seed_depth = _glance(shapes)
    zero = jnp.zeros_like(shapes.position.x)
    vector = Vec3(zero, zero, zero)
    no = zero > 0
    none = _no_simplex(vector, polytopes=False)
    state = _Search(
        jnp.zeros((), jnp.int32),
        none,
        Solution(vector, zero, Ties(none.pieces, no, no), no),
        shapes.position,
        vector,
        jnp.asarray(LIFT, number),
        no,
        zero + jnp.inf,
        no,
    )
    state = lax.while_loop(lambda s: (s.turn <= PROOFS) & ~jnp.all(s.done), turn, state)
    return state.simplex, state.solution, state.upper


def _glance(shapes: Difference) -> tuple[Vec3, Array]:
    """The least deep of a few directions, and its depth."""
    like = shapes.position.x
    ours = [Vec3(*(jnp.full_like(like, c / math.hypot(*d)) for c in d)) for d in SEEDS]
    theirs = [axis * sign for axis in shapes.rotation for sign in (1.0, -1.0)]
    sides = [
        *_side_normals(shapes.kind_a, shapes.a),
        *(-shapes.rotation.apply(n) for n in _side_normals(shapes.kind_b, shapes.b)),
    ]
    stored = (jnp.broadcast_arrays(*components) for components in zip(*ours, *theirs, *sides, strict=True))
    directions = Vec3(*(jnp.stack(components) for components in stored))
    extreme, _ = shapes.least(directions)
    separation, index = best_candidate(dot(directions, extreme))
    return pick(directions, index), -separation


def _side_normals(kind: str, shape: Parameters) -> list[Vec3]:
    """Some normals of the round side of a shape, in its own frame."""
    side = SUPPORT[kind].side
    if side is None:
        return []
    across, along = side(shape)
    angles = [2.0 * math.pi * k / SIDES for k in range(SIDES)]
    return [Vec3(across * math.cos(angle), along, across * math.sin(angle)) for angle in angles]
