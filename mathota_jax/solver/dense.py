"""Small dense systems, worlds last."""

from __future__ import annotations

import functools

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.spatial.settle import store
from mathota_jax.spatial.spread import add_slices, greatest, least


def solve(matrix: Array, right: Array) -> Array:
    """Solutions (system, n, right side, world) of (system, n, n, world) systems, symmetric and positive definite.

    Gauss-Jordan elimination, so without exchanges.
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


def inverse(matrix: Array, size: int) -> Array:
    """Inverses (n, n, world) of (n, n, world), whose diagonal blocks of `size` rows are what is pivoted by.

    Gauss-Jordan elimination of whole blocks, with exchanges of rows within each.
    """
    count = matrix.shape[0]
    if count == size:
        return _inverse_of_block(matrix)
    numbers = jnp.arange(count, dtype=jnp.int32)

    def eliminate(matrix: Array, first: Array) -> tuple[Array, None]:
        here = (numbers >= first) & (numbers < first + size)
        rows, columns = (lax.dynamic_slice_in_dim(matrix, first, size, axis=axis) for axis in range(2))
        block = _stored(_inverse_of_block(lax.dynamic_slice_in_dim(rows, first, size, axis=1)))
        unit = jnp.where(numbers[None] == first + numbers[:size, None], 1.0, 0.0)[..., None]
        rows = _stored(jnp.where(here[:, None], unit.astype(rows.dtype), rows))
        rows = _stored(product(block, rows))
        columns = _stored(jnp.where(here[:, None, None], 0.0, columns))
        others = jnp.where(here[:, None], 0.0, matrix) - product(columns, rows)
        return lax.dynamic_update_slice_in_dim(others, rows, first, axis=0), None

    return lax.scan(eliminate, matrix, jnp.arange(0, count, size, dtype=jnp.int32))[0]


def product(left: Array, right: Array) -> Array:
    """(a, b, world) of (a, k, world) and (k, b, world)."""
    return functools.reduce(jnp.add, [left[:, k, None] * right[None, k] for k in range(left.shape[1])])


def _inverse_of_block(matrix: Array) -> Array:
    """Inverse of a small one, in place; where its rows come from is remembered, and sorts the columns in the end."""
    count = len(matrix)
    numbers = jnp.arange(count, dtype=jnp.int32)[:, None]
    order = jnp.broadcast_to(numbers, (count, matrix.shape[-1])).astype(matrix.dtype)

    def pivot(carry: tuple[Array, Array], place: Array) -> tuple[tuple[Array, Array], None]:
        rows, order = carry
        column = _stored(lax.dynamic_index_in_dim(rows, place, axis=1, keepdims=False))
        size = jnp.where(numbers >= place, jnp.abs(column), -1.0)
        number = least(jnp.where(size >= greatest(size), numbers, count))
        chosen, here = _stored((numbers == number).astype(matrix.dtype)), numbers == place

        def exchanged(values: Array) -> tuple[Array, Array]:
            """The chosen row, and all rows once the one at the place of the pivot has taken its own."""
            own = chosen if values.ndim == 2 else chosen[:, None]
            displaced = lax.dynamic_index_in_dim(values, place, axis=0)
            return add_slices(values * own, 0), jnp.where(own > 0.5, displaced, values)

        (row, rows), (entry, column), (label, order) = (exchanged(values) for values in (rows, column, order))
        row = _stored(jnp.where(here, 1.0, row) / entry)
        rows = jnp.where(here[None], 0.0, rows) - _stored(column)[:, None] * row
        return (jnp.where(here[:, None], row, rows), jnp.where(here, label, order)), None

    (rows, order), _ = lax.scan(pivot, (matrix, order), jnp.arange(count, dtype=jnp.int32))
    places = jnp.stack([jnp.where(order == place, 1.0, 0.0) for place in range(count)], axis=1).astype(rows.dtype)
    return product(rows, _stored(places))


def _stored(values: Array) -> Array:
    return store(values, values)
