"""Pairs of an owner with a run of consecutive members of a sorted list: what sorting methods produce."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.broadphase.pair_list import Enumerate, Visit
from mathota_jax.spatial.indexing import gather
from mathota_jax.spatial.running_sum import running_sum

SMALLEST_CHUNK = 256


def lower_bound(ascending: Array, value: Array) -> Array:
    """Number of entries of each world's ascending column (row, world) that are less than `value` (place, world)."""
    return _bound(ascending, value, lambda entry, value: entry < value)


def upper_bound(ascending: Array, value: Array) -> Array:
    """Number of entries of each world's ascending column (row, world) that are at most `value` (place, world)."""
    return _bound(ascending, value, lambda entry, value: entry <= value)


def _bound(ascending: Array, value: Array, precedes) -> Array:
    count = ascending.shape[0]
    low = jnp.zeros(value.shape, jnp.int32)

    def halve(step: Array, low: Array) -> Array:
        width = jnp.int32(1) << (count.bit_length() - 1 - step)
        probe = low + width
        inside = probe <= count
        entry = gather(ascending, jnp.where(inside, probe, 1) - 1)
        return jnp.where(inside & precedes(entry, value), probe, low)

    return lax.fori_loop(0, count.bit_length(), halve, low)


def range_pairs(order: Array, owner: Array, start: Array, count: Array) -> Enumerate:
    """Enumerates the pairs of each owner with the entries ``start ... start + count - 1`` of a list.

    Args:
      order: (entry, world) shapes in the order of the list.
      owner: (range, world) shape that owns the range.
      start, count: (range, world) the range; a count of 0 or less is none.
    """
    count = jnp.maximum(count, 0)
    ends = running_sum(count)
    begins = ends - count
    total = ends[-1]
    range_count, worlds = count.shape
    chunk = max(SMALLEST_CHUNK, 2 * range_count)
    lanes = jnp.arange(worlds)
    numbers = jnp.broadcast_to(jnp.arange(range_count, dtype=jnp.int32)[:, None], count.shape)

    def enumerate_pairs(visit: Visit, carry: tuple) -> tuple:
        def body(state: tuple) -> tuple:
            first_slot, carry = state
            slot = first_slot + jnp.arange(chunk, dtype=jnp.int32)[:, None]
            # Each range marks the place in the chunk where it begins; a running maximum spreads the marks.
            shows = (count > 0) & (ends > first_slot) & (begins < first_slot + chunk)
            place = jnp.where(shows, jnp.maximum(begins - first_slot, 0), chunk)
            marks = jnp.zeros((chunk, worlds), jnp.int32).at[place, lanes].max(numbers, mode="drop")
            chosen = lax.cummax(marks, axis=0)
            entry = gather(start, chosen) + slot - gather(begins, chosen)
            kept = slot < total
            entry = jnp.where(kept, entry, 0)
            return first_slot + chunk, visit(carry, gather(owner, chosen), gather(order, entry), kept)

        return lax.while_loop(lambda state: (state[0] < total).any(), body, (jnp.int32(0), carry))[1]

    return enumerate_pairs


def sort_shapes(key: Array) -> tuple[Array, Array]:
    """Keys (shape, world) in ascending order and the shapes in that order, equal keys by shape."""
    shapes = jnp.broadcast_to(jnp.arange(key.shape[0], dtype=jnp.int32)[:, None], key.shape)
    return tuple(jax.lax.sort((key, shapes), dimension=0, num_keys=1, is_stable=True))  # type: ignore[return-value]
