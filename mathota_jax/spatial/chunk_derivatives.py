"""Derivatives, forwards and backwards, of a function of the chunks in use of a table whose size is known only in the step.

A loop of so many turns as the step says has no reverse mode in JAX. A loop over all chunks that passes over the empty ones
has, but stores what every chunk would need, which for scenes with room for many pairs was measured to take longer than all
else. So the tangents are a primitive of their own, linear in those given: a loop over the chunks in use, whose transpose is
another, in which each chunk is computed again. What is stored is what the function gets.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import ShapedArray
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from mathota_jax.spatial import counter
from mathota_jax.spatial.by_platform import by_platform
from mathota_jax.spatial.real_results import OfLeaves, is_real, restricted

Shapes = tuple[jax.ShapeDtypeStruct, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Chunked:
    """A function of chunks by leaves.

    Attributes:
      function: from the leaves of one chunk and those that all chunks share, constants first, to those of the result.
      constant_count: how many of the leaves are shared; the others have a leading axis of chunks.
      count: number of chunks.
      of_one: shapes and types of what it gives for a chunk.
      summed: whether the results are added up instead of stacked.
    """

    function: Callable[..., list[Array]]
    constant_count: int
    count: int
    of_one: Shapes
    summed: bool = False

    @property
    def shapes(self) -> Shapes:
        """What all chunks together give."""
        count = () if self.summed else (self.count,)
        return tuple(jax.ShapeDtypeStruct((*count, *x.shape), x.dtype) for x in self.of_one)

    def at(self, leaves: Sequence[Array], k: Array) -> list[Array]:
        """What the function gets of the chunk at a `counter`."""
        return [*leaves[: self.constant_count], *counter.row(list(leaves[self.constant_count :]), k)]

    def joined(self, results: Sequence[Array], found: Sequence[Array], k: Array) -> list[Array]:
        """The results with what is found of a chunk."""
        if self.summed:
            return [total + x for total, x in zip(results, found, strict=True)]
        return [counter.put(all_, x, k) for all_, x in zip(results, found, strict=True)]

    def in_loop(self, leaves: Sequence[Array], used: Array) -> list[Array]:
        """The results of the chunks in use, and 0 elsewhere. Not differentiable."""

        def body(_: Array, carry: tuple[Array, list[Array]]) -> tuple[Array, list[Array]]:
            k, results = carry
            return counter.following(k), self.joined(results, self.function(*self.at(leaves, k)), k)

        return lax.fori_loop(0, used, body, (counter.start(), _zeros(self.shapes)))[1]

    def at_once(self, leaves: Sequence[Array], used: Array) -> list[Array]:
        """The same side by side."""

        def of_chunk(k: Array, chunk: Sequence[Array]) -> list[Array]:
            found = self.function(*leaves[: self.constant_count], *chunk)
            return [jnp.where(k < used, x, jnp.zeros_like(x)) for x in found]

        found = jax.vmap(of_chunk)(jnp.arange(self.count), list(leaves[self.constant_count :]))
        return [x.sum(0) for x in found] if self.summed else found

    def one_by_one(self, leaves: Sequence[Array], used: Array) -> list[Array]:
        """The same in a loop over all chunks, which JAX can do anything with."""

        def body(k: Array, chunk: Sequence[Array]) -> tuple[Array, list[Array]]:
            def evaluate(chunk: Sequence[Array]) -> list[Array]:
                return self.function(*leaves[: self.constant_count], *chunk)

            return k + 1, lax.cond(k < used, evaluate, lambda _: _zeros(self.of_one), chunk)

        found = lax.scan(body, jnp.zeros((), used.dtype), list(leaves[self.constant_count :]))[1]
        return [x.sum(0) for x in found] if self.summed else found


def tangents(chunked: Chunked, leaves: Sequence[Array], used: Array, changes: Sequence[Any]) -> list[Any]:
    """Those of the results; `changes` are those of the leaves, or a `SymbolicZero` where there is none."""
    mask = tuple(is_real(leaf) and not is_zero(change) for leaf, change in zip(leaves, changes, strict=True))
    found = iter(_tangents_p.bind(used, *leaves, *_selected(changes, mask), chunked=chunked, mask=mask))
    return [next(found) if is_real(x) else np.zeros(x.shape, jax.dtypes.float0) for x in chunked.shapes]


def is_zero(change: Any) -> bool:
    """Whether JAX knows that there is none."""
    return isinstance(change, SymbolicZero)


def _zeros(shapes: Sequence[Any]) -> list[Array]:
    return [jnp.zeros(x.shape, x.dtype) for x in shapes]


def _selected(leaves: Sequence[Any], mask: Sequence[bool]) -> list[Any]:
    return [leaf for leaf, selected in zip(leaves, mask, strict=True) if selected]


def _split(args: Sequence[Any], mask: Sequence[bool]) -> tuple[Any, Sequence[Any], Sequence[Any]]:
    """The number of chunks in use, the leaves, and what is linear."""
    return args[0], args[1 : 1 + len(mask)], args[1 + len(mask) :]


def _pushed_through(
    function: OfLeaves, leaves: Sequence[Array], mask: Sequence[bool], changes: Sequence[Array]
) -> list[Array]:
    """Tangents of the real results by those of the leaves in the mask."""
    return jax.jvp(restricted(function, leaves, mask), _selected(leaves, mask), list(changes))[1]


def _pulled_through(
    function: OfLeaves,
    leaves: Sequence[Array],
    mask: Sequence[bool],
    given: Sequence[bool],
    cotangents: Sequence[Array],
) -> list[Array]:
    """Cotangents of the leaves in the mask by those of the real results that are `given`."""
    results = restricted(function, leaves, mask)
    pull = jax.vjp(lambda *linear: _selected(results(*linear), given), *_selected(leaves, mask))[1]
    return list(pull(list(cotangents)))


def _push(evaluate: str, *args: Array, chunked: Chunked, mask: tuple[bool, ...]) -> list[Array]:
    """The tangents by JAX's derivative of a method of `Chunked`."""
    used, leaves, changes = _split(args, mask)
    return _pushed_through(lambda leaves: getattr(chunked, evaluate)(leaves, used), leaves, mask, changes)


