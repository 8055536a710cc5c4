"""The linear system behind the derivative of rows at their solution, solved by sweeps like those that found it.

The sweeps are linear in what they carry, so their transpose stores nothing.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver import sweeps
from mathota_jax.solver.laws import Cone
from mathota_jax.solver.row_matrix import Dense
from mathota_jax.solver.rows import Rows, visiting_all_turns
from mathota_jax.solver.slopes import ConeSlopes, Slopes, left_unanswered
from mathota_jax.solver.sweeps import Update
from mathota_jax.spatial.settle import store
from mathota_jax.struct import pytree

NORMAL_RELAXATION, TANGENT_RELAXATION = (1.5, 1.2), (1.3, 1.0)
"""Factors on the steps of the normals and of the tangents of contacts that stick and that slide, in the sweeps behind a
derivative, which have no bounds that could make them swing. Tangents that slide follow the normals, and what they do to
them adds to the steps of those. Measured for boxes that slide on an edge with friction 0.8: with the factors for contacts
that stick, what a sweep leaves of the motion of a tower 1:2 grew, until derivatives were 68 for 2."""

MOMENTUM = 0.15
"""Share of the change by the sweep before that is added to that of each of those (heavy ball: B. T. Polyak, "Some methods of
speeding up the convergence of iteration methods", 1964). What a sweep leaves of a mode between -0.9 and 0.6 becomes 0.39,
its root. Measured for a slab: 15 such sweeps leave 1e-6 of a change, 20 plain ones 1e-5 to 4e-4; 10 are as good for most
motions, but not for the derivative of a slide by the mass, which is 0. Of a stack of five boxes, for which neither is
enough, 15 leave at most 0.8 times as much as 20 plain ones."""


def enough_for_derivatives(rows: tuple[Rows, ...], iterations: int) -> int:
    """Sweeps behind a derivative that come at least as close to its solution as 2 `iterations` plain ones."""
    return -(-3 * iterations // 2) if _accelerate(rows) else 2 * iterations


@pytree
class _Transposed:
    """A matrix of rows in the transposed system: Jacobian and response change places, between them the slopes of the law."""

    matrix: Dense
    slopes: Slopes

    @property
    def like(self) -> Array:
        return self.matrix.like

    @property
    def swapped(self) -> Dense:
        return Dense(self.matrix.response, self.matrix.jacobian)

    def rates(self, velocities: Sequence[Array]) -> Array:
        return self.swapped.rates(velocities)

    def changes(self, impulse: Array, together: int) -> list[Array]:
        return self.swapped.changes(store(self.slopes.transposed(impulse)[1], self.like), together)

    def first_row(self) -> _TransposedFirst:
        return _TransposedFirst(self.matrix.first_row(), self.slopes)

    def other_rows(self) -> _TransposedOthers:
        return _TransposedOthers(self.matrix, self.slopes)


class _TransposedFirst(_Transposed):
    """Its first row, where the others have no impulse."""

    def changes_once(self, impulse: Array, together: int) -> list[Array]:
        none = jnp.zeros_like(impulse)
        passed_on = self.slopes.transposed(jnp.concatenate([impulse, none, none]))[1][:1]
        return self.swapped.changes_once(store(passed_on, self.like), together)


class _TransposedOthers(_Transposed):
    """Its other rows, where the first has no impulse: what they pass on to it remains."""

    @property
    def like(self) -> Array:
        return self.matrix.like[1:]

    def rates(self, velocities: Sequence[Array]) -> Array:
        return self.swapped.other_rows().rates(velocities)

    def changes(self, impulse: Array, together: int) -> list[Array]:
        passed_on = self.slopes.transposed(jnp.concatenate([jnp.zeros_like(impulse[:1]), impulse]))[1]
        return self.swapped.changes(store(passed_on, self.matrix.like), together)


def solve(
    iterations: int, rows: tuple[Rows, ...], slopes: tuple[Slopes, ...], right_sides: tuple[Array, ...]
) -> tuple[Array, ...]:
    """Solves ``x = K x + H J (M^-1 J^T x) + right side`` by sweeps; transposable and differentiable in everything.

    K and H are the `slopes` of each group by impulse and error. The transposed system, ``z = K^T z +
    (M^-1 J^T)^T (J^T H^T z) + ...``, has the same form.
    """
    everywhere = visiting_all_turns(rows)  # the product is transposed too
    nothing = _no_velocity(rows)

    product = functools.partial(left_unanswered, everywhere, slopes, nothing)

    def solve_forward(_: Callable, right_sides: tuple[Array, ...]) -> tuple[Array, ...]:
        def at_once(of_turn: tuple[Slopes, Array], _: Array, impulse: Array, error: Array) -> Array:
            return of_turn[0].update(impulse, error) + of_turn[1]

        def first(of_turn: tuple[ConeSlopes, Array], _: Array, impulse: Array, error: Array) -> Array:
            return of_turn[0].push(impulse[:1], error) + of_turn[1][:1]

        def others(of_turn: tuple[ConeSlopes, Array], _: Array, impulse: Array, normal: Array, error: Array) -> Array:
            slopes, right_side = of_turn
            return jnp.stack(slopes.hold(normal[0] - right_side[0], tuple(impulse[1:]), tuple(error))) + right_side[1:]

        update = Update(at_once, first, others)
        return _linear_sweeps(iterations, rows, update, tuple(zip(slopes, right_sides, strict=True)), nothing)

    def solve_transposed(_: Callable, right_sides: tuple[Array, ...]) -> tuple[Array, ...]:
        def at_once(of_turn: tuple[Slopes, Array], _: Array, impulse: Array, error: Array) -> Array:
            return of_turn[0].transposed(impulse)[0] + error + of_turn[1]

        def first(of_turn: tuple[ConeSlopes, Array], _: Array, impulse: Array, error: Array) -> Array:
            return of_turn[0].push_back(impulse[:1], tuple(impulse[1:])) + error + of_turn[1][:1]

        def others(of_turn: tuple[ConeSlopes, Array], _: Array, impulse: Array, __: Array, error: Array) -> Array:
            return jnp.stack(of_turn[0].hold_back(tuple(impulse[1:]))) + error + of_turn[1][1:]

        update = Update(at_once, first, others)
        swapped = tuple(
            dataclasses.replace(group, matrix=_Transposed(group.matrix, slope))  # type: ignore[arg-type]
            for group, slope in zip(rows, slopes, strict=True)
        )
        return _linear_sweeps(iterations, swapped, update, tuple(zip(slopes, right_sides, strict=True)), nothing)

    return lax.custom_linear_solve(product, right_sides, solve_forward, transpose_solve=solve_transposed)


def _linear_sweeps(
    iterations: int, rows: tuple[Rows, ...], update: Update, coefficients: tuple[object, ...], nothing: Array
) -> tuple[Array, ...]:
    """Impulses after sweeps from 0, which are accelerated, and of even number, in scenes of contacts with friction alone."""
    zeros = tuple(jnp.zeros_like(group.bias) for group in rows)
    if not _accelerate(rows):
        return sweeps.run(iterations, rows, lambda _: update, coefficients, zeros, nothing, zeros)[1]

    def first(of_turn: tuple[ConeSlopes, Array], bias: Array, impulse: Array, error: Array) -> Array:
        old = impulse[:1]
        return old + _factor(of_turn[0], *NORMAL_RELAXATION) * (update.first(of_turn, bias, impulse, error) - old)

    def others(of_turn: tuple[ConeSlopes, Array], bias: Array, impulse: Array, normal: Array, error: Array) -> Array:
        old = impulse[1:]
        return old + _factor(of_turn[0], *TANGENT_RELAXATION) * (
            update.others(of_turn, bias, impulse, normal, error) - old
        )

    longer = Update(update.at_once, first, others)

    def sweep(now: tuple, before: tuple) -> tuple:
        new = sweeps.once(rows, longer, coefficients, zeros, *now)
        return jax.tree.map(lambda x, a, b: x + MOMENTUM * (a - b), new, now, before)

    def two_sweeps(_: Array, carry: tuple) -> tuple:
        # Each sweep takes the place of the one before the last: a loop of single ones would copy both.
        now, before = carry
        before = sweep(now, before)
        return sweep(before, now), before

    start = (nothing, zeros)
    return lax.fori_loop(0, -(-iterations // 2), two_sweeps, (start, start))[0][1]


def _factor(slopes: ConeSlopes, sticking: float, sliding: float) -> Array:
    return jnp.where(slopes.grip < 1, sliding, sticking).astype(slopes.grip.dtype)


def _accelerate(rows: tuple[Rows, ...]) -> bool:
    return all(isinstance(group.law, Cone) for group in rows)


def _no_velocity(rows: tuple[Rows, ...]) -> Array:
    response = rows[0].response[0]
    return jnp.zeros((response.shape[2], rows[0].table.block_count, response.shape[4]), response.dtype)
