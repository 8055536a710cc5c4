"""Arrays inside `jax.shard_map`, where each device runs the same program on worlds of its own.

JAX types an array there by the mesh axes along which devices hold different values. What operations of `jax.numpy` do by
themselves, a primitive of one's own must do: bring its arguments to one type, and say that of its results. Outside of
`jax.shard_map`, or with ``check_vma=False``, there are no such types, and nothing here does anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax import Array, lax
from jax.core import ShapedArray, Tracer


def as_varying(arrays: Sequence[Array]) -> list[Array]:
    """The arrays, each along all axes along which one of them varies.

    The cotangent of one that all devices share is the sum of theirs.
    """
    if not any(isinstance(array, Tracer) for array in arrays):
        return list(arrays)
    axes = [_axes(jax.typeof(array)) for array in arrays]
    union = frozenset().union(*axes)
    return [
        _cast(array, tuple(sorted(union - own))) if union - own else array
        for array, own in zip(arrays, axes, strict=True)
    ]


def result_types(signatures: Sequence[tuple[tuple[int, ...], Any]], arguments: Sequence[Any]) -> list[Any]:
    """Types of results of given shapes that vary as the (equally varying) arguments do."""
    plain = [ShapedArray(shape, dtype) for shape, dtype in signatures]
    varying = next((argument for argument in arguments if _axes(argument)), None)
    if varying is None:
        return plain

    def results(argument: Array) -> list[Array]:
        nothing = argument.reshape(-1)[:0].sum()
        return [lax.full(shape, 0, dtype) + nothing.astype(dtype) for shape, dtype in signatures]

    return list(jax.make_jaxpr(results)(varying).out_avals)


def _axes(aval: Any) -> frozenset[Any]:
    """Mesh axes along which an array of this type varies; their name has changed between versions of JAX."""
    kind = getattr(aval, "manual_axis_type", None)
    return getattr(aval, "vma", frozenset()) if kind is None else kind.varying


def _cast(array: Array, axes: tuple[Any, ...]) -> Array:
    if hasattr(lax, "pcast"):
        return lax.pcast(array, axes, to="varying")
    return lax.pvary(array, axes)  # pyright: ignore[reportAttributeAccessIssue]  # until JAX 0.8
