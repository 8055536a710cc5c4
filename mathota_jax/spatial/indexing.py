"""Selection of rows: by indices known at trace time, by the cheapest operation that does it, or by traced ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.spatial.settle import store


def take(tree: Any, indices: Sequence[int] | np.ndarray, axis: int = 0) -> Any:
    """Rows `indices` (static) along `axis` of every array of a pytree.

    A constant index gives one row (to be broadcast), a range a slice; both are free, where a gather costs an address
    computation for each element.
    """
    index = np.asarray(indices, np.int32)
    if len(index) and (index == index[0]).all():
        return jax.tree.map(lambda x: jax.lax.slice_in_dim(x, int(index[0]), int(index[0]) + 1, axis=axis), tree)
    if len(index) and (np.diff(index) == 1).all():
        start, stop = int(index[0]), int(index[-1]) + 1
        return jax.tree.map(
            lambda x: x if stop - start == x.shape[axis] else jax.lax.slice_in_dim(x, start, stop, axis=axis), tree
        )
    return jax.tree.map(lambda x: jnp.take(x, index, axis=axis, unique_indices=False, mode="clip"), tree)


def put(values: Array, places: Sequence[int] | np.ndarray, count: int, axis: int = 0) -> Array:
    """`count` rows along `axis`, of which those at `places` (static) are the given ones and the others 0."""
    place = np.full(count, len(places))
    place[np.asarray(places, int)] = np.arange(len(places))
    if len(places) < count:
        values = jnp.concatenate([values, jnp.zeros_like(jax.lax.slice_in_dim(values, 0, 1, axis=axis))], axis=axis)
    return take(values, place, axis=axis)


def gather(values: Array, index: Array) -> Array:
    """Rows of an array (row, ..., world) by traced indices (place, world) that may differ between worlds.

    Indices must be in range. Either world axis may be 1. The result is (place, ..., world).
    """
    if values.ndim > 2:
        index = index.reshape(index.shape[0], *(1,) * (values.ndim - 2), index.shape[1])
        index = jnp.broadcast_to(index, (index.shape[0], *values.shape[1:-1], index.shape[-1]))
        if index.shape[-1] != values.shape[-1]:
            worlds = max(index.shape[-1], values.shape[-1])
            index = jnp.broadcast_to(index, (*index.shape[:-1], worlds))
            values = jnp.broadcast_to(values, (*values.shape[:-1], worlds))
        return jnp.take_along_axis(values, index, axis=0, mode="promise_in_bounds")
    if values.shape[-1] == 1:
        return values[:, 0].at[index].get(mode="promise_in_bounds")
    if index.shape[-1] == 1:
        return values.at[index[:, 0]].get(mode="promise_in_bounds")
    return jnp.take_along_axis(values, index, axis=0, mode="promise_in_bounds")


def gather_together(tree: Any, index: Array) -> Any:
    """Entries of all arrays (..., row or 1, world or 1) of a pytree by traced rows (place, world): (..., place, world).

    In one operation, and stored: a gather computed again in every kernel that reads it costs more than what follows, and
    one for each array costs the compiler a kernel each. What all worlds share is copied row by row, without an address for
    each number.
    """
    leaves, structure = jax.tree.flatten(tree)
    rows, worlds = (max(leaf.shape[axis] for leaf in leaves) for axis in (-2, -1))
    parts = [leaf.reshape(-1, *leaf.shape[-2:]) for leaf in leaves]
    table = jnp.concatenate([jnp.broadcast_to(part, (len(part), rows, worlds)) for part in parts])
    if worlds < index.shape[-1]:
        chosen = jnp.take(table[..., 0], index.reshape(-1), axis=1, mode="clip").reshape(-1, *index.shape)
    else:
        places = jnp.broadcast_to(index, (index.shape[0], worlds))[None]
        chosen = jnp.take_along_axis(table, places, axis=1, mode="promise_in_bounds")
    chosen = jax.lax.split(store(chosen, chosen), [len(part) for part in parts])
    pairs = zip(chosen, leaves, strict=True)
    return jax.tree.unflatten(structure, [c.reshape(*leaf.shape[:-2], *c.shape[1:]) for c, leaf in pairs])


def unstack(array: Array, axis: int) -> list[Array]:
    """The slices of an array along `axis`, without that axis.

    Indexing would do the same, but its transpose is a sum of padded arrays, each computed for every element; that of a
    split is one concatenation.
    """
    parts = jax.lax.split(array, (1,) * array.shape[axis], axis=axis % array.ndim)
    return [jnp.squeeze(part, axis) for part in parts]


def in_every_world(tree: Any, worlds: int) -> Any:
    """Arrays (..., world or 1) of a pytree with as many worlds as given."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], worlds)), tree)
