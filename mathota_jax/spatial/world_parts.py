"""Large batches, some worlds at a time, so that what is computed on the way to a result stays in the cache.

XLA on CPUs runs a program as some hundred kernels one after the other, each over all worlds. What one leaves to the next is
larger than a cache from some hundred worlds on: measured at 4096 worlds, a step takes 1.6 to 2 times as long for each of
them as at 256. A loop over parts of the batch costs the copies of what goes in and out, and one program more to compile:
it pays where much is computed for each byte of those.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, Jaxpr

from mathota_jax.spatial import counter

FEWEST, MOST = 64, 256
"""Worlds at a time: fewer leave kernels that take no longer to run than to launch."""

PASSED_AT_A_TIME = 2**19
"""Bytes of the arguments of a part. Measured best: 256 worlds for a box, 128 for a stack of ten, 64 for a pile of 27."""

COMPUTED_AT_A_TIME = 2**26
"""Bytes that a function computes for a part of which its derivative is computed, which keeps what the function lets go.
Measured best for gradients: 64 worlds for five stacked boxes (1.0 MB a world), 0.78 of the time of 256; 256 for five links
(0.2 MB) and for a box (0.04)."""

LANES = 16
"""Parts are cut at multiples of so many worlds, those of the widest vectors."""

WORTHWHILE = 64
"""Bytes computed for each byte that goes in or out from which on parts pay. Measured: at 15 and 29 (a ball that bounces, or
rolls) they cost 15 to 30 % of the rate, from 89 (a box that slides) on they gain."""

WORTHWHILE_OF_DERIVATIVES = 32
"""The same of a function of which a derivative is computed, three times as much for twice as many bytes. Measured for
gradients at 1024 worlds and more: at 13 (a bounce) parts cost 22 % of the rate, at 25 (a roll) 4 %, at 58 to 79 they gain 17
(eight stacked boxes at 256 worlds) to 40 % (five)."""


def part_size(worlds: int, args: Sequence[Any]) -> int:
    """Number of worlds of the parts into which a batch of arguments (..., world or 1) may be cut; all for none."""
    passed = sum(bytes_of([arg]) // arg.shape[-1] for arg in args if arg.shape[-1] > 1)
    return _size(worlds, PASSED_AT_A_TIME / max(passed, 1))


def part_size_of_derivative(worlds: int, program: ClosedJaxpr, size: int) -> int:
    """The same for a derivative of the program, which is that of so many worlds."""
    return min(size, _size(worlds, COMPUTED_AT_A_TIME * size / max(bytes_computed(program.jaxpr), 1)))


def _size(worlds: int, best: float) -> int:
    count = round(worlds / min(max(2 ** round(math.log2(best)), FEWEST), MOST))
    return -(-worlds // (count * LANES)) * LANES if count > 1 else worlds


def parts_pay(program: ClosedJaxpr, worlds: int, *, of_derivative: bool) -> bool:
    """Whether a loop over parts of so many worlds, each with this program or a derivative of it, computes enough to pay."""
    passed = bytes_of([aval for aval in (*program.in_avals, *program.out_avals) if aval.shape[-1] == worlds])
    return bytes_computed(program.jaxpr) >= (WORTHWHILE_OF_DERIVATIVES if of_derivative else WORTHWHILE) * passed


def bytes_computed(program: Jaxpr) -> int:
    """Bytes of all that a program computes, its loops gone through once."""
    total = 0
    for equation in program.eqns:
        inner = [value for value in jax.tree.leaves(equation.params) if isinstance(value, (Jaxpr, ClosedJaxpr))]
        total += sum(bytes_computed(value.jaxpr if isinstance(value, ClosedJaxpr) else value) for value in inner)
        total += 0 if inner else bytes_of([out.aval for out in equation.outvars])
    return total


def bytes_of(arrays: Sequence[Any]) -> int:
    """Bytes of arrays, or of what has their shape and type."""
    return sum(math.prod(array.shape) * np.dtype(array.dtype).itemsize for array in arrays)


def by_parts(function: Callable[[Sequence[Array]], list[Array]], arrays: Sequence[Array], size: int) -> list[Array]:
    """`function` of arrays (..., world or 1), each world by itself, for so many worlds at a time; not differentiable."""
    worlds = max(array.shape[-1] for array in arrays)

    def corner(k: Array, ndim: int) -> tuple[Array, ...]:
        # The last part begins earlier where the worlds do not come out even: some are computed twice.
        return (*[jnp.int32(0)] * (ndim - 1), jnp.minimum(counter.index(k) * size, worlds - size))

    def part(whole: Array, k: Array) -> Array:
        if whole.shape[-1] == 1:
            return whole
        shape = (*whole.shape[:-1], size)
        return lax.dynamic_slice(whole, corner(k, whole.ndim), shape, allow_negative_indices=False)

    def put(whole: Array, found: Array, k: Array) -> Array:
        if found.shape[-1] == 1:
            return found
        return lax.dynamic_update_slice(whole, found, corner(k, whole.ndim), allow_negative_indices=False)

    def results(k: Array) -> list[Array]:
        return function([part(array, k) for array in arrays])

    def body(_: Array, carry: tuple[Array, list[Array]]) -> tuple[Array, list[Array]]:
        k, wholes = carry
        return counter.following(k), [put(*pair, k) for pair in zip(wholes, results(k), strict=True)]

    empty = [
        jnp.zeros((*found.shape[:-1], worlds if found.shape[-1] > 1 else 1), found.dtype)
        for found in jax.eval_shape(results, counter.start())
    ]
    return lax.fori_loop(0, -(-worlds // size), body, (counter.start(), empty))[1]
