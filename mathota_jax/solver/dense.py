"""Small dense systems that are symmetric and positive definite, worlds last."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax


def solve(matrix: Array, right: Array) -> Array:
    """Solutions (system, n, right side, world) of (system, n, n, world) systems.

    Gauss-Jordan elimination: positive definite, and so without exchanges.
    """
    count = matrix.shape[1]
    rows = jnp.concatenate([matrix, right], axis=2)

    def pivot(rows: Array, place: Array) -> tuple[Array, None]:
        row = lax.dynamic_index_in_dim(rows, place, axis=1)
        row = row / lax.dynamic_index_in_dim(row, place, axis=2)
        others = lax.dynamic_index_in_dim(rows, place, axis=2)
        is_pivot = (jnp.arange(count) == place)[None, :, None, None]
        return jnp.where(is_pivot, row, rows - others * row), None

    rows, _ = lax.scan(pivot, rows, jnp.arange(count))
    return rows[:, :, count:]
