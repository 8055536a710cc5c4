"""Work on the filled part of a table whose size is known only in the step."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import eval_jaxpr

from mathota_jax.spatial.by_platform import by_platform
from mathota_jax.spatial.chunk_derivatives import Chunked, tangents

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

    def split(values: Array) -> Array:
        if padding:
            values = jnp.concatenate([values, jnp.repeat(values[-1:], padding, axis=0)])
        return values.reshape(chunk_count, size, *values.shape[1:])

    chunks = jax.tree.map(split, tree)
    leaves = jax.tree.leaves(chunks)
    program, result = jax.make_jaxpr(jax.jit(function), return_shape=True)(jax.tree.map(lambda x: x[0], chunks))
    constants = program.consts

    def of_leaves(*leaves: Array) -> list[Array]:
        return eval_jaxpr(program.jaxpr, leaves[: len(constants)], *leaves[len(constants) :])

    shapes = tuple(jax.tree.leaves(result))
    chunked = Chunked(of_leaves, len(constants), chunk_count, shapes)
    results = _map_chunks(chunked, [*constants, *leaves], -(-filled // size))

    def join(values: Array) -> Array:
        rows_of_one = values.shape[1] // size
        return values.reshape(-1, *values.shape[2:])[: count * rows_of_one]

    return jax.tree.unflatten(jax.tree.structure(result), [join(values) for values in results])


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _map_chunks(chunked: Chunked, leaves: list[Array], used: Array) -> list[Array]:
    """The function of the chunks in use, stacked, and 0 elsewhere."""
    # A GPU waits longer for the end of a loop to be known than for the work on what is empty.
    return by_platform(chunked.in_loop, chunked.at_once, list(chunked.shapes), leaves, used)


def _map_chunks_jvp(chunked: Chunked, primals: tuple, changes: tuple) -> tuple[list[Array], list[Any]]:
    leaves, used = primals
    return _map_chunks(chunked, leaves, used), tangents(chunked, leaves, used, changes[0])


_map_chunks.defjvp(_map_chunks_jvp, symbolic_zeros=True)


def _chunk_count(count: int) -> int:
    """Chunks of equal size if there is such a number, since padding is copied."""
    counts = range(math.ceil(count / MOST), math.ceil(count / FEWEST) + 1)
    return next((k for k in counts if count % k == 0), counts[0])
