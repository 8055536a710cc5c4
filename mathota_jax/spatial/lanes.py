"""Worlds-last programs written out for the lanes of a kernel: every number becomes a vector over worlds.

The compilers of kernels (Triton) know vectors whose sizes are powers of 2, and nothing of slices, concatenations or axes of
three components. A function of arrays (..., column, world) needs none of that along its other axes, whose sizes are known
when it is traced: `written_out` traces it, and runs its operations on NumPy arrays of vectors (column, world).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend.core import ClosedJaxpr, Literal

WORLDS, COLUMNS = 7919, 1009
"""Sizes for which a function is traced: primes that no other axis has, so that its shapes tell which axis is which."""


class Entries(NamedTuple):
    """An array (..., column, world), or (..., world) where there are no columns.

    Attributes:
      vectors: NumPy array of objects along the other axes: (column or 1, lane) vectors, or () what all share.
      columns: whether there is an axis of columns.
    """

    vectors: np.ndarray
    columns: bool


def entries(shape: tuple[int, ...], vectors: list[Any], columns: bool = False) -> Entries:
    """Entries of an array whose other axes are `shape`."""
    return Entries(_objects(shape, vectors), columns)


def written_out(function: Callable[..., Any], columns: int, *args: Any) -> Any:
    """The result of a function of pytrees of arrays for some columns and worlds.

    Args:
      function: does the same to all worlds, and to all columns but for sums over them.
      columns: number of columns of a vector.
      *args: pytrees of `Entries`, and scalars.

    Returns:
      Its result, a pytree of `Entries`.

    Raises:
      NotImplementedError: an operation is not known here.
    """
    leaves, tree = jax.tree.flatten(args, is_leaf=lambda x: isinstance(x, Entries))
    program, result = jax.make_jaxpr(lambda *leaves: function(*jax.tree.unflatten(tree, leaves)), return_shape=True)(
        *map(_traced_as, leaves)
    )
    values = [x.vectors if isinstance(x, Entries) else _objects((), [x]) for x in leaves]
    shapes, out_tree = jax.tree.flatten(result)
    found = _evaluate(program, columns, values)
    return jax.tree.unflatten(
        out_tree, [Entries(x, COLUMNS in shape.shape) for x, shape in zip(found, shapes, strict=True)]
    )


def _traced_as(leaf: Any) -> jax.ShapeDtypeStruct:
    if not isinstance(leaf, Entries):
        return jax.ShapeDtypeStruct((), leaf.dtype)
    own = (COLUMNS,) if leaf.columns else ()
    return jax.ShapeDtypeStruct((*leaf.vectors.shape, *own, WORLDS), leaf.vectors.flat[0].dtype)


def _evaluate(program: ClosedJaxpr, columns: int, args: list[np.ndarray]) -> list[np.ndarray]:
    jaxpr = program.jaxpr
    known: dict[Any, np.ndarray] = dict(zip(jaxpr.constvars, map(_constant, program.consts), strict=True))
    known.update(zip(jaxpr.invars, args, strict=True))
    for equation in _needed(jaxpr):
        values = [_constant(x.val) if isinstance(x, Literal) else known.get(x) for x in equation.invars]
        inner = next((equation.params[key] for key in ("jaxpr", "call_jaxpr") if key in equation.params), None)
        if inner is not None and equation.primitive.name not in ("scan", "while", "cond"):
            results = _evaluate(inner, columns, values)  # type: ignore[arg-type]
        else:
            results = _apply(equation, columns, values)
        known.update(zip(equation.outvars, results, strict=True))
    return [_constant(x.val) if isinstance(x, Literal) else known[x] for x in jaxpr.outvars]


def _needed(jaxpr: Any) -> list[Any]:
    """The equations on which the results depend."""
    wanted = {x for x in jaxpr.outvars if not isinstance(x, Literal)}
    found = []
    for equation in reversed(jaxpr.eqns):
        if wanted.isdisjoint(equation.outvars):
            continue
        found.append(equation)
        read = equation.invars[:1] if equation.primitive.name == "store" else equation.invars
        wanted.update(x for x in read if not isinstance(x, Literal))
    return found[::-1]


def _constant(value: Any) -> np.ndarray:
    array = np.asarray(value)
    return _objects(array.shape, [*array.reshape(-1)])


def _objects(shape: tuple[int, ...], vectors: list[Any]) -> np.ndarray:
    found = np.empty(len(vectors), object)
    for place, vector in enumerate(vectors):
        found[place] = vector
    return found.reshape(shape)


def _each(function: Callable[..., Any], *arrays: np.ndarray) -> np.ndarray:
    """The function of the vectors side by side."""
    arrays = tuple(np.broadcast_arrays(*arrays))
    return _objects(
        arrays[0].shape, [function(*vectors) for vectors in zip(*(x.reshape(-1) for x in arrays), strict=True)]
    )


_ELEMENTWISE: dict[str, Callable[..., Any]] = {
    "add": jnp.add,
    "add_any": jnp.add,
    "sub": jnp.subtract,
    "mul": jnp.multiply,
    "div": jnp.divide,
    "max": jnp.maximum,
    "min": jnp.minimum,
    "neg": jnp.negative,
    "abs": jnp.abs,
    "sqrt": jnp.sqrt,
    "square": jnp.square,
    "and": jnp.logical_and,
    "or": jnp.logical_or,
    "not": jnp.logical_not,
    "eq": jnp.equal,
    "ne": jnp.not_equal,
    "lt": jnp.less,
    "le": jnp.less_equal,
    "gt": jnp.greater,
    "ge": jnp.greater_equal,
    "select_n": lambda which, no, yes: jnp.where(which, yes, no),
    "clamp": lambda low, value, high: jnp.minimum(jnp.maximum(value, low), high),
}

_UNCHANGED = ("stop_gradient", "store", "materialize", "store_cotangents", "copy")

_REDUCTIONS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "add_slices": (jnp.add, jnp.sum),
    "reduce_sum": (jnp.add, jnp.sum),
    "reduce_max": (jnp.maximum, jnp.max),
    "reduce_min": (jnp.minimum, jnp.min),
}
"""Of two vectors, and of the columns of one."""


def _apply(equation: Any, columns: int, values: list[np.ndarray | None]) -> list[np.ndarray]:
    """One operation; the arrays have the axes that are neither of columns nor of worlds."""
    name, given = equation.primitive.name, equation.params
    if name in _ELEMENTWISE:
        goal, inputs = equation.outvars[0].aval.shape, [x.aval.shape for x in equation.invars]
        # An axis of size 1 may stand for columns or worlds of others.
        pairs = zip(values, inputs, strict=True)
        return [_each(_ELEMENTWISE[name], *(_broadcast(x, size, goal, tuple(range(len(size)))) for x, size in pairs))]  # type: ignore[arg-type]
    if name in _UNCHANGED:
        return values[: len(equation.outvars)]  # type: ignore[return-value]
    first: Any = values[0]
    have, shape = equation.invars[0].aval.shape, equation.outvars[0].aval.shape
    own = functools.partial(_own_axis, have)
    match name:
        case "convert_element_type":
            return [_each(lambda x: jnp.asarray(x).astype(given["new_dtype"]), first)]
        case "integer_pow":
            return [_each(lambda x: x ** given["y"], first)]
        case "broadcast_in_dim":
            return [_broadcast(first, have, shape, given["broadcast_dimensions"])]
        case "spread":
            return [_broadcast(first, have, shape, tuple(range(len(shape))))]
        case "reshape" | "squeeze":
            _check_kept(have, shape)
            return [first.reshape(_natural(shape))]
        case "transpose":
            kept = [axis for axis in given["permutation"] if _is_natural(have[axis])]
            return [first.transpose([own(axis) for axis in kept])]
        case "concatenate":
            return [np.concatenate(values, axis=own(given["dimension"]))]  # type: ignore[arg-type]
        case "stack":
            return [np.stack(values, axis=_own_axis(shape, given["axis"]))]  # type: ignore[arg-type]
        case "unstack":
            return _slices(first, own(given["axis"]))
        case "split":
            return np.split(first, np.cumsum(given["sizes"])[:-1], axis=own(given["axis"]))
        case "slice":
            steps = given["strides"] or (1,) * len(have)
            bounds = [*zip(given["start_indices"], given["limit_indices"], steps, strict=True)]
            if any(bound != (0, size, 1) for bound, size in zip(bounds, have, strict=True) if not _is_natural(size)):
                raise NotImplementedError(f"written_out: a slice of columns or worlds, {bounds} of {have}")
            return [first[tuple(slice(*x) for x, size in zip(bounds, have, strict=True) if _is_natural(size))]]
        case _ if name in _REDUCTIONS:
            return [_reduced(name, first, have, given, columns).reshape(_natural(shape))]
    raise NotImplementedError(f"written_out: the operation {name!r} is not known here; add it to {__name__}")


def _slices(array: np.ndarray, axis: int) -> list[np.ndarray]:
    return [np.moveaxis(array, axis, 0)[k, ...] for k in range(array.shape[axis])]


def _is_natural(size: int) -> bool:
    return size not in (WORLDS, COLUMNS)


def _natural(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(size for size in shape if _is_natural(size))


def _own_axis(shape: tuple[int, ...], axis: int) -> int:
    """Which of the axes that are kept an axis is."""
    if not _is_natural(shape[axis]):
        raise NotImplementedError(f"written_out: an operation along the columns or worlds of {shape}")
    return len(_natural(shape[:axis]))


def _check_kept(have: tuple[int, ...], shape: tuple[int, ...]) -> None:
    """Reshaping must leave columns and worlds where they are among the other entries."""

    def before(sizes: tuple[int, ...]) -> list[tuple[int, int]]:
        return [(size, math.prod(sizes[:place])) for place, size in enumerate(sizes) if not _is_natural(size)]

    if before(have) != before(shape):
        raise NotImplementedError(f"written_out: columns or worlds are reshaped from {have} to {shape}")


def _broadcast(array: np.ndarray, have: tuple[int, ...], shape: tuple[int, ...], axes: tuple[int, ...]) -> np.ndarray:
    sizes, index = [1] * len(shape), []
    for size, axis in zip(have, axes, strict=True):
        if _is_natural(size):
            index.append(slice(None) if _is_natural(shape[axis]) else 0)  # shared by all columns or worlds
            sizes[axis] = size
    wanted = [size for size, goal in zip(sizes, shape, strict=True) if _is_natural(goal)]
    return np.broadcast_to(array[(*index, ...)].reshape(wanted), _natural(shape))


def _reduced(name: str, array: np.ndarray, have: tuple[int, ...], given: dict[str, Any], columns: int) -> np.ndarray:
    of_two, of_columns = _REDUCTIONS[name]
    axes = given["axes"] if "axes" in given else (given["axis"],)
    for axis in sorted((axis for axis in axes if _is_natural(have[axis])), reverse=True):
        array = functools.reduce(functools.partial(_each, of_two), _slices(array, _own_axis(have, axis)))
    if any(have[axis] == COLUMNS for axis in axes):

        def of_vector(vector: Array) -> Array:
            lanes = vector.shape[-1:] or (1,)
            return of_columns(jnp.broadcast_to(vector, (columns, *lanes)), axis=0, keepdims=True)

        array = _each(of_vector, array)
    return array
