"""Work on the filled part of a table whose size is known only in the step."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.core import eval_jaxpr

from mathota_jax.spatial import counter
from mathota_jax.spatial.by_platform import by_platform

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
    evaluate, constants = _without_closure(function, jax.tree.map(lambda x: x[0], chunks))
    results = _map_chunks(evaluate, constants, chunks, -(-filled // size))

    def join(values: Array) -> Array:
        rows_of_one = values.shape[1] // size
        return values.reshape(-1, *values.shape[2:])[: count * rows_of_one]

    return jax.tree.map(join, results)


def _without_closure(function: Callable[[Any], Any], example: Any) -> tuple[Callable[..., Any], list[Array]]:
    """The function with all arrays that it closes over as further arguments, and those arrays.

    `jax.closure_convert` leaves integers behind, which a custom derivative inside a loop then looks for in vain.
    """
    program, result = jax.make_jaxpr(jax.jit(function), return_shape=True)(example)

    def converted(rows: Any, *constants: Array) -> Any:
        leaves = eval_jaxpr(program.jaxpr, constants, *jax.tree.leaves(rows))
        return jax.tree.unflatten(jax.tree.structure(result), leaves)

    return converted, program.consts


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _map_chunks(function: Callable[..., Any], constants: Any, chunks: Any, used: Array) -> Any:
    """`function(chunk, *constants)` of the chunks in use, stacked, and 0 elsewhere."""

    def one_after_the_other(constants: Any, chunks: Any, used: Array) -> Any:
        def body(_: Array, carry: tuple[Array, Any]) -> tuple[Array, Any]:
            k, results = carry
            found = function(counter.row(chunks, k), *constants)
            return counter.following(k), jax.tree.map(lambda all_, x: counter.put(all_, x, k), results, found)

        return lax.fori_loop(0, used, body, (counter.start(), _zeros(shapes)))[1]

    def at_once(constants: Any, chunks: Any, used: Array) -> Any:
        # A GPU waits longer for the end of a loop to be known than for the work on what is empty.
        def of_chunk(k: Array, chunk: Any) -> Any:
            found = function(chunk, *constants)
            return jax.tree.map(lambda x: jnp.where(k < used, x, jnp.zeros_like(x)), found)

        return jax.vmap(of_chunk)(jnp.arange(count), chunks)

    count, chunk = len(jax.tree.leaves(chunks)[0]), jax.tree.map(lambda x: x[0], chunks)
    shapes = _shapes(function, constants, chunk, count)
    return by_platform(one_after_the_other, at_once, shapes, constants, chunks, used)


@_map_chunks.defjvp
def _map_chunks_jvp(function: Callable[..., Any], primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    """A loop over the chunks in use has no reverse mode; one that passes over the others has."""

    def every_chunk(constants: Any, chunks: Any, used: Array) -> Any:
        def evaluate(chunk: Any) -> Any:
            return function(chunk, *constants)

        def body(k: Array, chunk: Any) -> tuple[Array, Any]:
            return k + 1, lax.cond(k < used, evaluate, lambda chunk: _zeros(_shapes(function, constants, chunk)), chunk)

        return lax.scan(body, jnp.zeros((), used.dtype), chunks)[1]

    return jax.jvp(every_chunk, primals, tangents)


def _shapes(function: Callable[..., Any], constants: Any, chunk: Any, *count: int) -> Any:
    """What the function gives for a chunk, or for a number of them."""
    shapes = jax.eval_shape(function, chunk, *constants)
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((*count, *x.shape), x.dtype), shapes)


def _zeros(shapes: Any) -> Any:
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


def _chunk_count(count: int) -> int:
    """Chunks of equal size if there is such a number, since padding is copied."""
    counts = range(math.ceil(count / MOST), math.ceil(count / FEWEST) + 1)
    return next((k for k in counts if count % k == 0), counts[0])
