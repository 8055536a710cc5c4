"""Rows on single bodies in any order, whatever tables they come from: what the responses of mechanisms are made of.

Rows of the scene's own pairs and joints act on bodies that are known when a program is traced; those of pairs that the
broadphase found do not, and come last.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.solver.rows import Rows
from mathota_jax.spatial.indexing import in_every_world, take, unstack
from mathota_jax.spatial.settle import store
from mathota_jax.spatial.spread import add_scaled, add_slices, spread


class FixedSide(NamedTuple):
    """Jacobian and response (component, row, world) of rows on one of their sides, and velocity blocks."""

    jacobian: Array
    response: Array
    blocks: tuple[int, ...]

    def at_blocks(self, values: Array, block_count: int) -> Array:
        """(component, block, row, world) from (component, row, world)."""
        shape = (len(values), block_count, *values.shape[1:])
        here = np.asarray(self.blocks) == np.arange(block_count)[:, None]
        return jnp.where(here[..., None], spread(values[:, None], shape), 0.0)

    def rates(self, velocity: Array) -> Array:
        """(row, column, world) of the velocities (component, block, column, world).

        Block by block: velocities gathered for each row would be the largest arrays of a step.
        """
        at_blocks, blocks = unstack(velocity, 1), np.asarray(self.blocks)
        found, order = [], []
        for block in sorted({*self.blocks}):
            rows = np.flatnonzero(blocks == block)
            order.append(rows)
            if block == len(at_blocks):
                found.append(jnp.zeros((len(rows), *at_blocks[0].shape[1:]), velocity.dtype))
                continue
            jacobian = take(self.jacobian, rows, axis=1)
            shape = (len(jacobian), len(rows), *at_blocks[block].shape[1:])
            found.append(add_slices(spread(jacobian[:, :, None], shape) * spread(at_blocks[block][:, None], shape), 0))
        return take(jnp.concatenate(found), np.argsort(np.concatenate(order)))

    def push(self, impulses: Array, block_count: int) -> Array:
        """Impulses (component, block, world) on the bodies by those of the rows (row, world)."""
        blocks, found = np.asarray(self.blocks), []
        for block in range(block_count):
            rows = np.flatnonzero(blocks == block)
            if len(rows):
                found.append(add_scaled(take(self.jacobian, rows, axis=1), take(impulses, rows)))
            else:
                found.append(jnp.zeros((len(self.jacobian), impulses.shape[-1]), impulses.dtype))
        return jnp.stack(found, axis=1)


class TracedSide(NamedTuple):
    """The same of constraints whose velocity blocks (constraint, world) are known only in the step; 0 past the last block.

    Rows of a constraint follow one another, as many for each.
    """

    jacobian: Array
    response: Array
    blocks: Array

    def _at(self, block: int) -> Array:
        """(constraint, world) 1 for those at a block, else 0.

        By such masks all worlds are computed side by side, where gathers would take one number at a time.
        """
        return jnp.where(self.blocks == block, 1.0, 0.0).astype(self.jacobian.dtype)

    def at_blocks(self, values: Array, block_count: int) -> Array:
        """As of a `FixedSide`."""
        rows = values.shape[1] // len(self.blocks)
        masks = jnp.stack([jnp.repeat(self._at(block), rows, axis=0) for block in range(block_count)])
        return spread(values[:, None], (len(values), *masks.shape)) * spread(masks[None], (len(values), *masks.shape))

    def rates(self, velocity: Array) -> Array:
        """As of a `FixedSide`."""
        components, _, columns, worlds = velocity.shape
        there = (components, len(self.blocks), columns, worlds)
        velocities = functools.reduce(
            jnp.add,
            [
                spread(part[:, None], there) * spread(self._at(block)[None, :, None], there)
                for block, part in enumerate(unstack(velocity, 1))
            ],
        )
        velocities = store(velocities, velocities)
        jacobian = self.jacobian.reshape(components, len(self.blocks), -1, worlds)
        shape = (*jacobian.shape[:3], columns, worlds)
        products = spread(jacobian[:, :, :, None], shape) * spread(velocities[:, :, None], shape)
        return add_slices(products, 0).reshape(-1, columns, worlds)

    def push(self, impulses: Array, block_count: int) -> Array:
        """As of a `FixedSide`."""
        components, _, worlds = self.jacobian.shape
        jacobian = self.jacobian.reshape(components, len(self.blocks), -1, worlds)
        of_rows = impulses.reshape(1, len(self.blocks), -1, worlds)
        of_constraints = add_slices(jacobian * spread(of_rows, jacobian.shape), 2)
        of_constraints = store(of_constraints, of_constraints)
        return jnp.stack([add_scaled(of_constraints, self._at(block)) for block in range(block_count)], axis=1)


class RowSides(NamedTuple):
    """Both sides of all rows: those at blocks that are fixed, then those at traced ones."""

    fixed: tuple[FixedSide, ...]
    traced: tuple[TracedSide, ...] = ()

    @property
    def fixed_count(self) -> int:
        """Number of rows at fixed blocks."""
        return len(self.fixed[0].blocks)

    @property
    def count(self) -> int:
        """Number of all rows."""
        return self.fixed_count + (self.traced[0].jacobian.shape[1] if self.traced else 0)

    def push(self, impulses: Array, block_count: int) -> Array:
        """Impulses (component, block, world) on the bodies by those of the rows (row, world)."""
        parts = (impulses[: self.fixed_count], impulses[self.fixed_count :])
        pairs = [(side, part) for sides, part in zip((self.fixed, self.traced), parts, strict=True) for side in sides]
        return functools.reduce(jnp.add, [side.push(part, block_count) for side, part in pairs if len(part)])

    def forces(self, block_count: int) -> Array:
        """Impulses (component, block, row, world) on the bodies by a unit impulse of each row."""
        return self._at_blocks("jacobian", block_count)

    def alone(self, block_count: int) -> Array:
        """Velocities (component, block, row, world) of bodies without joints under a unit impulse of each row."""
        return self._at_blocks("response", block_count)

    def rates(self, velocity: Array) -> Array:
        """(row, column, world) of the velocities (component, block, column, world)."""
        return self._join(0, [_sum(sides, velocity) for sides in self._filled()])

    def matrix(self, velocity: Array) -> Array:
        """``J M^-1 J^T`` (row, row, world) from the velocities (component, block, row, world) under unit impulses."""
        if not self.traced:
            return _sum(self.fixed, velocity)
        own = _sum(self.traced, velocity[:, :, self.fixed_count :])
        if not self.fixed_count:
            return own
        # The matrix is symmetric, and masks for all of its columns would cost more than all else.
        of_fixed = _sum(self.fixed, velocity)
        across = jnp.swapaxes(of_fixed[:, self.fixed_count :], 0, 1)
        return jnp.concatenate([of_fixed, jnp.concatenate([across, own], axis=1)])

    def _filled(self) -> list[Sequence[FixedSide | TracedSide]]:
        return [sides for sides in (self.fixed if self.fixed_count else (), self.traced) if sides]

    def _at_blocks(self, name: str, block_count: int) -> Array:
        parts = [
            functools.reduce(jnp.add, [side.at_blocks(getattr(side, name), block_count) for side in sides])
            for sides in self._filled()
        ]
        return self._join(2, parts)

    def _join(self, axis: int, parts: list[Array]) -> Array:
        return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=axis)


def fixed_sides(groups: Sequence[Rows], places: np.ndarray, worlds: int) -> tuple[FixedSide, ...]:
    """Both sides of some rows; of a side that a row does not have 0, past the last block.

    Args:
      groups: of all rows, with static tables.
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
        found.append(FixedSide(jacobian, response, tuple(blocks[places].tolist())))
    return tuple(found)


