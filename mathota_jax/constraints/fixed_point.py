"""The derivative of solved impulses of a dense matrix of rows, by one dense system.

At the solution ``x = U(x, A x + b)`` with the laws U of all rows, so ``(1 - K - H A) dx = dU`` with the Jacobians K and H of
U by impulses and errors, and dU what U changes at fixed impulses. Redundant rows make the system singular, but consistent:
proximal steps as in `solver.implicit`. Sweeps find dx slowly where stiff drives connect feet that stick: these pull against
each other through the legs, which give way by next to nothing, and a derivative that has not converged creeps.

Of a face whose sweeps end while the errors of its points do not fit one another, the right side holds what no impulses
answer to. It is taken out first; over delta it would be velocities where points slide in several directions.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.scipy.linalg import lu_solve

from mathota_jax.constraints.mechanism_contacts import by_group, in_order
from mathota_jax.solver.delassus import Delassus
from mathota_jax.solver.implicit import jacobians_of
from mathota_jax.solver.rows import Rows
from mathota_jax.spatial.indexing import in_every_world
from mathota_jax.spatial.settle import compute_once

DELTA = 1e-3
"""Weight of the proximal term beside 1, see `solver.implicit`. Where gaps do not quite fit one another rows are not quite
redundant: with 1e-6 a box that lands beside a pendulum had a derivative of 4930 for -81, and the largest error in 833 steps
was 110 times the derivative; with 1e-3 it is 2.5 times."""

STEPS = 3
"""Proximal steps. Each leaves the share delta / (delta + s) of the error along a mode of stiffness s."""

PASSES = 2
"""So often what nothing answers to is taken out. Each time a share of round-off over delta remains."""


@jax.custom_jvp
def derive(rows: tuple[Rows, ...], delassus: Delassus, errors: Array, found: Array) -> Array:
    """Impulses (row, world) that were `found`, with the derivative of the solution.

    Args:
      rows: groups of rows, of which laws and biases matter.
      delassus: of all rows, without derivative.
      errors: (row, world) rates with the impulses `found`, as they depend on all else.
      found: (row, world), without derivative.
    """
    del rows, delassus, errors
    return found


@derive.defjvp
def _derive_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    rows, delassus, errors, _ = primals
    d_rows, _, d_errors, _ = tangents
    impulses = derive(*primals)

    def update(laws: Any, biases: Any, errors: Array) -> Array:
        """What the laws make of the impulses."""
        parts = zip(laws, by_group(rows, impulses), biases, by_group(rows, errors), strict=True)
        return in_order([law.update(impulse, bias + error) for law, impulse, bias, error in parts])

    of_rows, d_of_rows = (
        (tuple(group.law for group in groups), tuple(group.bias for group in groups)) for groups in (rows, d_rows)
    )
    change = jax.jvp(update, (*of_rows, errors), (*d_of_rows, d_errors))[1]
    return impulses, _solve(_system(rows, delassus.whole(), impulses, by_group(rows, errors)), change)


def _system(rows: tuple[Rows, ...], matrix: Array, impulses: Array, errors: tuple[Array, ...]) -> Array:
    """``1 - K - H A``, (world, row, row)."""
    matrix = in_every_world(matrix, impulses.shape[-1])
    found, first = [], 0
    for group, impulse, error in zip(rows, by_group(rows, impulses), errors, strict=True):
        turns, size, points, worlds = impulse.shape
        blocks, count = turns * points, turns * points * size
        # (turn, row, row', point, world) to (point, row, row', world)
        by_impulse, by_error = (
            jnp.moveaxis(part, 3, 1).reshape(blocks, size, size, worlds)
            for part in compute_once(jacobians_of(group.law, impulse, group.bias + error), impulse)
        )
        own = matrix[first : first + count].reshape(blocks, size, -1, worlds)
        passed = functools.reduce(jnp.add, [by_error[:, :, k, None] * own[:, None, k] for k in range(size)])
        unit = jnp.eye(size, dtype=own.dtype)[..., None] - by_impulse
        diagonal = jnp.where(np.eye(blocks, dtype=bool)[:, None, :, None, None], unit[:, :, None], 0.0)
        sides = ((0, 0), (first, len(matrix) - first - count), (0, 0))
        found.append(jnp.pad(diagonal.reshape(count, count, worlds), sides) - passed.reshape(count, -1, worlds))
        first += count
    return jnp.moveaxis(jnp.concatenate(found), -1, 0)


def _solve(system: Array, right: Array) -> Array:
    """Solutions (row, world); linear in `right`."""
    factors = lax.linalg.lu(system + DELTA * jnp.eye(system.shape[-1], dtype=system.dtype))[:2]
    right = right.T
    solve = jax.vmap(lambda lu, pivots, right: lu_solve((lu, pivots), right))

    def steps(right: Array) -> tuple[Array, Array]:
        """What they find, and what they leave of the right side."""
        found, left = jnp.zeros_like(right), right
        for _ in range(STEPS):
            way = solve(*factors, left)
            found, left = found + way, DELTA * way
        return found, left

    for _ in range(PASSES):
        right = right - steps(right)[1]
    return steps(right)[0].T
