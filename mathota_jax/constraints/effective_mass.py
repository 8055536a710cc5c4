"""Effective masses of contact points that are solved together."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.solver.coupling import point_responses
from mathota_jax.solver.row_matrix import Dense
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.safe import safe_sqrt
from mathota_jax.spatial.settle import compute_once, materialize

Entries = list[list[list[Array]]]
"""Components (turn, column, world) by side and row."""

RELAXATION = 4 / 3
"""Factor on the bounded step of a manifold. Measured: ten boxes stand with 10 sweeps at 4/3 and lean at 1."""


def entries_of(matrix: Dense) -> tuple[Entries, Entries]:
    """Entries of Jacobian and response for `row_bound`."""
    # The length of a step does not move the fixed point: its derivative is not worth computing.
    matrix = jax.lax.stop_gradient(matrix)
    jacobian, response = (
        [[unstack(row, 1) for row in unstack(side, 1)] for side in sides]
        for sides in (matrix.jacobian, matrix.response)
    )
    return jacobian, response


def row_bound(entries: tuple[Entries, Entries], together: int, active: Array, rows: tuple[int, ...]) -> Array:
    """Bound (turn, column, world) of the response of each point to impulses on all points of its manifold, along `rows`.

    The points of a manifold are solved together, which keeps the symmetry of a stack: solved one after the other they
    tilt it. A step divided by the sum of the norms of the blocks ``J_i M^-1 J_j^T`` over j can not overshoot
    (Gershgorin); the steps are lengthened by a constant, which is safe below 2. A point alone gets its exact effective
    mass.
    """
    jacobian, response = entries
    total = _largest_eigenvalue(jacobian, response, rows)
    if together == 1:
        return compute_once(total, active)

    def block(row: int, column: int) -> Array:
        return point_responses([side[row] for side in jacobian], [side[column] for side in response], together)

    blocks = [block(row, column) for row in rows for column in rows]
    if len(blocks) > 1:
        # All in one kernel is not vectorised, and takes ten times as long.
        blocks = materialize(blocks)
    squared = sum((part**2 for part in blocks), jnp.zeros(()))
    others = 1.0 - np.eye(together)[:, :, None]
    norms = safe_sqrt(squared) * (others * active.reshape(active.shape[0], -1, 1, together, active.shape[-1]))
    total = functools.reduce(jnp.add, [norms[:, :, :, k].reshape(total.shape) for k in range(together)], total)
    return compute_once(total / RELAXATION, active)


def _largest_eigenvalue(jacobian: Entries, response: Entries, rows: tuple[int, ...]) -> Array:
    """Of the response of one point along one or two rows; the arguments hold components by side and row."""

    def entry(row: int, column: int) -> Array:
        terms = [a * b for j, r in zip(jacobian, response, strict=True) for a, b in zip(j[row], r[column], strict=True)]
        return functools.reduce(jnp.add, terms)

    if len(rows) == 1:
        return entry(rows[0], rows[0])
    first, second, coupling = entry(rows[0], rows[0]), entry(rows[1], rows[1]), entry(rows[0], rows[1])
    half_difference = (first - second) / 2
    return (first + second) / 2 + safe_sqrt(half_difference * half_difference + coupling * coupling)
