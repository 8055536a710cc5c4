"""`spread` and `add_slices`: a broadcast and a sum along short axes, each the transpose of the other; extremes too.

The transpose of an ordinary broadcast is a reduction, which XLA on CPUs computes by a library call or a scalar loop: for
the few rows and components of a constraint that takes longer than everything around it. A sum of slices is fused with
whatever needs it, and runs side by side for all worlds. The transpose of a sum written slice by slice is a concatenation
that branches for every element; that of `add_slices` is a broadcast.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.settle import store, store_cotangents

FEW_SLICES = 64
"""Beyond, a loop of the library costs less than the code of as many terms takes to compile."""


def spread(array: Array, shape: tuple[int, ...]) -> Array:
    """Repeats an array along its axes of size 1; the last axis, that of the worlds, is left as it is.

    Args:
      array: (..., world), as many axes as `shape`.
      shape: sizes to reach; its last entry is ignored.
    """
    shape = (*shape[:-1], array.shape[-1])
    return array if array.shape == shape else _spread_p.bind(array, shape=shape)


def for_each(count: int, tree: Any) -> Any:
    """Every array (..., world) of a pytree `count` times, on a new leading axis."""
    return jax.tree.map(lambda x: spread(x[None], (count, *x.shape)), tree)


def repeat_worlds(tree: Any, count: int, worlds: int) -> Any:
    """Copies of all worlds, one for each of some things to be done in all of them; what worlds share stays so."""

    def repeat(x: Array) -> Array:
        if x.shape[-1] < worlds or worlds == 1:
            return x
        return spread(x[..., None, :], (*x.shape[:-1], count, worlds)).reshape(*x.shape[:-1], count * worlds)

    # The sum over the copies would else compute the cotangent of each of them in a single kernel, world by world.
    return store_cotangents(jax.tree.map(repeat, tree))


def add_slices(array: Array, axis: int) -> Array:
    """Sum along a short axis, which is removed."""
    axis %= array.ndim
    total = array if array.shape[axis] == 1 else _add_slices_p.bind(array, axis=axis)
    return jnp.squeeze(total, axis)


def add_scaled(values: Array, factors: Array) -> Array:
    """Sum (..., world) of some values (..., term, world), each times its factor (term, world)."""
    factors = factors.reshape(*(1,) * (values.ndim - 2), *factors.shape)
    terms = values * spread(factors, values.shape)
    return add_slices(terms, -2) if values.shape[-2] <= FEW_SLICES else terms.sum(-2)


def diagonal(matrix: Array) -> Array:
    """(row, world) of a matrix (row, row, world). Its transpose is one selection; that of indexing pads every row."""
    own = jnp.where(np.eye(len(matrix), dtype=bool)[..., None], matrix, 0.0)
    return add_slices(own, 1) if len(matrix) <= FEW_SLICES else own.sum(1)


def add_all_slices(array: Array) -> Array:
    """Sum (world,) of numbers, each computed once, along all axes but the last."""
    array = store(array, array)
    if array.size <= FEW_SLICES * array.shape[-1]:
        return add_slices(array.reshape(-1, array.shape[-1]), 0)
    while array.ndim > 1:
        array = add_slices(array, 0) if len(array) <= FEW_SLICES else array.sum(0)
        array = store(array, array)
    return array


def largest_slice(array: Array) -> Array:
    """Maximum (world,) along all axes but the last."""
    return greatest(array.reshape(-1, array.shape[-1]))


def greatest(array: Array) -> Array:
    """Maximum along the leading axis."""
    return functools.reduce(jnp.maximum, unstack(array, 0)) if len(array) <= FEW_SLICES else array.max(0)


def least(array: Array) -> Array:
    """Minimum along the leading axis."""
    return functools.reduce(jnp.minimum, unstack(array, 0)) if len(array) <= FEW_SLICES else array.min(0)


def _broadcast(array: Array, *, shape: tuple[int, ...]) -> Array:
    return jnp.broadcast_to(array, shape)


def _transpose_spread(cotangent: Any, array: Any, *, shape: tuple[int, ...]) -> list[Any]:
    if type(cotangent) is ad.Zero:
        return [ad.Zero(array.aval)]
    for axis, (have, want) in enumerate(zip(array.aval.shape, shape, strict=True)):
        if have != want:
            cotangent = _add_slices_p.bind(cotangent, axis=axis)
    return [cotangent]


def _batch_spread(args: tuple[Array], axes: tuple[int], *, shape: tuple[int, ...]) -> tuple[Array, int]:
    array = jnp.moveaxis(args[0], axes[0], 0)
    return _spread_p.bind(array, shape=(array.shape[0], *shape)), 0


def _sum(array: Array, *, axis: int) -> Array:
    return functools.reduce(jnp.add, jax.lax.split(array, (1,) * array.shape[axis], axis))


def _transpose_sum(cotangent: Any, array: Any, *, axis: int) -> list[Any]:
    if type(cotangent) is ad.Zero:
        return [ad.Zero(array.aval)]
    return [_spread_p.bind(cotangent, shape=array.aval.shape)]


def _batch_sum(args: tuple[Array], axes: tuple[int], *, axis: int) -> tuple[Array, int]:
    return _add_slices_p.bind(jnp.moveaxis(args[0], axes[0], 0), axis=axis + 1), 0


_spread_p = Primitive("spread")
_spread_p.def_impl(_broadcast)
_spread_p.def_abstract_eval(lambda array, *, shape: ShapedArray(shape, array.dtype))
ad.deflinear2(_spread_p, _transpose_spread)
batching.primitive_batchers[_spread_p] = _batch_spread
mlir.register_lowering(_spread_p, mlir.lower_fun(_broadcast, multiple_results=False))

_add_slices_p = Primitive("add_slices")
_add_slices_p.def_impl(_sum)
_add_slices_p.def_abstract_eval(
    lambda array, *, axis: ShapedArray((*array.shape[:axis], 1, *array.shape[axis + 1 :]), array.dtype)
)
ad.deflinear2(_add_slices_p, _transpose_sum)
batching.primitive_batchers[_add_slices_p] = _batch_sum
mlir.register_lowering(_add_slices_p, mlir.lower_fun(_sum, multiple_results=False))
