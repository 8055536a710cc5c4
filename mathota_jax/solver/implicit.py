"""The linear system behind the derivative of solved impulses, solved densely.

``x = K x + H J M^-1 J^T x + r`` with K and H the Jacobians of the laws. Redundant rows make it singular, though
consistent: many impulses, one velocity. Proximal steps ``(1 - K + delta - H J M^-1 J^T) x' = delta x + r`` from 0
share one factorization and converge to a solution whose velocity is the right one.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver import velocity_system
from mathota_jax.solver.laws import Law
from mathota_jax.solver.rows import Rows, add_impulses, row_velocity, visiting_all_turns

STEPS = 20
"""Proximal steps. Each leaves the share delta / (delta + s) of the error along a mode of stiffness s."""

DELTA = {"float32": 1e-4, "float64": 1e-8}
"""Weight of the proximal term beside 1: well above round-off."""


def solve(
    rows: tuple[Rows, ...],
    jacobians: tuple[tuple[Array, Array], ...],
    right_sides: tuple[Array, ...],
    velocity: Array,
) -> tuple[Array, tuple[Array, ...]]:
    """Velocity ``d + M^-1 J^T x`` and impulses x; linear in `right_sides` and `velocity` (d), and transposable.

    Args:
      rows: groups of rows.
      jacobians: for each group K and H, (turn, row, row', column, world).
      right_sides: r for each group, (turn, row, column, world).
      velocity: d, (component, block, world).
    """
    rows = visiting_all_turns(rows)
    delta = DELTA[str(velocity.dtype)]
    inverses = tuple(_inverse(by_impulse, delta) for by_impulse, _ in jacobians)
    slopes = tuple(_product(inverse, by_error) for inverse, (_, by_error) in zip(inverses, jacobians, strict=True))
    factor = velocity_system.factorize(rows, slopes, velocity.shape[0])
    settled = tuple(_apply(inverse, side) for inverse, side in zip(inverses, right_sides, strict=True))

    def step(_: int, carry: tuple[Array, tuple[Array, ...]]) -> tuple[Array, tuple[Array, ...]]:
        fixed = tuple(
            side + delta * _apply(inverse, part)
            for side, inverse, part in zip(settled, inverses, carry[1], strict=True)
        )
        new = velocity_system.solve(factor, add_impulses(rows, jnp.zeros_like(velocity), fixed))
        impulses = tuple(
            part + _apply(matrix, row_velocity(group, new))
            for part, matrix, group in zip(fixed, slopes, rows, strict=True)
        )
        return new, impulses

    start = tuple(jnp.zeros_like(side) for side in settled)
    _, impulses = lax.fori_loop(0, STEPS, step, (jnp.zeros_like(velocity), start))
    return add_impulses(rows, velocity, impulses), impulses


def jacobians_of(law: Law, impulse: Array, error: Array) -> tuple[Array, Array]:
    """Jacobians (turn, row, row', column, world) of a law with respect to the impulse and the error."""
    row_count = impulse.shape[1]

    def column(argument: int, row: int) -> Array:
        basis = jnp.zeros_like(impulse).at[:, row].set(1.0)
        zero = jnp.zeros_like(impulse)
        directions = (basis, zero) if argument == 0 else (zero, basis)
        return jax.jvp(law.update, (impulse, error), directions)[1]

    return tuple(jnp.stack([column(argument, row) for row in range(row_count)], axis=2) for argument in (0, 1))  # type: ignore[return-value]


def _inverse(by_impulse: Array, delta: float) -> Array:
    """``(1 - K + delta)^-1`` for blocks of one row, or of three of which the first depends on itself alone."""
    size = by_impulse.shape[1]
    block = [[(1.0 + delta) * (i == j) - by_impulse[:, i, j] for j in range(size)] for i in range(size)]
    first = 1.0 / block[0][0]
    if size == 1:
        return first[:, None, None]
    determinant = block[1][1] * block[2][2] - block[1][2] * block[2][1]
    tangential = [
        [block[2][2] / determinant, -block[1][2] / determinant],
        [-block[2][1] / determinant, block[1][1] / determinant],
    ]
    coupling = [-(row[0] * block[1][0] + row[1] * block[2][0]) * first for row in tangential]
    zero = jnp.zeros_like(first)
    entries = [[first, zero, zero], [coupling[0], *tangential[0]], [coupling[1], *tangential[1]]]
    return jnp.stack([jnp.stack(row, axis=1) for row in entries], axis=1)


def _apply(matrix: Array, vector: Array) -> Array:
    return functools.reduce(jnp.add, [matrix[:, :, row] * vector[:, None, row] for row in range(vector.shape[1])])


def _product(left: Array, right: Array) -> Array:
    terms = [left[:, :, row, None] * right[:, None, row] for row in range(right.shape[1])]
    return functools.reduce(jnp.add, terms)
