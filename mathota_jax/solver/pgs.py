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
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver.laws import Law
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
from mathota_jax.solver.table import Table, TracedTable
from mathota_jax.spatial import counter
from mathota_jax.spatial.settle import compute_once, store, store_cotangents
from mathota_jax.spatial.spread import add_slices, spread

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


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def solve(
    iterations: int, gradient_iterations: int, rows: tuple[Rows, ...], velocity: Array, impulses: tuple[Array, ...]
) -> tuple[Array, tuple[Array, ...]]:
    """Runs a fixed number of sweeps.

    Args:
      iterations: number of sweeps, 0 if the impulses are known to be solved.
      gradient_iterations: number of sweeps of the linear solver behind a derivative.
      rows: groups of rows, solved in this order within a sweep.
      velocity: (component, block, world) without any constraint impulse.
      impulses: for each group (turn, row, column, world), the impulses to start from.

    Returns:
      The velocity with the impulses, and the impulses.
    """
    velocity = add_impulses(rows, velocity, impulses)
    if not rows or not iterations:
        return compute_once((velocity, impulses), velocity)
    biases = tuple(group.bias for group in rows)
    laws = tuple(group.law for group in rows)

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
        velocity, old = carry
        new, of_turn = [], functools.partial(update, number)
        for group, coefficient, bias, impulse in zip(rows, coefficients, biases, old, strict=True):
            velocity, impulse = _sweep(group, of_turn, coefficient, bias, velocity, impulse)
            new.append(impulse)
        return velocity, tuple(new)

    if iterations == 1:
        return sweep(0, (velocity, impulses))
    return lax.fori_loop(0, iterations, sweep, (velocity, impulses))


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
    rows, velocity, impulses = primals
    d_rows, d_velocity, _ = tangents
    velocity, impulses = solve(iterations, gradient_iterations, rows, velocity, impulses)
    if not rows:
        return (velocity, impulses), (d_velocity, impulses)
    rows, d_rows = _dense(rows, d_rows)
    d_velocity, jacobians, right_sides = linearise(rows, d_rows, velocity, impulses, d_velocity)
    d_impulses = _solve_linear(gradient_iterations, rows, jacobians, right_sides)
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
) -> tuple[Array, tuple[tuple[Array, Array], ...], tuple[Array, ...]]:
    """Derivative of the fixed point of all laws, but for the change of the impulses. The matrices are dense.

    Returns:
      The change of the velocity at fixed impulses; for each group the Jacobians of its law with respect to impulse and
      error, and the change of its impulses at fixed impulses.
    """
    for group, d_group, impulse in zip(visiting_all_turns(rows), d_rows, impulses, strict=True):
        d_velocity = add_changes(group, d_group.matrix, d_velocity, impulse)
    jacobians, right_sides = [], []
    for group, d_group, impulse in zip(rows, d_rows, impulses, strict=True):
        # The error goes into every entry of the Jacobians of the law, its cotangent into that of every entry of the matrix.
        error = compute_once(group.bias + row_velocity(group, velocity), velocity)
        d_error = d_group.bias + row_velocity(group, d_velocity)
        d_error = store_cotangents(d_error + matrix_velocity(group.table, d_group.matrix, group.places, velocity))
        jacobians.append(_linearise(group.law, impulse, error))
        right_sides.append(
            jax.jvp(lambda law, error: law.update(impulse, error), (group.law, error), (d_group.law, d_error))[1]  # noqa: B023
        )
    return d_velocity, tuple(jacobians), tuple(right_sides)


def _solve_linear(
    iterations: int, rows: tuple[Rows, ...], jacobians: tuple[tuple[Array, Array], ...], right_sides: tuple[Array, ...]
) -> tuple[Array, ...]:
    """Solves ``x = K x + H J (M^-1 J^T x) + right side`` by sweeps; transposable and differentiable in everything.

    `jacobians` holds for each group the Jacobians K and H of its law with respect to impulse and error. The transposed
    system, ``z = K^T z + (M^-1 J^T)^T (J^T H^T z) + ...``, has the same form: Jacobian and response change places.
    """
    everywhere = visiting_all_turns(rows)  # the product is transposed too

    def product(x: tuple[Array, ...]) -> tuple[Array, ...]:
        velocity = add_impulses(everywhere, _no_velocity(rows), x)
        return tuple(
            part - _apply(by_impulse, part) - _apply(by_error, row_velocity(group, velocity))
            for part, group, (by_impulse, by_error) in zip(x, rows, jacobians, strict=True)
        )

    def solve_forward(_: Callable, right_sides: tuple[Array, ...]) -> tuple[Array, ...]:
        coefficients = tuple((*jacobian, side) for jacobian, side in zip(jacobians, right_sides, strict=True))
        return _linear_sweeps(iterations, rows, coefficients)

    def solve_transposed(_: Callable, right_sides: tuple[Array, ...]) -> tuple[Array, ...]:
        swapped, coefficients = [], []
        for group, (by_impulse, by_error), side in zip(rows, jacobians, right_sides, strict=True):
            weighted = tuple(_weigh(jacobian, by_error) for jacobian in group.jacobian)
            swapped.append(dataclasses.replace(group, matrix=Dense(group.response, weighted)))
            coefficients.append((jnp.swapaxes(by_impulse, 1, 2), None, side))
        return _linear_sweeps(iterations, tuple(swapped), tuple(coefficients))

    return lax.custom_linear_solve(product, right_sides, solve_forward, transpose_solve=solve_transposed)


def _linear_sweeps(iterations: int, rows: tuple[Rows, ...], coefficients: tuple[object, ...]) -> tuple[Array, ...]:
    zeros = tuple(jnp.zeros_like(group.bias) for group in rows)
    return sweeps(iterations, rows, _linear_update, coefficients, zeros, _no_velocity(rows), zeros)[1]


def _no_velocity(rows: tuple[Rows, ...]) -> Array:
    response = rows[0].response[0]
    return jnp.zeros((response.shape[2], rows[0].table.block_count, response.shape[4]), response.dtype)


def _apply(matrix: Array, x: Array) -> Array:
    """(turn, row, row', ...) times (turn, row', ...)."""
    return add_slices(matrix * spread(x[:, None], matrix.shape), 2)


def _weigh(jacobian: Array, by_error: Array) -> Array:
    """``H J``: (turn, row, component, ...), the velocity change that a unit of each adjoint row causes."""
    terms = [by_error[:, :, row, None] * jacobian[:, None, row] for row in range(jacobian.shape[1])]
    return functools.reduce(jnp.add, terms)


def _linearise(law: Law, impulse: Array, error: Array) -> tuple[Array, Array]:
    """Jacobians (turn, row, row', column, world) of a law with respect to the impulse and the error."""
    row_count = impulse.shape[1]

    def column(argument: int, row: int) -> Array:
        basis = jnp.zeros_like(impulse).at[:, row].set(1.0)
        zero = jnp.zeros_like(impulse)
        directions = (basis, zero) if argument == 0 else (zero, basis)
        return jax.jvp(law.update, (impulse, error), directions)[1]

    return tuple(jnp.stack([column(argument, row) for row in range(row_count)], axis=2) for argument in (0, 1))  # type: ignore[return-value]


def _linear_update(_: Array | int, coefficients: object, __: Array, impulse: Array, error: Array) -> Array:
    by_impulse, by_error, right_side = coefficients  # type: ignore[misc]
    new = right_side if by_error is not None else right_side + error
    for row in range(impulse.shape[0]):
        new = new + by_impulse[:, row] * impulse[row]
        if by_error is not None:
            new = new + by_error[:, row] * error[row]
    return new
