"""Work on the filled part of a table whose size is known only in the step."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

FEWEST, MOST = 5, 12
"""Rows computed at a time: few enough to leave out most of an empty table, many enough to keep a single world busy."""


def map_filled(function: Callable[[Any], Any], tree: Any, filled: Array) -> Any:
    """`function` of the rows of a table, chunk by chunk, and 0 in the chunks behind the filled rows.

    The program holds `function` once, whatever the size of the table.

    Args:
        function: From a pytree of arrays (row, ...) to one of arrays (row * k, ...), each row by itself.
        tree: Pytree of arrays (row, ...).
        filled: () number of rows that hold something; they are the first ones.
    """
    count = jax.tree.leaves(tree)[0].shape[0]
    chunk_count = _chunk_count(count)
    size = math.ceil(count / chunk_count)
    padding = chunk_count * size - count
    evaluate = jax.jit(function)  # traced once, for its shapes and for its values

    def split(values: Array) -> Array:
        if padding:
            values = jnp.concatenate([values, jnp.repeat(values[-1:], padding, axis=0)])
        return values.reshape(chunk_count, size, *values.shape[1:])

    chunks = jax.tree.map(split, tree)
    shapes = jax.eval_shape(evaluate, jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), chunks))

    def empty(_: Any) -> Any:
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def body(first: Array, rows: Any) -> tuple[Array, Any]:
        return first + size, lax.cond(first < filled, evaluate, empty, rows)

    _, results = lax.scan(body, jnp.zeros((), filled.dtype), chunks)

    def join(values: Array) -> Array:
        rows_of_one = values.shape[1] // size
        return values.reshape(-1, *values.shape[2:])[: count * rows_of_one]

    return jax.tree.map(join, results)


def _chunk_count(count: int) -> int:
    """Chunks of equal size if there is such a number, since padding is copied."""
    counts = range(math.ceil(count / MOST), math.ceil(count / FEWEST) + 1)
    return next((k for k in counts if count % k == 0), counts[0])
