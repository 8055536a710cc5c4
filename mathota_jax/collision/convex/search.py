"""The search for the closest simplex of two convex shapes, apart or overlapping; not differentiated.

The distance search (GJK) finds it for shapes that are apart. Overlapping shapes are pulled apart along the direction of
least overlap: their closest points are then those of the overlap. The direction is found among all that can be the one
for polytopes (`separating_axis`), by an expanding polytope for curved shapes (`epa`).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.convex.difference import Difference
from mathota_jax.collision.convex.epa import epa
from mathota_jax.collision.convex.gjk import Simplex, gjk
from mathota_jax.collision.convex.polytope import Polytope
from mathota_jax.collision.convex.separating_axis import separating_axis
from mathota_jax.spatial.vector import Vec3, dot, where

POLYTOPE_ITERATIONS = 16
CURVED_ITERATIONS = {"float32": 24, "float64": 40}
"""Most iterations of the distance search."""
GLANCE, PROOF = 16, 110
"""Most iterations of the penetration search: of the first, which looks for a seed, and of those that prove it."""
PROOFS = 2
"""Proofs in a row: each starts from what the one before found in place of its seed."""
LIFT = 0.01
"""Overlapping shapes are pulled apart to this gap (share of the size)."""
LIFT_RATIO = {"float32": 0.3, "float64": 0.01}
"""Each later search lifts less: from a direction that is no minimum yet the answer moves the further the lower the lift,
while its rounding grows."""
CLOSE = 1e-3
"""Shapes that are apart by less than this share of the size are searched like overlapping ones if the distance search
fails to prove its answer; further apart the polish repairs it."""


class _Lifted(NamedTuple):
    turn: Array
    simplex: Simplex
    start: Vec3
    shift: Vec3
    upper: Array
    done: Array


def search_polytopes(shapes: Difference, a: Polytope, b: Polytope, tolerance: float) -> tuple[Simplex, Array]:
    """Closest simplex of two polytopes, and an upper bound of their separation.

    Args:
        shapes: The shapes, not differentiated.
        a: The core of A, in its own frame and in units of the size.
        b: The core of B.
        tolerance: An answer is good to this share of the size.
    """

    def turn(state: _Lifted) -> _Lifted:
        found = gjk(shapes, state.start, state.shift, ~state.done, POLYTOPE_ITERATIONS)
        first = state.turn == 0
        reach = _reach(shapes, found)
        # From an axis that all but meets a corner the search returns at once, with the round-off of the lift in its angle.
        lost = ~first & (LIFT - dot(state.shift, state.start) > reach + tolerance)
        kept = found._replace(direction=where(lost, state.start, found.direction))
        simplex = jax.tree.map(lambda new, old: jnp.where(state.done, old, new), kept, state.simplex)
        wanted = first & (found.overlap | _stalled(found, reach, tolerance))
        axis = separating_axis(shapes, a, b, wanted)
        # The test knows no axis from a corner: of shapes that are apart it may find less than the search did.
        wanted &= found.overlap | (axis.separation > reach)
        upper = jnp.where(first, jnp.where(found.overlap, axis.separation, found.distance), state.upper)
        shift = axis.direction * (LIFT - axis.separation)
        return _Lifted(state.turn + 1, simplex, axis.direction, shift, upper, ~wanted)

    # Both searches are turns of one loop, so that they are compiled once.
    zero = jnp.zeros_like(shapes.position.x)
    vector = Vec3(zero, zero, zero)
    state = _Lifted(jnp.zeros((), jnp.int32), _no_simplex(vector, None), shapes.position, vector, zero, zero > 0)
    state = lax.while_loop(lambda s: (s.turn < 2) & ~jnp.all(s.done), turn, state)
    return state.simplex, state.upper


def _reach(shapes: Difference, found: Simplex) -> Array:
    """True separation along the direction of a simplex: a lower bound."""
    return dot(found.direction, shapes.least(found.direction)[0])


def _stalled(found: Simplex, reach: Array, tolerance: float) -> Array:
    """Whether the search stalled on a needle of a simplex, close to touch: its direction proves nothing."""
    return (found.distance < CLOSE) & (reach < found.distance - tolerance)


def _no_simplex(zero: Vec3, point: Vec3 | None) -> Simplex:
    none = jnp.zeros(zero.x.shape, jnp.int32)
    return Simplex(zero, (none, none, none), point, point, zero.x, none < 0)


class _Search(NamedTuple):
    simplex: Simplex
    start: Vec3
    shift: Vec3
    lift: Array
    overlap: Array
    upper: Array
    done: Array


def search_curved(shapes: Difference, tolerance: float) -> tuple[Simplex, Array]:
    """Closest simplex of two shapes of which one has a rim, and an upper bound of their separation.

    Overlapping shapes are searched again after pulling them apart along the least overlap. Where the penetration search
    was not done, that yields a direction that is at least a local minimum: the seed of the next one. All searches are
    turns of one loop, so that they are compiled once.

    Args:
        shapes: The shapes, not differentiated.
        tolerance: An answer is good to this share of the size.
    """
    number = shapes.position.x.dtype

    def turn(index: Array, state: _Search) -> _Search:
        found = gjk(shapes, state.start, state.shift, ~state.done, CURVED_ITERATIONS[str(number)])
        simplex = jax.tree.map(lambda new, old: jnp.where(state.done, old, new), found, state.simplex)
        first = index == 0
        overlap = jnp.where(first, found.overlap, state.overlap)
        wanted = jnp.where(first, found.overlap | _stalled(found, _reach(shapes, found), tolerance), ~state.done)
        limit = jnp.where(first, GLANCE, jnp.where(index <= PROOFS, PROOF, 0))
        least = epa(shapes, simplex.direction, wanted, limit, PROOF, tolerance)
        upper = jnp.where(first, jnp.where(overlap, jnp.inf, found.distance), state.upper)
        upper = jnp.where(overlap & wanted, jnp.minimum(upper, -least.lower), upper)
        # The first seed is none. Later a lane keeps the simplex of its seed unless the search found a better direction.
        done = ~wanted | (~first & (least.depth >= least.seed_depth - tolerance))
        lift = state.lift * LIFT_RATIO[str(number)]
        return _Search(
            simplex, least.direction, least.direction * (least.depth + state.lift), lift, overlap, upper, done
        )

    zero = jnp.zeros_like(shapes.position.x)
    vector = Vec3(zero, zero, zero)
    no = zero > 0
    state = _Search(
        _no_simplex(vector, vector), shapes.position, vector, jnp.asarray(LIFT, number), no, zero + jnp.inf, no
    )
    state = lax.fori_loop(0, PROOFS + 2, turn, state)
    return state.simplex, state.upper
