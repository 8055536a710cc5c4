"""Assembly of rows for the solver from directions and lever arms."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.bodies import Inertia, InverseInertia
from mathota_jax.solver.rows import Places
from mathota_jax.solver.table import EMPTY, Table, TracedTable
from mathota_jax.spatial.indexing import gather_together, take, unstack
from mathota_jax.spatial.spread import spread
from mathota_jax.spatial.vector import Vec3, cross, dot


class Side(NamedTuple):
    """Part of a row's Jacobian (or response) on one body; `angular` is None where nothing couples to rotation."""

    linear: Vec3
    angular: Vec3 | None


def respond(side: Side, inertia: Inertia | InverseInertia) -> Side:
    """``M^-1 J^T`` for the Jacobian of one row; `inertia` holds the body of each column."""
    angular = None if side.angular is None else inertia.solve(side.angular)
    return Side(side.linear * inertia.inverse_mass, angular)


def inner(left: Side, right: Side) -> Array:
    """Product of a Jacobian with a response or a velocity on the same body."""
    total = dot(left.linear, right.linear)
    return total if left.angular is None or right.angular is None else total + dot(left.angular, right.angular)


def select(table: Table | TracedTable, tree: Any) -> Any:
    """Slots of a table, in its order, from arrays with a leading slot axis. Padding repeats slot 0."""
    return take(tree, np.maximum(table.order, 0))


def select_blocks(table: Table | TracedTable, side: int, tree: Any, places: Places | None = None) -> Any:
    """Velocity blocks of one side of a table, in its order, from arrays with a leading block axis."""
    if isinstance(table, TracedTable):
        assert places is not None
        return gather_columns(table, jnp.minimum(places.blocks[side], table.block_count - 1), tree)
    blocks = np.asarray(table.blocks[side], np.int32).reshape(-1)
    chosen = take(tree, np.minimum(blocks, table.block_count - 1))
    return jax.tree.map(lambda values: spread(values, (blocks.size, values.shape[-1])), chosen)


def smaller_side(table: Table | TracedTable, values: Array, places: Places | None) -> Array:
    """(turn * column, world) the smaller value (block, world) of the moving bodies of each column."""
    sides = places.blocks if isinstance(table, TracedTable) and places else table.blocks  # type: ignore[union-attr]
    return functools.reduce(jnp.minimum, [select_blocks(table, side, values, places) for side in range(len(sides))])


def gather_columns(table: TracedTable, index: Array, tree: Any) -> Any:
    """Rows (turn * column, world) of arrays by an index (turn, constraint, world)."""
    chosen = gather_together(tree, index.reshape(-1, index.shape[-1]))
    return jax.tree.map(lambda values: jnp.repeat(values, table.together, axis=0), chosen)


def collect(tables: Sequence[Table | TracedTable], values: Sequence[Array], slot_count: int) -> Array:
    """Slot order (slot, world) from the (turn, column, world) values of all tables."""
    slots = np.concatenate([table.order for table in tables])
    flat = jnp.concatenate([value.reshape(-1, value.shape[-1]) for value in values]) if len(values) > 1 else values[0]
    positions = np.zeros(slot_count, np.int32)
    positions[slots[slots != EMPTY]] = np.flatnonzero(slots != EMPTY)
    return take(flat.reshape(-1, flat.shape[-1]), positions)


def pack_sides(table: Table | TracedTable, rows: Sequence[Side], worlds: int) -> Array:
    """(turn, row, component, column, world) from one `Side` for each row, components (turn * column, world)."""
    components = [tuple(row.linear) if row.angular is None else (*row.linear, *row.angular) for row in rows]
    return jnp.stack([pack_scalars(table, row, worlds) for row in components], axis=1)


def pack_directions(table: Table | TracedTable, directions: Sequence[Vec3], worlds: int) -> Array:
    """(turn, row, 3, column, world) from one direction for each row, components (turn * column, world)."""
    return jnp.stack([pack_scalars(table, part, worlds) for part in zip(*directions, strict=True)], axis=2)


def turn_of_points(table: Table | TracedTable, directions: Array, arm: Vec3, worlds: int) -> Array:
    """``arm x direction`` of the packed directions, same shape, at the ends of arms (turn * column, world)."""
    linear = Vec3(*unstack(directions, 2))
    arms = Vec3(*(spread(pack_scalars(table, [part], worlds), linear.x.shape) for part in arm))
    return jnp.stack(cross(arms, linear), axis=2)


def pack_scalars(table: Table | TracedTable, values: Sequence[Array], worlds: int) -> Array:
    """(turn, row, column, world) from one (turn * column, world) array for each row; padding becomes 0."""
    turns, columns = table.turn_count, table.column_count
    full = [jnp.broadcast_to(value, (turns * columns, worlds)) for value in values]
    if EMPTY in table.order:
        full = [jnp.where(table.order[:, None] == EMPTY, 0.0, value) for value in full]
    return jnp.stack([value.reshape(turns, columns, worlds) for value in full], axis=1)
