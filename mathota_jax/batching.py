"""`batch_last`: functions that run with the world axis last, however JAX maps or differentiates them.

XLA on CPUs vectorises over the minor axis of an array and a GPU coalesces along it. `jax.vmap` puts the mapped axis where
the user had it, in front, so that natural ``(..., 3)`` code vectorises over nothing. `batch_last(function)` therefore
takes a function written for arrays with one *trailing* world axis and turns it into one over arrays without it, whose

* batching rule moves the mapped axis to the end and calls the same function again (nested maps add further axes, which
  are merged before the call; unmapped arguments get a trailing axis of size 1, never a copy);
* JVP is a second primitive, linear in the tangents, with the primal *inputs* as its only residuals, and what a `Shortcut`
  keeps of the result (so reverse mode stores one set of inputs per call and recomputes the rest);
* transpose calls the VJP of the function, in the same layout.

On CPUs large batches may be computed some worlds at a time (`spatial.world_parts`), which lowering decides.

Both primitives carry any function, so the rules close over themselves: derivatives of any order, in any order with
`vmap`, `scan`, `checkpoint` and `jit`. `jax.custom_batching.custom_vmap` cannot serve: its `vmap(grad)` fails.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from mathota_jax.spatial.indexing import in_every_world
from mathota_jax.spatial.real_results import is_real, restricted
from mathota_jax.spatial.varying import as_varying, result_types
from mathota_jax.spatial.world_parts import FEWEST, by_parts, part_size, part_size_of_derivative, parts_pay


@dataclasses.dataclass(frozen=True)
class Shortcut:
    """A cheaper way to a known result, for derivatives, which compute a function again.

    Attributes:
      keep: from the result of the function and its arguments, the pytree of those arrays of the result that make the way
        short. They are stored in reverse mode, and count as constants: whatever the result owes them must not change its
        derivatives.
      function: of what was kept and of the arguments of the function; its result and derivatives are those of the
        function, but for round-off.
    """

    keep: Callable[..., Any]
    function: Callable[..., Any]


def batch_last(
    function: Callable[..., Any], shortcut: Shortcut | None = None, in_parts: bool = False
) -> Callable[..., Any]:
    """Makes a natural-shaped function of a worlds-last one.

    Args:
      function: pure function of pytrees. Every array it receives has its natural axes followed by ONE world axis, whose
        size is the number of worlds or 1 (argument shared by all worlds; of an argument with a true `in_each_world` that
        of the worlds); every array it returns likewise.
      shortcut: how derivatives compute it again; None for as it is.
      in_parts: whether large batches are computed in parts that stay in the cache, on CPUs and where it pays. Not for what
        is done in few numbers for each world: of some hundred, kernels take longer to launch than to run.

    Returns:
      Function of the same pytrees without the world axis. Differentiable wherever `function` is; `jax.vmap` of it runs
      `function` natively. Outside `jit` each call is compiled and cached by the structure of its arguments.
    """

    @functools.wraps(function)
    def natural(*args: Any) -> Any:
        leaves, in_tree = jax.tree.flatten(args)
        leaves = as_varying([leaf if isinstance(leaf, Array) else jnp.asarray(leaf) for leaf in leaves])
        if _is_wide(leaf.dtype for leaf in leaves) and not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
            raise ValueError(
                "float64 arrays were given where JAX does not compute with them: call "
                'jax.config.update("jax_enable_x64", True) first, or do this inside of jax.enable_x64(True)'
            )
        native = TreeFunction(function, in_tree, shortcut, in_parts)
        out_leaves = _call_p.bind(*leaves, native=native, world_axes=0)
        return jax.tree.unflatten(_out_tree(native, _natural_signatures(leaves, 0)), out_leaves)

    return natural


@dataclasses.dataclass(frozen=True)
class TreeFunction:
    """A function of pytrees as one of their leaves."""

    function: Callable[..., Any]
    in_tree: Any
    shortcut: Shortcut | None = None
    in_parts: bool = False

    def __call__(self, *leaves: Array) -> Any:
        return self.function(*self._arguments(leaves))

    def _arguments(self, leaves: Sequence[Array]) -> list[Any]:
        """What belongs to each world is given in each, though what is mapped may be something else."""
        worlds = max((leaf.shape[-1] for leaf in leaves), default=1)
        arguments = jax.tree.unflatten(self.in_tree, leaves)
        return [in_every_world(a, worlds) if getattr(a, "in_each_world", False) else a for a in arguments]

    def again(self, shortcut: Shortcut, result: Any, leaves: Sequence[Array]) -> tuple[TreeFunction, list[Array]]:
        """The function by its shortcut, and the arrays that it needs before the arguments."""
        args = jax.tree.unflatten(self.in_tree, leaves)
        kept = shortcut.keep(result, *args)
        function = TreeFunction(shortcut.function, jax.tree.structure((kept, *args)), in_parts=self.in_parts)
        return function, jax.tree.leaves(kept)


@dataclasses.dataclass(frozen=True)
class Pushforward:
    """Tangents of the real outputs of `native`; arguments: all its inputs, then the tangents of those in `mask`."""

    native: Native
    mask: tuple[bool, ...]

    def __call__(self, *args: Array) -> list[Array]:
        primals, tangents = list(args[: len(self.mask)]), list(args[len(self.mask) :])
        linear = [primal for primal, selected in zip(primals, self.mask, strict=True) if selected]
        pairs = [jnp.broadcast_arrays(primal, tangent) for primal, tangent in zip(linear, tangents, strict=True)]
        of_linear = restricted(functools.partial(_run, self.native), primals, self.mask)
        return list(jax.jvp(of_linear, [pair[0] for pair in pairs], [pair[1] for pair in pairs])[1])


@dataclasses.dataclass(frozen=True)
class Pullback:
    """Cotangents, for each world, of the inputs in `mask`; arguments: all inputs, then those of the real outputs."""

    native: Native
    mask: tuple[bool, ...]

    def __call__(self, *args: Array) -> list[Array]:
        primals, cotangents = list(args[: len(self.mask)]), args[len(self.mask) :]
        world_count = max(arg.shape[-1] for arg in args)
        # A shared argument gets a cotangent in each world; whoever shares it does the sum.
        linear = [
            jnp.broadcast_to(primal, (*primal.shape[:-1], world_count))
            for primal, selected in zip(primals, self.mask, strict=True)
            if selected
        ]
        of_linear = restricted(functools.partial(_run, self.native), primals, self.mask)
        outputs, pull = jax.vjp(of_linear, *linear)
        return list(pull([_cotangent_of(output, c) for output, c in zip(outputs, cotangents, strict=True)]))


Native = TreeFunction | Pushforward | Pullback
"""Function of arrays with one trailing world axis each (of common size, or 1) to a pytree of such."""


def _cotangent_of(output: Array, cotangent: Array) -> Array:
    """The cotangent in the shape of its output; one that all worlds share depends on nothing that is differentiated."""
    shared = output.shape[-1] < cotangent.shape[-1]
    return jnp.zeros_like(output) if shared else jnp.broadcast_to(cotangent, output.shape)


Signature = tuple[tuple[int, ...], Any]


def _run(native: Native, args: Sequence[Array]) -> list[Array]:
    """The leaves of the result; shape inference, lowering and derivatives share one trace of the function."""
    return jaxpr_as_fun(_traced(native, tuple((arg.shape, arg.dtype) for arg in args), _trace_context()))(*args)


@functools.lru_cache(maxsize=512)
def _traced(native: Native, signatures: tuple[Signature, ...], context: tuple[Any, ...]) -> ClosedJaxpr:
    """`native` as a program for arguments of the given shapes and types.

    The cache of `jit` does not serve: it forgets between a trace and its lowering, whose contexts differ.
    """
    del context
    shapes = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in signatures]
    # Constants have the precision of the arguments: float32 stays float32 where float64 is allowed.
    with jax.enable_x64(_is_wide(dtype for _, dtype in signatures)):
        # Behind `jit`, so that whoever calls the program binds one equation instead of each.
        program, result = jax.make_jaxpr(jax.jit(lambda *args: native(*args)), return_shape=True)(*shapes)
    _known_out_tree(native, tuple((shape[:-1], dtype) for shape, dtype in signatures))[:] = [jax.tree.structure(result)]
    return program


_WIDE = (np.dtype("float64"), np.dtype("int64"))


def _is_wide(types: Iterable[Any]) -> bool:
    return any(dtype in _WIDE for dtype in types)


def _trace_context() -> tuple[Any, ...]:
    """Settings of JAX on which the program of a function depends, beside the types of its arguments."""
    return (jax.config.jax_default_matmul_precision,)  # pyright: ignore[reportAttributeAccessIssue]


@functools.lru_cache(maxsize=1024)
def _known_out_tree(native: Native, natural: tuple[Signature, ...]) -> list[Any]:
    """Where the structure of the result is kept, once it has been seen for any number of worlds."""
    del native, natural
    return []


def _out_tree(native: Native, natural: tuple[Signature, ...]) -> Any:
    """Structure of the result for arguments of the given shapes without the world axis."""
    known = _known_out_tree(native, natural)
    if not known:
        one_world = tuple(((*shape, 1), dtype) for shape, dtype in natural)
        _traced(native, one_world, _trace_context())
    return known[0]


def _evaluate(*args: Array, native: Native, world_axes: int, on_cpu: bool = False) -> list[Array]:
    """Calls `native` on arrays with any number of trailing world axes, merging them into one."""
    worlds = _worlds(args, world_axes)
    merged = [_merge_worlds(arg, worlds) for arg in args]
    if 0 in worlds:
        return [jnp.zeros((*shape, *worlds), dtype) for shape, dtype in _natural_results(native, merged)]
    run = functools.partial(_run, native)
    parts = on_cpu and _parts_pay(native, merged)
    outputs = by_parts(run, merged, _part_size(native, merged)) if parts else run(merged)
    shapes = (output.shape[:-1] for output in outputs)
    return [
        jnp.broadcast_to(output, (*shape, math.prod(worlds))).reshape(*shape, *worlds)
        for output, shape in zip(outputs, shapes, strict=True)
    ]


def _worlds(args: Sequence[Any], world_axes: int) -> tuple[int, ...]:
    return np.broadcast_shapes(*(arg.shape[arg.ndim - world_axes :] for arg in args)) if world_axes else ()


def _parts_pay(native: Native, args: Sequence[Any]) -> bool:
    """Whether a batch is better cut into parts, for `native` or a derivative of it."""
    size = _part_size(native, args)
    if size == max(arg.shape[-1] for arg in args):
        return False
    primal, args = _primal(native, args)
    program = _traced(primal, _signatures(args, size), _trace_context())
    return parts_pay(program, size, of_derivative=primal is not native)


def _part_size(native: Native, args: Sequence[Any]) -> int:
    """Worlds of the parts into which a batch may be cut."""
    worlds = max(arg.shape[-1] for arg in args)
    primal, of_primal = _primal(native, args)
    if not primal.in_parts:
        return worlds
    size = part_size(worlds, of_primal)
    if primal is native or worlds <= FEWEST:  # which can not be cut: the primal need not be traced for it
        return size
    return part_size_of_derivative(worlds, _traced(primal, _signatures(of_primal, size), _trace_context()), size)


def _primal(native: Native, args: Sequence[Any]) -> tuple[TreeFunction, Sequence[Any]]:
    """The function of which `native` may be a derivative, and its arguments."""
    while not isinstance(native, TreeFunction):
        native, args = native.native, args[: len(native.mask)]
    return native, args


def _merge_worlds(arg: Array, worlds: tuple[int, ...]) -> Array:
    natural = arg.shape[: arg.ndim - len(worlds)]
    if math.prod(arg.shape[arg.ndim - len(worlds) :]) == 1:
        return arg.reshape(*natural, 1)
    return jnp.broadcast_to(arg, (*natural, *worlds)).reshape(*natural, math.prod(worlds))


def _natural_signatures(avals: Sequence[Any], world_axes: int) -> tuple[Signature, ...]:
    return tuple((aval.shape[: aval.ndim - world_axes], aval.dtype) for aval in avals)


def _signatures(args: Sequence[Any], worlds: int) -> tuple[Signature, ...]:
    """Of arguments with one world axis, for so many worlds."""
    return tuple(((*arg.shape[:-1], worlds if arg.shape[-1] > 1 else 1), arg.dtype) for arg in args)


def _abstract_evaluation(*avals: Any, native: Native, world_axes: int) -> list[Any]:
    worlds = _worlds(avals, world_axes)
    shapes = (jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals)
    merged = [jax.eval_shape(lambda arg: _merge_worlds(arg, worlds), shape) for shape in shapes]
    return result_types([((*shape, *worlds), dtype) for shape, dtype in _natural_results(native, merged)], avals)


def _natural_results(native: Native, args: Sequence[Any]) -> list[Signature]:
    """Shapes and types of the results for a world.

    The function is traced for as many worlds as it is likely to be lowered for.
    """
    if isinstance(native, Pullback):
        return [
            (arg.shape[:-1], arg.dtype)
            for arg, selected in zip(args[: len(native.mask)], native.mask, strict=True)
            if selected
        ]
    if isinstance(native, Pushforward):
        found = _natural_results(native.native, args[: len(native.mask)])
        return [(shape, dtype) for shape, dtype in found if jnp.issubdtype(dtype, jnp.inexact)]
    program = _traced(native, _signatures(args, _part_size(native, args)), _trace_context())
    return [(aval.shape[:-1], aval.dtype) for aval in program.out_avals]


@functools.lru_cache(maxsize=512)
def _compiled(native: Native, world_axes: int) -> Callable[..., list[Array]]:
    def call(*args: Array) -> list[Array]:
        # `jax_debug_nans` calls this again without `jit`, to find the operation that fails.
        traced = any(isinstance(arg, Tracer) for arg in args)
        return (_call_p.bind if traced else _evaluate)(*args, native=native, world_axes=world_axes)

    return jax.jit(call)


def _implementation(*args: Array, native: Native, world_axes: int) -> list[Array]:
    return _compiled(native, world_axes)(*args)


def _batching_rule(
    primitive: Primitive, args: Sequence[Array], axes: Sequence[int | None], *, world_axes: int, **params: Any
) -> tuple[list[Array], list[int]]:
    # Constants inside of loops come as numbers of Python.
    moved = [
        jnp.expand_dims(arg, jnp.ndim(arg)) if axis is None else jnp.moveaxis(arg, axis, -1)
        for arg, axis in zip(args, axes, strict=True)
    ]
    outputs = primitive.bind(*moved, world_axes=world_axes + 1, **params)
    return outputs, [output.ndim - 1 for output in outputs]


def _jvp_rule(
    primals: Sequence[Array], tangents: Sequence[Any], *, native: Native, world_axes: int
) -> tuple[list[Array], list[Any]]:
    outputs = _call_p.bind(*primals, native=native, world_axes=world_axes)
    mask = tuple(
        type(tangent) is not ad.Zero and is_real(primal) for primal, tangent in zip(primals, tangents, strict=True)
    )
    selected = [tangent for tangent, wanted in zip(tangents, mask, strict=True) if wanted]
    zeros = [ad.Zero(jax.typeof(output).to_tangent_aval()) for output in outputs]
    if not selected:
        return outputs, zeros
    kept = []
    if isinstance(native, TreeFunction) and native.shortcut is not None:
        out_tree = _out_tree(native, _natural_signatures(primals, world_axes))
        native, kept = native.again(native.shortcut, jax.tree.unflatten(out_tree, outputs), primals)
        kept, mask = jax.lax.stop_gradient(kept), (False,) * len(kept) + mask
    real = iter(_linear_p.bind(*kept, *primals, *selected, native=native, mask=mask, world_axes=world_axes))
    return outputs, [next(real) if is_real(output) else zero for output, zero in zip(outputs, zeros, strict=True)]


def _linear_evaluate(
    *args: Array, native: Native, mask: tuple[bool, ...], world_axes: int, on_cpu: bool = False
) -> list[Array]:
    return _evaluate(*args, native=Pushforward(native, mask), world_axes=world_axes, on_cpu=on_cpu)


def _linear_implementation(*args: Array, native: Native, mask: tuple[bool, ...], world_axes: int) -> list[Array]:
    return _implementation(*args, native=Pushforward(native, mask), world_axes=world_axes)


def _linear_abstract_evaluation(*avals: Any, native: Native, mask: tuple[bool, ...], world_axes: int) -> list[Any]:
    return _abstract_evaluation(*avals, native=Pushforward(native, mask), world_axes=world_axes)


def _linear_jvp_rule(
    args: Sequence[Array], tangents: Sequence[Any], *, native: Native, mask: tuple[bool, ...], world_axes: int
) -> tuple[list[Array], list[Any]]:
    return _jvp_rule(args, tangents, native=Pushforward(native, mask), world_axes=world_axes)


def _linear_transpose_rule(
    cotangents: Sequence[Any], *args: Any, native: Native, mask: tuple[bool, ...], world_axes: int
) -> list[Any]:
    primals, linear = args[: len(mask)], args[len(mask) :]
    instantiated = [ad.instantiate_zeros(cotangent) for cotangent in cotangents]
    pulled = _call_p.bind(*primals, *instantiated, native=Pullback(native, mask), world_axes=world_axes)
    results = [
        _sum_to(cotangent, argument.aval.shape) if ad.is_undefined_primal(argument) else None
        for cotangent, argument in zip(pulled, linear, strict=True)
    ]
    return [None] * len(mask) + results


def _sum_to(value: Array, shape: tuple[int, ...]) -> Array:
    """Sums over the world axes along which the argument was shared."""
    axes = tuple(axis for axis, (have, want) in enumerate(zip(value.shape, shape, strict=True)) if have != want)
    return value.sum(axes, keepdims=True) if axes else value


_call_p = Primitive("batch_last")
_call_p.multiple_results = True
_call_p.def_impl(_implementation)
_call_p.def_abstract_eval(_abstract_evaluation)
batching.primitive_batchers[_call_p] = functools.partial(_batching_rule, _call_p)
ad.primitive_jvps[_call_p] = _jvp_rule
mlir.register_lowering(_call_p, mlir.lower_fun(_evaluate, multiple_results=True))
mlir.register_lowering(
    _call_p, mlir.lower_fun(functools.partial(_evaluate, on_cpu=True), multiple_results=True), platform="cpu"
)

_linear_p = Primitive("batch_last_linear")
_linear_p.multiple_results = True
_linear_p.def_impl(_linear_implementation)
_linear_p.def_abstract_eval(_linear_abstract_evaluation)
batching.primitive_batchers[_linear_p] = functools.partial(_batching_rule, _linear_p)
ad.primitive_jvps[_linear_p] = _linear_jvp_rule
ad.primitive_transposes[_linear_p] = _linear_transpose_rule
mlir.register_lowering(_linear_p, mlir.lower_fun(_linear_evaluate, multiple_results=True))
mlir.register_lowering(
    _linear_p, mlir.lower_fun(functools.partial(_linear_evaluate, on_cpu=True), multiple_results=True), platform="cpu"
)