def _pull(
    evaluate: str, *args: Array, chunked: Chunked, mask: tuple[bool, ...], given: tuple[bool, ...]
) -> list[Array]:
    """The cotangents likewise, of the real results that are `given`."""
    used, leaves, cotangents = _split(args, mask)
    return _pulled_through(lambda leaves: getattr(chunked, evaluate)(leaves, used), leaves, mask, given, cotangents)


def _push_in_loop(*args: Array, chunked: Chunked, mask: tuple[bool, ...]) -> list[Array]:
    used, leaves, changes = _split(args, mask)
    of_changes = dataclasses.replace(chunked, constant_count=sum(mask[: chunked.constant_count]))

    def body(_: Array, carry: tuple[Array, list[Array]]) -> tuple[Array, list[Array]]:
        k, results = carry
        own = of_changes.at(changes, k)
        found = _pushed_through(lambda chunk: chunked.function(*chunk), chunked.at(leaves, k), mask, own)
        return counter.following(k), chunked.joined(results, found, k)

    return lax.fori_loop(0, used, body, (counter.start(), _zeros(_pushed(*args, chunked=chunked, mask=mask))))[1]


def _pull_in_loop(*args: Array, chunked: Chunked, mask: tuple[bool, ...], given: tuple[bool, ...]) -> list[Array]:
    used, leaves, cotangents = _split(args, mask)
    constants = sum(mask[: chunked.constant_count])

    def body(_: Array, carry: tuple[Array, list[Array]]) -> tuple[Array, list[Array]]:
        k, totals = carry
        of_results = cotangents if chunked.summed else counter.row(list(cotangents), k)
        found = _pulled_through(lambda chunk: chunked.function(*chunk), chunked.at(leaves, k), mask, given, of_results)
        shared = [total + x for total, x in zip(totals[:constants], found[:constants], strict=True)]
        own = [counter.put(all_, x, k) for all_, x in zip(totals[constants:], found[constants:], strict=True)]
        return counter.following(k), shared + own

    return lax.fori_loop(0, used, body, (counter.start(), _zeros(_selected(leaves, mask))))[1]


def _pushed(*_: Any, chunked: Chunked, mask: tuple[bool, ...]) -> list[Any]:
    """What has the shapes of the tangents."""
    return [x for x in chunked.shapes if is_real(x)]


def _pulled(*args: Any, mask: tuple[bool, ...], **_: Any) -> list[Any]:
    """What has the shapes of the cotangents."""
    return _selected(_split(args, mask)[1], mask)


def _primitive(name: str, in_loop: Callable, by_jax: Callable, like: Callable) -> Primitive:
    """One of both, whose own derivative is that of the loop over all chunks."""
    primitive = Primitive(name)
    primitive.multiple_results = True
    everywhere = functools.partial(by_jax, "one_by_one")

    def evaluate(*args: Array, **params: Any) -> list[Array]:
        # A GPU waits longer for the end of a loop to be known than for the work on what is empty.
        on_cpu, on_gpu = functools.partial(in_loop, **params), functools.partial(by_jax, "at_once", **params)
        return by_platform(on_cpu, on_gpu, like(*args, **params), *args)

    def abstract(*avals: Any, **params: Any) -> list[ShapedArray]:
        return [ShapedArray(x.shape, x.dtype) for x in like(*avals, **params)]

    def jvp(primals: Sequence[Array], changes: Sequence[Any], **params: Any) -> tuple[list[Array], list[Array]]:
        changes = [ad.instantiate_zeros(change) for change in changes]
        found = jax.jvp(functools.partial(everywhere, **params), primals, changes)[1]
        return primitive.bind(*primals, **params), found

    def batched(args: Sequence[Array], axes: Sequence[int | None], **params: Any) -> tuple[list[Array], list[int]]:
        found = jax.vmap(functools.partial(everywhere, **params), axes)(*args)
        return found, [0] * len(found)

    primitive.def_impl(lambda *args, **params: jax.jit(functools.partial(evaluate, **params))(*args))
    primitive.def_abstract_eval(abstract)
    ad.primitive_jvps[primitive] = jvp
    batching.primitive_batchers[primitive] = batched
    mlir.register_lowering(primitive, mlir.lower_fun(evaluate, multiple_results=True))
    return primitive


def _transpose(cotangents: Sequence[Any], *args: Any, chunked: Chunked, mask: tuple[bool, ...]) -> list[Any]:
    used, leaves, changes = _split(args, mask)
    unknown = iter([ad.is_undefined_primal(change) for change in changes])
    wanted = tuple(selected and next(unknown) for selected in mask)
    given = tuple(type(cotangent) is not ad.Zero for cotangent in cotangents)
    parameters = {"chunked": chunked, "mask": wanted, "given": given}
    found = iter(_cotangents_p.bind(used, *leaves, *_selected(cotangents, given), **parameters))
    of_changes = [next(found) if ad.is_undefined_primal(change) else None for change in changes]
    return [None] * (1 + len(mask)) + of_changes


_tangents_p = _primitive("chunk_tangents", _push_in_loop, _push, _pushed)
_cotangents_p = _primitive("chunk_cotangents", _pull_in_loop, _pull, _pulled)
ad.primitive_transposes[_tangents_p] = _transpose
