"""Rows on single bodies in any order, whatever tables they come from: what the responses of mechanisms are made of."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.solver.rows import Rows
from mathota_jax.spatial.indexing import take, unstack
from mathota_jax.spatial.spread import add_slices, spread


class Sides(NamedTuple):
    """Jacobian and response (component, row, world) of rows on one of their sides, and velocity blocks."""

    jacobian: Array
    response: Array
    blocks: tuple[int, ...]


def sides(groups: Sequence[Rows], places: np.ndarray, worlds: int) -> tuple[Sides, ...]:
    """Both sides of some rows; of a side that a row does not have 0, past the last block.

    Args:
      groups: of all rows.
      places: of the rows among those of all groups, each in the order turn, column, row.
      worlds: their number.
    """
    found = []
    for side in range(2):
        parts = [_side(group, side, worlds) for group in groups]
        blocks = np.array([block for part in parts for block in part.blocks])
        jacobian, response = (
            take(jnp.concatenate(values, axis=1), places, axis=1)
            for values in ([part.jacobian for part in parts], [part.response for part in parts])
        )
        found.append(Sides(jacobian, response, tuple(blocks[places].tolist())))
    return tuple(found)


def places_of_slots(joint_rows: Sequence[Rows], slots: tuple[int, ...]) -> np.ndarray:
    """Of the rows of some slots, see `sides`."""
    order = np.concatenate([group.table.order for group in joint_rows]).tolist()
    return np.array([order.index(slot) for slot in slots], int)


def _side(group: Rows, side: int, worlds: int) -> Sides:
    table, rows = group.table, group.bias.shape[1]
    matrix = group.matrix.dense()
    if side >= len(matrix.jacobian):
        nothing = jnp.zeros((matrix.jacobian[0].shape[2], table.order.size * rows, worlds), matrix.like.dtype)
        return Sides(nothing, nothing, (table.block_count,) * (table.order.size * rows))

    def flat(values: Array) -> Array:
        ordered = values.transpose(2, 0, 3, 1, 4).reshape(values.shape[2], -1, values.shape[-1])
        return jnp.broadcast_to(ordered, (*ordered.shape[:2], worlds))

    blocks = tuple(block for turn in table.blocks[side] for block in turn for _ in range(rows))
    return Sides(flat(matrix.jacobian[side]), flat(matrix.response[side]), blocks)


def of_blocks(values: Sequence[Array], sides: Sequence[Sides], block_count: int) -> Array:
    """(component, block, row, world) from (component, row, world) of each side."""
    numbers = np.arange(block_count)[:, None]
    shape = (len(values[0]), block_count, *values[0].shape[1:])
    parts = [
        jnp.where((np.asarray(side.blocks) == numbers)[..., None], spread(part[:, None], shape), 0.0)
        for part, side in zip(values, sides, strict=True)
    ]
    return functools.reduce(jnp.add, parts)


def rates(sides: Sequence[Sides], velocity: Array) -> Array:
    """(row, column, world) of the velocities (component, block, column, world)."""
    at_blocks = unstack(velocity, 1)
    return functools.reduce(
        jnp.add, [_rates_of(side, at_blocks) for side in sides if min(side.blocks) < len(at_blocks)]
    )


def _rates_of(side: Sides, velocities: Sequence[Array]) -> Array:
    """The same from one side, block by block: velocities gathered for each row would be the largest arrays of a step."""
    blocks = np.asarray(side.blocks)
    found, order = [], []
    for block in sorted({*side.blocks}):
        rows = np.flatnonzero(blocks == block)
        order.append(rows)
        if block == len(velocities):
            found.append(jnp.zeros((len(rows), *velocities[0].shape[1:]), velocities[0].dtype))
            continue
        jacobian = take(side.jacobian, rows, axis=1)
        shape = (len(jacobian), len(rows), *velocities[block].shape[1:])
        found.append(add_slices(spread(jacobian[:, :, None], shape) * spread(velocities[block][:, None], shape), 0))
    return take(jnp.concatenate(found), np.argsort(np.concatenate(order)))
