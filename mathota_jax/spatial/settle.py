"""One computation for one decision.

XLA copies cheap shared expressions into every kernel that uses them and contracts multiply-add pairs differently in
each copy. A comparison that depends on such an expression can then come out *both ways* inside one step: one output
sees branch A, the next one branch B. The cure: reduce a discrete choice to one number, keep XLA from computing that
number more than once, and select every output from the result.

How XLA is kept from it depends on the device. On CPUs optimisation barriers are gone before expressions are fused, but a
division is never copied, nor is a conditional. On GPUs divisions are copied like anything else, but barriers hold.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def settle(decision: Array) -> Array:
    """Returns the number `decision` unchanged, computed exactly once. Elementwise, floating point, any shape.

    The derivative is zero: a decision is discrete.
    """
    decision = lax.stop_gradient(decision)
    return store(decision, decision)


def settle_code(decision: Array) -> Array:
    """`settle` for a choice that is a small non-negative or negative integer stored as a float; returns int32."""
    return settle(decision).astype(jnp.int32)


def compute_once(values: Any, like: Array) -> Any:
    """Keeps XLA from recomputing each array of the pytree `values` in every kernel that uses it.

    XLA copies cheap expressions into all their consumers, so that a rotation matrix is rebuilt in a hundred kernels and a
    chain of n dependent rows costs 2^n. Values and derivatives are unchanged.

    Args:
        values: Pytree of arrays.
        like: Array whose last axis is that of the worlds. A value that all worlds share is left alone: storing it would
            cost a kernel, while computing it again costs nothing beside what is done for each world.
    """
    worlds = like.shape[-1]

    def once(value: Array | float) -> Array | float:
        if not isinstance(value, Array) or (worlds > 1 and value.shape[-1:] in ((), (1,))):
            return value
        number = value.astype(jnp.int32) if value.dtype == bool else value
        return store(number, number).astype(value.dtype)

    return jax.tree.map(once, values)


def store(value: Array, source: Array) -> Array:
    """Returns `value` unchanged, computed exactly once, and so are its tangents and cotangents.

    Args:
        value: Array of numbers.
        source: Array of the same shape from which CPUs make a divisor. It may be `value` itself, unless `value` has to
            stay linear in something. (XLA turns a division by a broadcast scalar into a product, which it copies; so the
            divisor needs the full shape.)
    """
    if value.dtype == bool:
        raise TypeError("store: the array must be of numbers, got bool")
    value, source = jnp.broadcast_arrays(value, lax.stop_gradient(source))
    return _store_p.bind(value, source.astype(value.dtype))


def _store_by_division(value: Array, source: Array) -> Array:
    """The divisor is 1 whatever the bits of the source: XLA does not see that, LLVM does, and leaves the division out.

    A divisor that LLVM keeps was measured to cost 5 to 10 % of a step.
    """
    bits = lax.bitcast_convert_type(source, f"int{8 * source.dtype.itemsize}")
    return lax.div(value, ((bits | 1) & 1).astype(value.dtype))


def _jvp_store(primals: Sequence[Array], tangents: Sequence[Any]) -> tuple[Array, Any]:
    (value, source), tangent = primals, tangents[0]
    stored = tangent if type(tangent) is ad.Zero else _store_p.bind(tangent, source)
    return _store_p.bind(value, source), stored


def _transpose_store(cotangent: Any, value: Any, source: Array) -> list[Any]:
    return [ad.Zero(value.aval) if type(cotangent) is ad.Zero else _store_p.bind(cotangent, source), None]


_store_p = Primitive("store")
_store_p.def_impl(lambda value, _: value)
_store_p.def_abstract_eval(lambda value, _: ShapedArray(value.shape, value.dtype))
ad.primitive_jvps[_store_p] = _jvp_store
ad.primitive_transposes[_store_p] = _transpose_store
batching.defbroadcasting(_store_p)
mlir.register_lowering(
    _store_p, mlir.lower_fun(lambda value, _: lax.optimization_barrier(value), multiple_results=False)
)
mlir.register_lowering(_store_p, mlir.lower_fun(_store_by_division, multiple_results=False), platform="cpu")


def store_cotangents(values: Any, *, for_one_reader: bool = False) -> Any:
    """Returns the pytree unchanged, at no cost; in reverse mode each cotangent is computed exactly once.

    The cotangent of a vector that a matrix multiplies goes into those of the nine entries of the matrix, and its expression
    with it, into nine kernels.

    Args:
        values: Pytree of floating-point arrays.
        for_one_reader: Whether also from a kernel that alone reads it, such as that of the rows that a selection pads (see
            `materialize`).
    """
    leaves, tree = jax.tree.flatten(values)
    return jax.tree.unflatten(tree, _store_cotangents_p.bind(*leaves, for_one_reader=for_one_reader))


def _of_the_others(function: Callable[..., Sequence[Any]], values: Sequence[Any]) -> list[Any]:
    """The function of those tangents or cotangents that are not zero in any case."""
    found = list(values)
    places = [place for place, value in enumerate(values) if type(value) is not ad.Zero]
    if places:
        for place, new in zip(places, function(*(values[place] for place in places)), strict=True):
            found[place] = new
    return found


def _zeros_of(cotangents: Sequence[Any], arrays: Sequence[Any]) -> list[Any]:
    """The cotangents, of which those that are zero in any case have the shapes of the arrays."""
    return [ad.Zero(x.aval) if type(c) is ad.Zero else c for c, x in zip(cotangents, arrays, strict=True)]


def _jvp_store_cotangents(
    primals: Sequence[Array], tangents: Sequence[Any], *, for_one_reader: bool
) -> tuple[list[Array], list[Any]]:
    bind = functools.partial(_store_cotangents_p.bind, for_one_reader=for_one_reader)
    return list(primals), _of_the_others(bind, tangents)


def _transpose_store_cotangents(cotangents: Sequence[Any], *arrays: Any, for_one_reader: bool) -> list[Any]:
    def stored(*cotangents: Array) -> list[Array]:
        if not for_one_reader:
            return [store(c, c) for c in cotangents]
        found: dict[int, Array] = {}
        # Those of one shape together: a conditional has its price.
        for shape in sorted({c.shape for c in cotangents}):
            group = {place: c for place, c in enumerate(cotangents) if c.shape == shape}
            found.update(materialize(group))
        return [found[place] for place in range(len(cotangents))]

    return _of_the_others(stored, _zeros_of(cotangents, arrays))


_store_cotangents_p = Primitive("store_cotangents")
_store_cotangents_p.multiple_results = True
_store_cotangents_p.def_impl(lambda *arrays, **_: list(arrays))
_store_cotangents_p.def_abstract_eval(lambda *arrays, **_: [ShapedArray(x.shape, x.dtype) for x in arrays])
ad.primitive_jvps[_store_cotangents_p] = _jvp_store_cotangents
ad.primitive_transposes[_store_cotangents_p] = _transpose_store_cotangents
batching.primitive_batchers[_store_cotangents_p] = lambda args, axes, **params: (
    _store_cotangents_p.bind(*args, **params),
    list(axes),
)
mlir.register_lowering(_store_cotangents_p, mlir.lower_fun(lambda *arrays, **_: list(arrays), multiple_results=True))


def materialize(values: Any) -> Any:
    """Stores every array of a pytree, and its tangents and cotangents, before anything else reads it.

    `compute_once` can not help where a single consumer is the problem: a concatenation of long expressions is compiled
    to one kernel that branches for every element.

    Args:
        values: Pytree of finite arrays, all of the same shape but for the number of worlds.
    """
    leaves, tree = jax.tree.flatten(values)
    return jax.tree.unflatten(tree, _materialize_p.bind(*jnp.broadcast_arrays(*leaves)))


def _materialize_by_condition(*leaves: Array) -> tuple[Array, ...]:
    """A conditional is never fused.

    Its predicate is true, since no square is 2 or 3 modulo 4; its other branch returns every array in the place of
    another, or the negative of a single one, or JAX would forward them unstored.
    """
    bits = lax.bitcast_convert_type(leaves[0].reshape(-1)[0].astype(jnp.float32), jnp.int32)
    always = ((bits * bits) & 3) < 2
    other = (lambda first, *rest: (*rest, first)) if len(leaves) > 1 else (lambda first: (-first,))
    return lax.cond(always, lambda *x: x, other, *leaves)


def _jvp_materialize(primals: Sequence[Array], tangents: Sequence[Any]) -> tuple[list[Array], list[Any]]:
    return _materialize_p.bind(*primals), _of_the_others(_materialize_p.bind, tangents)


def _transpose_materialize(cotangents: Sequence[Any], *arrays: Any) -> list[Any]:
    return _of_the_others(_materialize_p.bind, _zeros_of(cotangents, arrays))


def _batch_materialize(arrays: Sequence[Array], axes: Sequence[int | None]) -> tuple[list[Array], list[int]]:
    size = next(array.shape[axis] for array, axis in zip(arrays, axes, strict=True) if axis is not None)
    moved = [batching.bdim_at_front(array, axis, size) for array, axis in zip(arrays, axes, strict=True)]
    return _materialize_p.bind(*moved), [0] * len(moved)


_materialize_p = Primitive("materialize")
_materialize_p.multiple_results = True
_materialize_p.def_impl(lambda *arrays: list(arrays))
_materialize_p.def_abstract_eval(lambda *arrays: [ShapedArray(x.shape, x.dtype) for x in arrays])
ad.primitive_jvps[_materialize_p] = _jvp_materialize
ad.primitive_transposes[_materialize_p] = _transpose_materialize
batching.primitive_batchers[_materialize_p] = _batch_materialize
mlir.register_lowering(
    _materialize_p, mlir.lower_fun(lambda *arrays: lax.optimization_barrier(arrays), multiple_results=True)
)
mlir.register_lowering(_materialize_p, mlir.lower_fun(_materialize_by_condition, multiple_results=True), platform="cpu")
