"""One result, two ways to it: what is best on a CPU and what is best on a GPU are different programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax import Array
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

GPU = "cuda"
"""The platform with a way of its own."""


def by_platform(anywhere: Callable[..., Any], on_gpu: Callable[..., Any], result: Any, *args: Any) -> Any:
    """`anywhere(*args)`, or `on_gpu(*args)` in programs for GPUs.

    Only the one that is compiled is traced, when that is known. Not differentiable: for integers, and for use inside of
    custom derivatives.

    Args:
      anywhere: function of pytrees that closes over no traced array.
      on_gpu: another with the same result.
      result: pytree of what has the shapes and types of the result.
      *args: pytrees of arrays.
    """
    leaves, in_tree = jax.tree.flatten(args)
    expected, out_tree = jax.tree.flatten(result)

    def of_leaves(function: Callable[..., Any]) -> Callable[..., list[Array]]:
        return lambda *leaves: jax.tree.leaves(function(*jax.tree.unflatten(in_tree, leaves)))

    found = _by_platform_p.bind(
        *leaves,
        anywhere=of_leaves(anywhere),
        on_gpu=of_leaves(on_gpu),
        shapes=tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in expected),
    )
    return jax.tree.unflatten(out_tree, found)


def _anywhere(*leaves: Array, anywhere: Callable[..., list[Array]], **_: Any) -> list[Array]:
    return anywhere(*leaves)


def _on_gpu(*leaves: Array, on_gpu: Callable[..., list[Array]], **_: Any) -> list[Array]:
    return on_gpu(*leaves)


def _batched(
    leaves: tuple[Array, ...],
    axes: tuple[int | None, ...],
    *,
    anywhere: Callable[..., list[Array]],
    on_gpu: Callable[..., list[Array]],
    shapes: tuple[jax.ShapeDtypeStruct, ...],
) -> tuple[list[Array], list[int]]:
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, axes, strict=True) if axis is not None)
    anywhere, on_gpu = (jax.vmap(way, axes, axis_size=size) for way in (anywhere, on_gpu))
    results = tuple(jax.ShapeDtypeStruct((size, *shape.shape), shape.dtype) for shape in shapes)
    found = _by_platform_p.bind(*leaves, anywhere=anywhere, on_gpu=on_gpu, shapes=results)
    return found, [0] * len(found)


_by_platform_p = Primitive("by_platform")
_by_platform_p.multiple_results = True
_by_platform_p.def_abstract_eval(lambda *_, shapes, **__: [ShapedArray(x.shape, x.dtype) for x in shapes])
_by_platform_p.def_impl(_anywhere)
batching.primitive_batchers[_by_platform_p] = _batched
mlir.register_lowering(_by_platform_p, mlir.lower_fun(_anywhere, multiple_results=True))
mlir.register_lowering(_by_platform_p, mlir.lower_fun(_on_gpu, multiple_results=True), platform=GPU)