def traced_sides(group: Rows, worlds: int) -> tuple[TracedSide, ...]:
    """Both sides of rows of a `TracedTable` with one constraint a turn, in the order turn, column, row."""
    assert group.places is not None
    matrix, blocks = group.matrix.dense(), group.places.blocks
    return tuple(
        TracedSide(_in_order(jacobian, worlds), _in_order(response, worlds), in_every_world(of_side[:, 0], worlds))
        for jacobian, response, of_side in zip(matrix.jacobian, matrix.response, blocks, strict=True)
    )


def places_of_slots(joint_rows: Sequence[Rows], slots: tuple[int, ...]) -> np.ndarray:
    """Of the rows of some slots, see `fixed_sides`."""
    order = np.concatenate([group.table.order for group in joint_rows]).tolist()
    return np.array([order.index(slot) for slot in slots], int)


def _sum(sides: Sequence[FixedSide | TracedSide], velocity: Array) -> Array:
    """Rates of rows, from all of their sides that act on anything."""
    block_count = velocity.shape[1]
    acting = [side for side in sides if isinstance(side, TracedSide) or min(side.blocks) < block_count]
    return functools.reduce(jnp.add, [side.rates(velocity) for side in acting])


def _side(group: Rows, side: int, worlds: int) -> FixedSide:
    table, rows = group.table, group.bias.shape[1]
    matrix = group.matrix.dense()
    if side >= len(matrix.jacobian):
        nothing = jnp.zeros((matrix.jacobian[0].shape[2], table.order.size * rows, worlds), matrix.like.dtype)
        return FixedSide(nothing, nothing, (table.block_count,) * (table.order.size * rows))
    blocks = tuple(block for turn in table.blocks[side] for block in turn for _ in range(rows))
    return FixedSide(_in_order(matrix.jacobian[side], worlds), _in_order(matrix.response[side], worlds), blocks)


def _in_order(values: Array, worlds: int) -> Array:
    """(component, row, world) in the order turn, column, row, from (turn, row, component, column, world)."""
    ordered = values.transpose(2, 0, 3, 1, 4).reshape(values.shape[2], -1, values.shape[-1])
    return in_every_world(ordered, worlds)
