"""A function of those of many pairs that want it: the others cost next to nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.spatial.by_platform import by_platform
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.settle import compute_once, materialize

LANES = 128
"""Pairs at a time: what is known of them stays in the cache beside the core."""

Function = Callable[[Any, Array], Any]


def of_wanted(function: Function, wanted: Array, values: Any, otherwise: Any) -> Any:
    """The function of the pairs that are wanted, elsewhere what is given. Not differentiated.

    CPUs compute `LANES` wanted pairs at a time. GPUs compute all pairs at once: turns, of which each fills a fraction of
    the device, take longer.

    Args:
        function: Its arguments are like `values` and `wanted`, of some pairs ``(1, lane)``; its result like `otherwise`, of
            those. It closes over no traced array. Of pairs that are not wanted any result will do.
        wanted: bool ``(pair, world)``.
        values: Pytree of arrays ``(..., pair, world)``; either of the last axes may be 1.
        otherwise: Pytree of arrays ``(pair, world)``.
    """

    def on_cpu(wanted: Array, values: Any, otherwise: Any) -> Any:
        return _if_any(wanted, otherwise, lambda: _in_turns(function, wanted, values, otherwise))

    def on_gpu(wanted: Array, values: Any, otherwise: Any) -> Any:
        return _if_any(wanted, otherwise, lambda: _at_once(function, wanted, values, otherwise))

    wanted, values, otherwise = lax.stop_gradient((wanted, values, otherwise))
    return by_platform(on_cpu, on_gpu, otherwise, wanted, values, otherwise)


def _if_any(wanted: Array, otherwise: Any, compute: Callable[[], Any]) -> Any:
    return lax.cond(jnp.any(wanted), compute, lambda: otherwise)


def _at_once(function: Function, wanted: Array, values: Any, otherwise: Any) -> Any:
    return jax.tree.map(lambda new, old: jnp.where(wanted, new, old), function(values, wanted), otherwise)


def _in_turns(function: Function, wanted: Array, values: Any, otherwise: Any) -> Any:
    size = wanted.size
    lanes = min(LANES, size)
    place = jnp.cumsum(wanted.reshape(-1), dtype=jnp.int32)
    count = place[-1]
    order = jnp.full(size, size, jnp.int32)
    order = order.at[jnp.where(wanted.reshape(-1), place - 1, size)].set(jnp.arange(size, dtype=jnp.int32), mode="drop")
    leaves, structure = jax.tree.flatten(values)
    tables = _tables(leaves, wanted.shape)
    known, result = jax.tree.flatten(otherwise)
    groups = _groups(known)

    def some(state: tuple[Array, list[Array]]) -> tuple[Array, list[Array]]:
        turn, found = state
        chosen = lax.dynamic_slice_in_dim(order, turn * lanes, lanes)
        # Lanes that are left over do what the first one does.
        lane = jnp.where(chosen < size, chosen, order[0])
        of_lanes = list(leaves)
        for places, table in tables:
            taken = jnp.take(table, lane if table.shape[-1] == size else lane // wanted.shape[1], axis=-1, mode="clip")
            # Stored: the gather leaves lane by lane, and each kernel that reads it would turn it round for itself.
            for at, leaf in zip(places, unstack(compute_once(taken, taken), 0), strict=True):
                of_lanes[at] = leaf[..., None, :]
        computed = jax.tree.leaves(function(jax.tree.unflatten(structure, of_lanes), jnp.ones((1, lanes), bool)))
        rows = [jnp.stack(materialize(_numbers(computed, places))) for places in groups]
        return turn + 1, [old.at[:, chosen].set(new, mode="drop") for old, new in zip(found, rows, strict=True)]

    state = jnp.zeros((), jnp.int32), [jnp.stack(_numbers(known, places)) for places in groups]
    _, found = lax.while_loop(lambda s: s[0] * lanes < count, some, state)
    for places, rows in zip(groups, found, strict=True):
        for place, row in zip(places, unstack(rows, 0), strict=True):
            known[place] = row.reshape(wanted.shape).astype(known[place].dtype)
    return jax.tree.unflatten(result, known)


def _tables(leaves: list[Array], shape: tuple[int, ...]) -> list[tuple[list[int], Array]]:
    """The leaves that differ between pairs, those of one kind stacked, with their numbers.

    A table is (leaf, ..., pair), or (leaf, ..., lane) where worlds differ.
    """
    alike: dict[Any, list[int]] = {}
    for place, leaf in enumerate(leaves):
        if leaf.shape[-2:] != (1, 1):
            alike.setdefault((leaf.shape, leaf.dtype), []).append(place)
    tables = []
    for places in alike.values():
        stacked = jnp.stack([leaves[place] for place in places])
        if stacked.shape[-1] == 1 and shape[1] > 1:
            tables.append((places, stacked[..., 0]))
        else:
            stacked = jnp.broadcast_to(stacked, (*stacked.shape[:-2], *shape))
            tables.append((places, stacked.reshape(*stacked.shape[:-2], -1)))
    return tables


def _groups(leaves: list[Array]) -> list[list[int]]:
    """Numbers of the leaves that are floats, and of those that are not."""
    floating = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]
    both = [[k for k, is_float in enumerate(floating) if is_float == kind] for kind in (True, False)]
    return [places for places in both if places]


def _numbers(leaves: list[Array], places: list[int]) -> list[Array]:
    """Some of the leaves, flat, of one kind of number."""
    chosen = [leaves[place].reshape(-1) for place in places]
    return [leaf.astype(jnp.int32) if leaf.dtype == bool else leaf for leaf in chosen]
