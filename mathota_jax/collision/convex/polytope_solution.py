"""The exact normal of two polytopes, whose tied pieces are points, from what the distance search found."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.convex.difference import Difference, barycentric
from mathota_jax.collision.convex.gjk import Simplex
from mathota_jax.collision.convex.polish import Solution, better, newton_step, rounding_of
from mathota_jax.collision.convex.ties import Ties, distinct, join
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.vector import Vec3, dot, where

STEPS = 10
"""Most Newton steps; all lanes stop as soon as they have converged."""
CLEAR = 1e-3
"""Of shapes that are (pulled) apart by this share of the size the search knows the direction to round-off."""


class _Search(NamedTuple):
    """`extreme`, of `pieces`, lies furthest against the normal; where `exact`, no further than the ties."""

    turn: Array
    normal: Vec3
    ties: Ties
    points: list[Vec3]
    extreme: Vec3
    pieces: Array
    exact: Array
    best: Solution
    done: Array


def solve_polytopes(shapes: Difference, simplex: Simplex) -> Solution:
    """Tied pieces and normal of the solution: `polish.solve` for polytopes.

    The search is mostly right. It ends too early where another vertex would bring it closer by less than round-off.

    Args:
        shapes: The shapes, not differentiated.
        simplex: The closest simplex that the search found; its distance is 0 where the direction is not that of its
            points.
    """
    assert simplex.points is not None
    rounding = rounding_of(shapes)

    def advance(state: _Search) -> _Search:
        weights = barycentric(state.points, state.ties.two, state.ties.three)
        from_new = [point - state.extreme for point in state.points]
        shares = barycentric(from_new, state.ties.two, state.ties.three)
        ties = join(state.ties, state.pieces, weights, shares, ~state.exact)
        same = [new == old for new, old in zip(ties.pieces, state.ties.pieces, strict=True)]
        points = [where(kept, point, state.extreme) for kept, point in zip(same, state.points, strict=True)]
        normal = compute_once(newton_step(shapes, ties, state.normal, points), state.best.separation)
        extreme, pieces = shapes.least(normal)
        reach = dot(normal, extreme)
        tied = dot(normal, points[0]) <= reach + 4.0 * rounding
        # Of pieces that tie by less than that a better direction may be known: others are tied there.
        tied &= reach > state.best.separation - rounding
        best, exact = better(state.best, Solution(normal, reach, ties, tied), True, state.done, rounding)
        return _Search(state.turn + 1, normal, ties, points, extreme, pieces, exact, best, state.done | exact)

    clear = simplex.distance > CLEAR
    tied = dot(simplex.direction, simplex.points[0]) <= simplex.reach + 4.0 * rounding
    exact = settle_code((clear & tied).astype(simplex.reach.dtype)) == 1
    ties = distinct(simplex.pieces)
    pieces = jnp.where(exact, ties.pieces[0], simplex.extreme_pieces)
    known = Ties(tuple(jnp.where(exact, piece, pieces) for piece in ties.pieces), ties.two & exact, ties.three & exact)
    state = _Search(
        jnp.zeros((), jnp.int32),
        simplex.direction,
        ties,
        list(simplex.points),
        simplex.extreme,
        # Along a direction that is not known well the extreme piece is any.
        jnp.where(clear, simplex.extreme_pieces, ties.pieces[0]),
        exact,
        Solution(simplex.direction, simplex.reach, known, exact),
        exact,
    )
    return lax.while_loop(lambda s: (s.turn < STEPS) & ~jnp.all(s.done), advance, state).best
