"""One computation for one decision.

XLA copies cheap shared expressions into every kernel that uses them and contracts multiply-add pairs differently in
each copy. A comparison that depends on such an expression can then come out *both ways* inside one step: one output
sees branch A, the next one branch B. The cure: reduce a discrete choice to one number, pass that number through an
operation that XLA never copies (a division) and cannot fold away, and select every output from the result.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


def settle(decision: Array) -> Array:
    """Returns the finite number `decision` unchanged, computed exactly once. Elementwise, floating point, any shape.

    The divisor is 1 for every finite input, but XLA does not know that. The derivative is zero: a decision is discrete.
    """
    decision = lax.stop_gradient(decision)
    opaque_one = decision * 0 + 1  # not foldable: a float times 0 need not be 0
    return decision / opaque_one


def settle_code(decision: Array) -> Array:
    """`settle` for a choice that is a small non-negative or negative integer stored as a float; returns int32."""
    return settle(decision).astype(jnp.int32)


def compute_once(values: Any, like: Array) -> Any:
    """Keeps XLA from recomputing each array of the pytree `values` in every kernel that uses it.

    XLA copies cheap expressions into all their consumers, so that a rotation matrix is rebuilt in a hundred kernels and a
    chain of n dependent rows costs 2^n. It never copies a division. Values and derivatives are unchanged.

    Args:
        values: Pytree of finite floating-point arrays.
        like: Array whose last axis is that of the worlds. A value that all worlds share is left alone: storing it would
            cost a kernel, while computing it again costs nothing beside what is done for each world.
    """
    worlds = like.shape[-1]

    def once(value: Array) -> Array:
        shared = worlds > 1 and jnp.shape(value)[-1:] in ((), (1,))
        return value if shared else store(value, value)

    return jax.tree.map(once, values)


def store(value: Array, source: Array) -> Array:
    """Returns `value` unchanged, computed exactly once.

    Args:
        value: Floating-point array.
        source: Finite array of the same shape from which the divisor is made. It may be `value` itself, unless `value`
            has to stay linear in something. (XLA turns a division by a broadcast scalar into a product, which it copies;
            so the divisor needs the full shape.)
    """
    return value / (lax.stop_gradient(source) * 0 + 1)


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


def _jvp_store_cotangents(
    primals: Sequence[Array], tangents: Sequence[Any], *, for_one_reader: bool
) -> tuple[list[Array], list[Any]]:
    found = list(tangents)
    places = [place for place, tangent in enumerate(tangents) if type(tangent) is not ad.Zero]
    stored = _store_cotangents_p.bind(*(tangents[place] for place in places), for_one_reader=for_one_reader)
    for place, tangent in zip(places, stored, strict=True):
        found[place] = tangent
    return list(primals), found


def _transpose_store_cotangents(cotangents: Sequence[Any], *arrays: Any, for_one_reader: bool) -> list[Any]:
    found: list[Any] = [
        ad.Zero(array.aval) if type(c) is ad.Zero else c for c, array in zip(cotangents, arrays, strict=True)
    ]
    places = [place for place, cotangent in enumerate(found) if type(cotangent) is not ad.Zero]
    if not for_one_reader:
        for place in places:
            found[place] = store(found[place], found[place])
        return found
    # Those of one shape together: a conditional has its price.
    for shape in sorted({found[place].shape for place in places}):
        group = [place for place in places if found[place].shape == shape]
        for place, stored in zip(group, materialize([found[place] for place in group]), strict=True):
            found[place] = stored
    return found


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
    """Stores every array of a pytree, and in reverse mode its cotangent, before anything else reads it.

    `compute_once` can not help where a single consumer is the problem: a concatenation of long expressions is compiled
    to one kernel that branches for every element. A conditional is never fused. Its predicate is true, since no square is
    2 or 3 modulo 4; its other branch returns every array in the place of another, or the negative of a single one, or JAX
    would forward them unstored.

    Args:
        values: Pytree of finite arrays, all of the same shape but for the number of worlds.
    """
    leaves, tree = jax.tree.flatten(values)
    leaves = jnp.broadcast_arrays(*leaves)
    bits = lax.bitcast_convert_type(leaves[0].reshape(-1)[0].astype(jnp.float32), jnp.int32)
    always = ((bits * bits) & 3) < 2
    other = (lambda first, *rest: (*rest, first)) if len(leaves) > 1 else (lambda first: (-first,))
    stored = lax.cond(always, lambda *x: x, other, *leaves)
    return jax.tree.unflatten(tree, stored)
