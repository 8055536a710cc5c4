"""Projected Gauss-Seidel on velocity blocks (guide 9.2), and its derivative at the solution.

The solver knows rows (`rows`), not contacts or joints. A sweep is unrolled over few turns, where slicing with a traced index
was measured to cost 3x, and a scan over many.

The derivative is that of the fixed point: it satisfies a linear system with the same sparsity, solved by the same
sweeps with the law replaced by its Jacobian. Those sweeps are linear in what they carry, so their transpose stores
nothing: reverse mode needs memory constant in the number of sweeps. The initial impulses do not move the fixed point and
have no derivative.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.solver.laws import Cone, Law
from mathota_jax.solver.row_matrix import Dense, RowMatrix
from mathota_jax.solver.rows import (
    UNROLLED_TURNS,
    Rows,
    add_changes,
    add_impulses,
    gather,
    matrix_velocity,
    receive,
    row_velocity,
    visiting_all_turns,
)
from mathota_jax.solver.slopes import Slopes, slopes_of
from mathota_jax.solver.table import Table, TracedTable
from mathota_jax.spatial import counter
from mathota_jax.spatial.settle import compute_once, store, store_cotangents
from mathota_jax.struct import pytree

Update = Callable[[Array | int, Any, Array, Array, Array], Array]
"""New impulses of a turn, from the number of the sweep, coefficients, biases, impulses and errors."""

TurnUpdate = Callable[[Any, Array, Array, Array], Array]
"""The same within a sweep."""

PLAIN_SWEEPS = 4
"""Last sweeps, in which contacts do not over-relax: they take to rest what longer steps leave swinging. Measured: with two,
dropped boxes may creep; with three none of 16 does, but a slide on a heightfield and on a plane differ by 2e-5 m."""

OVER_RELAXATION = 1.7
"""Factor on the normal steps of the sweeps before those, which converge if its product with that of `normal_bound` is below
2. Measured with 10 sweeps from nothing: ten boxes dip by 1.0 mm instead of 2.3."""

LINEAR_RELAXATION = (1.5, 1.3, 1.3)
"""Factors on the steps of the normal and tangent rows of contacts in the sweeps behind a derivative, which have no bounds
that could make them swing."""

MOMENTUM = 0.15
"""Share of the change by the sweep before that is added to that of each of those (heavy ball: B. T. Polyak, "Some methods of
speeding up the convergence of iteration methods", 1964). What a sweep leaves of a mode between -0.9 and 0.6 becomes 0.39,
its root. Measured for a slab: 15 such sweeps leave 1e-6 of a change, 20 plain ones 1e-5 to 4e-4; 10 are as good for most
motions, but not for the derivative of a slide by the mass, which is 0. Of a stack of five boxes, for which neither is
enough, 15 leave at most 0.8 times as much as 20 plain ones."""


def enough_for_derivatives(rows: tuple[Rows, ...], iterations: int) -> int:
    """Sweeps behind a derivative that come at least as close to its solution as 2 `iterations` plain ones."""
    return -(-3 * iterations // 2) if _accelerate(rows) else 2 * iterations


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def solve(
    iterations: int,
    gradient_iterations: int,
    rows: tuple[Rows, ...],
    velocity: Array,
    impulses: tuple[Array, ...],
    change: Array | None = None,
) -> tuple[Array, tuple[Array, ...]]:
    """Runs a fixed number of sweeps.

    Args:
      iterations: number of sweeps, 0 if the impulses are known to be solved.
      gradient_iterations: number of sweeps of the linear solver behind a derivative.
      rows: groups of rows, solved in this order within a sweep.
      velocity: (component, block, world) without any constraint impulse.
      impulses: for each group (turn, row, column, world), the impulses to start from.
      change: (component, block, world) what they make of the velocity, without derivative; None if it is not known yet.

    Returns:
      The velocity with the impulses, and the impulses.
    """
    velocity = add_impulses(rows, velocity, impulses) if change is None else velocity + change
    if not rows or not iterations:
        return compute_once((velocity, impulses), velocity)
    biases = tuple(group.bias for group in rows)
    laws = tuple(group.law.starting(impulse) for group, impulse in zip(rows, impulses, strict=True))

    def update(number: Array | int, law: Law, bias: Array, impulse: Array, error: Array) -> Array:
        # A contact that bounces is alone for the most part, and its exact step ends at once. Longer ones leave an error
        # of 1e-4, by which elastic boxes that bounce on their faces were measured to begin to spin.
        longer = (number < iterations - PLAIN_SWEEPS) & (bias[0] >= 0)
        return law.relaxed(jnp.where(longer, OVER_RELAXATION, 1.0).astype(error.dtype)).update(impulse, error)

    return sweeps(iterations, rows, update, laws, biases, velocity, impulses)


def sweeps(
    iterations: int,
    rows: tuple[Rows, ...],
    update: Update,
    coefficients: tuple[object, ...],
    biases: tuple[Array, ...],
    velocity: Array,
    impulses: tuple[Array, ...],
) -> tuple[Array, tuple[Array, ...]]:
    """Plain sweeps, whose derivative is that of every update; `update` gets the coefficients of a group at each turn."""

    def sweep(number: Array | int, carry: tuple[Array, tuple[Array, ...]]) -> tuple[Array, tuple[Array, ...]]:
        return _sweep_all(rows, functools.partial(update, number), coefficients, biases, *carry)

    if iterations == 1:
        return sweep(0, (velocity, impulses))
    return lax.fori_loop(0, iterations, sweep, (velocity, impulses))


def _sweep_all(
    rows: tuple[Rows, ...],
    update: TurnUpdate,
    coefficients: tuple[object, ...],
    biases: tuple[Array, ...],
    velocity: Array,
    impulses: tuple[Array, ...],
) -> tuple[Array, tuple[Array, ...]]:
    """One pass over all groups."""
    new = []
    for group, coefficient, bias, impulse in zip(rows, coefficients, biases, impulses, strict=True):
        velocity, impulse = _sweep(group, update, coefficient, bias, velocity, impulse)
        new.append(impulse)
    return velocity, tuple(new)


def _sweep(
    group: Rows, update: TurnUpdate, coefficients: object, bias: Array, velocity: Array, impulse: Array
) -> tuple[Array, Array]:
    """One pass over the turns of a group."""
    table: Table | TracedTable = group.table
    fixed = (group.matrix, bias, coefficients)
    if isinstance(table, TracedTable):
        return _sweep_places(group, update, fixed, velocity, impulse)
    scanned = (*fixed, impulse)
    if table.turn_count <= UNROLLED_TURNS:
        new = []
        for turn in range(table.turn_count):
            blocks = tuple(side[turn] for side in table.blocks)
            receivers = table.receivers[turn]
            at_turn = jax.tree.map(lambda x, turn=turn: x[turn], scanned)
            velocity, at_turn = _turn(update, table.together, velocity, blocks, receivers, at_turn)
            new.append(at_turn)
        return velocity, jnp.stack(new)

    def body(velocity: Array, at_turn: tuple) -> tuple[Array, Array]:
        blocks, receivers, values = at_turn
        return _turn(update, table.together, velocity, blocks, receivers, values)

    indices = tuple(jnp.asarray(side, jnp.int32) for side in table.blocks)
    return lax.scan(body, velocity, (indices, jnp.asarray(table.receivers), scanned))


def _sweep_places(
    group: Rows, update: TurnUpdate, fixed: tuple, velocity: Array, impulse: Array
) -> tuple[Array, Array]:
    """One pass over those turns of a traced table that hold a constraint."""
    places = group.places
    assert places is not None

    def body(_: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        turn, velocity, impulse = carry
        blocks, values = counter.row((places.blocks, (*fixed, impulse)), turn)
        *values, old = values
        matrix: RowMatrix = values[0]
        # The old impulse is stored: read again after its place is overwritten, all of them would be copied every turn.
        old = store(old, matrix.like)
        velocity, new = _turn(update, group.table.together, velocity, blocks, blocks, (*values, old))
        return counter.following(turn), velocity, counter.put(impulse, new, turn)

    turns = group.table.turn_count if places.turns is None else places.turns
    return lax.fori_loop(0, turns, body, (counter.start(), velocity, impulse))[1:]


def _turn(
    update: TurnUpdate, together: int, velocity: Array, blocks: tuple, receivers: object, values: tuple
) -> tuple[Array, Array]:
    """Solves the rows of one turn side by side."""
    matrix, bias, coefficients, impulse = values
    error = bias + matrix.rates([gather(velocity, side, together) for side in blocks])
    # Stored, because each row of the law reads several errors, and every later turn the impulses: what is not stored is
    # computed again for each.
    error = store(error, matrix.like)
    new = store(update(coefficients, bias, impulse, error), matrix.like)
    return receive(velocity, receivers, matrix.changes(new - impulse, together)), new


@solve.defjvp
def _solve_jvp(iterations: int, gradient_iterations: int, primals: tuple, tangents: tuple) -> tuple:
    rows, velocity, impulses, change = primals
    d_rows, d_velocity, _, _ = tangents
    velocity, impulses = solve(iterations, gradient_iterations, rows, velocity, impulses, change)
    if not rows:
        return (velocity, impulses), (d_velocity, impulses)
    rows, d_rows = _dense(rows, d_rows)
    d_velocity, errors, right_sides = linearise(rows, d_rows, velocity, impulses, d_velocity)
    slopes = tuple(
        slopes_of(group.law, impulse, error) for group, impulse, error in zip(rows, impulses, errors, strict=True)
    )
    d_impulses = _solve_linear(gradient_iterations, rows, slopes, right_sides)
    return (velocity, impulses), (add_impulses(visiting_all_turns(rows), d_velocity, d_impulses), d_impulses)


def _dense(rows: tuple[Rows, ...], d_rows: tuple[Rows, ...]) -> tuple[tuple[Rows, ...], tuple[Rows, ...]]:
    """The rows and their change with all entries: the transposed system exchanges Jacobian and response."""
    matrices, changes = (tuple(group.matrix for group in groups) for groups in (rows, d_rows))
    dense = jax.jvp(lambda matrices: tuple(matrix.dense() for matrix in matrices), (matrices,), (changes,))
    return tuple(  # type: ignore[return-value]
        tuple(dataclasses.replace(group, matrix=matrix) for group, matrix in zip(groups, found, strict=True))
        for groups, found in zip((rows, d_rows), dense, strict=True)
    )


def linearise(
    rows: tuple[Rows, ...], d_rows: tuple[Rows, ...], velocity: Array, impulses: tuple[Array, ...], d_velocity: Array
) -> tuple[Array, tuple[Array, ...], tuple[Array, ...]]:
    """Derivative of the fixed point of all laws, but for the change of the impulses. The matrices are dense.

    Returns:
      The change of the velocity at fixed impulses; for each group the errors, and the change of its impulses at fixed
      impulses.
    """
    for group, d_group, impulse in zip(visiting_all_turns(rows), d_rows, impulses, strict=True):
        d_velocity = add_changes(group, d_group.matrix, d_velocity, impulse)
    errors, right_sides = [], []
    for group, d_group, impulse in zip(rows, d_rows, impulses, strict=True):
        # The error goes into all slopes of the law, its cotangent into that of every entry of the matrix.
        error = compute_once(group.bias + row_velocity(group, velocity), velocity)
        d_error = d_group.bias + row_velocity(group, d_velocity)
        d_error = store_cotangents(d_error + matrix_velocity(group.table, d_group.matrix, group.places, velocity))
        errors.append(error)
        right_sides.append(
            jax.jvp(lambda law, error: law.update(impulse, error), (group.law, error), (d_group.law, d_error))[1]  # noqa: B023
        )
    return d_velocity, tuple(errors), tuple(right_sides)


@pytree
class _Transposed:
    """A matrix of rows in the transposed system: Jacobian and response change places, between them the slopes of the law."""

    matrix: Dense
    slopes: Slopes

    @property
    def like(self) -> Array:
        return self.matrix.like

    def rates(self, velocities: Sequence[Array]) -> Array:
        return Dense(self.matrix.response, self.matrix.jacobian).rates(velocities)

    def changes(self, impulse: Array, together: int) -> list[Array]:
        passed_on = store(self.slopes.transposed(impulse)[1], self.like)
        return Dense(self.matrix.response, self.matrix.jacobian).changes(passed_on, together)


def _solve_linear(
    iterations: int, rows: tuple[Rows, ...], slopes: tuple[Slopes, ...], right_sides: tuple[Array, ...]
) -> tuple[Array, ...]:
    """Solves ``x = K x + H J (M^-1 J^T x) + right side`` by sweeps; transposable and differentiable in everything.

    K and H are the `slopes` of each group by impulse and error. The transposed system, ``z = K^T z +
    (M^-1 J^T)^T (J^T H^T z) + ...``, has the same form.
    """
    everywhere = visiting_all_turns(rows)  # the product is transposed too
    nothing = _no_velocity(rows)

    def product(x: tuple[Array, ...]) -> tuple[Array, ...]:
        velocity = add_impulses(everywhere, nothing, x)
        return tuple(
            part - slope.update(part, row_velocity(group, velocity))
            for part, group, slope in zip(x, rows, slopes, strict=True)
        )

    def solve_forward(_: Callable, right_sides: tuple[Array, ...]) -> tuple[Array, ...]:
        def update(of_turn: tuple[Slopes, Array], _: Array, impulse: Array, error: Array) -> Array:
            return of_turn[0].update(impulse, error) + of_turn[1]

        return _linear_sweeps(iterations, rows, update, tuple(zip(slopes, right_sides, strict=True)), nothing)

    def solve_transposed(_: Callable, right_sides: tuple[Array, ...]) -> tuple[Array, ...]:
        def update(of_turn: tuple[Slopes, Array], _: Array, impulse: Array, error: Array) -> Array:
            return of_turn[0].transposed(impulse)[0] + error + of_turn[1]

        swapped = tuple(
            dataclasses.replace(group, matrix=_Transposed(group.matrix, slope))  # type: ignore[arg-type]
            for group, slope in zip(rows, slopes, strict=True)
        )
        return _linear_sweeps(iterations, swapped, update, tuple(zip(slopes, right_sides, strict=True)), nothing)

    return lax.custom_linear_solve(product, right_sides, solve_forward, transpose_solve=solve_transposed)


def _linear_sweeps(
    iterations: int, rows: tuple[Rows, ...], update: TurnUpdate, coefficients: tuple[object, ...], nothing: Array
) -> tuple[Array, ...]:
    """Impulses after sweeps from 0, which are accelerated, and of even number, in scenes of contacts with friction alone."""
    zeros = tuple(jnp.zeros_like(group.bias) for group in rows)
    if not _accelerate(rows):
        return sweeps(iterations, rows, lambda _, *of_turn: update(*of_turn), coefficients, zeros, nothing, zeros)[1]
    factors = np.array(LINEAR_RELAXATION)[:, None, None]

    def relaxed(of_turn: object, bias: Array, impulse: Array, error: Array) -> Array:
        return impulse + factors.astype(error.dtype) * (update(of_turn, bias, impulse, error) - impulse)

    def sweep(now: tuple, before: tuple) -> tuple:
        new = _sweep_all(rows, relaxed, coefficients, zeros, *now)
        return jax.tree.map(lambda x, a, b: x + MOMENTUM * (a - b), new, now, before)

    def two_sweeps(_: Array, carry: tuple) -> tuple:
        # Each sweep takes the place of the one before the last: a loop of single ones would copy both.
        now, before = carry
        before = sweep(now, before)
        return sweep(before, now), before

    start = (nothing, zeros)
    return lax.fori_loop(0, -(-iterations // 2), two_sweeps, (start, start))[0][1]


def _accelerate(rows: tuple[Rows, ...]) -> bool:
    return all(isinstance(group.law, Cone) for group in rows)


def _no_velocity(rows: tuple[Rows, ...]) -> Array:
    response = rows[0].response[0]
    return jnp.zeros((response.shape[2], rows[0].table.block_count, response.shape[4]), response.dtype)
