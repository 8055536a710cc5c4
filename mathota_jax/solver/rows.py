"""Rows of constraints, and their products with velocities and impulses.

A row has a Jacobian and a response ``M^-1 J^T`` on one or two blocks of generalized velocity (a free body is a block of 6,
or of 3 where nothing couples to rotation; see `row_matrix`), a bias, and a law.

Layout: turn first, so that a turn is a contiguous slice; then row, component, column, world.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.solver import visits
from mathota_jax.solver.laws import Law
from mathota_jax.solver.row_matrix import RowMatrix
from mathota_jax.solver.table import Table, TracedTable
from mathota_jax.spatial import chunk_derivatives, counter
from mathota_jax.spatial.by_platform import by_platform
from mathota_jax.spatial.chunk_derivatives import Chunked
from mathota_jax.spatial.chunks import map_filled
from mathota_jax.spatial.indexing import in_every_world, take, unstack
from mathota_jax.spatial.settle import store
from mathota_jax.spatial.spread import spread
from mathota_jax.struct import pytree, static


class Changes(Protocol):
    """What `add_changes` needs of a matrix."""

    def changes(self, impulse: Array, together: int) -> list[Array]: ...


UNROLLED_TURNS = 12
"""Largest number of turns that a sweep unrolls."""

UNROLLED_SUMS = 2
"""Largest number of turns over which a sum of impulses is unrolled; it becomes one kernel, of concatenations that branch for
every element."""

MOST_TERMS = 12
"""Changes that a block may receive from a table whose turns are summed side by side; with more it is one after the other.
Measured for five stacked boxes, whose blocks receive three: a step 1.25 times as fast so, its gradient 1.4 times."""

MASKED_BLOCKS = 32
"""Largest number of velocity blocks among which traced ones are selected by masks, side by side for all worlds; beyond,
one world after the other by gather and scatter."""


@pytree
class Places:
    """Where the constraints of a `TracedTable` act in this step.

    Attributes:
      blocks: for each side, (turn, constraint, world) velocity block; an empty place has block `block_count`, which does
        not exist. No block occurs twice in a turn.
      turns: () number of turns that hold a constraint in some world; they are the first ones. None for all turns: that
        loop can be differentiated in reverse mode.
    """

    blocks: tuple[Array, ...]
    turns: Array | None


@pytree
class Rows:
    """Rows that a table visits.

    Attributes:
      matrix: Jacobian and response, with leading turn axis.
      bias: (turn, row, column, world) constraint error at zero velocity.
      law: coefficients with leading turn axis.
      table: order of the sweep, a `Table` or a `TracedTable`.
      places: what a traced table leaves open; None for a static one.
    """

    matrix: RowMatrix
    bias: Array
    law: Law
    table: Any = static()
    places: Places | None = None

    @property
    def jacobian(self) -> tuple[Array, ...]:
        """For each side, (turn, row, component, column, world)."""
        return self.matrix.dense().jacobian

    @property
    def response(self) -> tuple[Array, ...]:
        """For each side, ``M^-1 J^T``, shape as the Jacobian."""
        return self.matrix.dense().response


def gather(velocity: Array, blocks: Any, together: int = 1) -> Array:
    """Velocities (component, constraint, world) of the blocks of a turn; padding reads any block (it has no impulse)."""
    last = velocity.shape[1] - 1
    if isinstance(blocks, jax.Array) and blocks.ndim == 2:
        if velocity.shape[1] <= MASKED_BLOCKS:
            parts = [jnp.where(blocks == k, part[:, None], 0.0) for k, part in enumerate(unstack(velocity, 1))]
            return _store_of_blocks(functools.reduce(jnp.add, parts), blocks)
        index = jnp.minimum(blocks, last)[None]
        return jnp.take_along_axis(velocity, index, axis=1, mode="promise_in_bounds")
    if isinstance(blocks, tuple):
        return take(velocity, [min(block, last) for block in blocks[::together]], axis=1)
    return jnp.take(velocity, blocks[::together], axis=1, mode="clip")


def _store_of_blocks(values: Array, blocks: Array) -> Array:
    """`store` for (component, constraint, world), linear in the values."""
    # Different for each component: by a divisor that they share, XLA would multiply, and copy the product.
    numbers = jnp.arange(values.shape[0], dtype=blocks.dtype)[:, None, None]
    return store(values, (blocks + numbers).astype(values.dtype))


def receive(velocity: Array, receivers: object, changes: list[Array]) -> Array:
    """Adds to each block the change by the constraint that acts on it."""
    block_count = velocity.shape[1]
    if isinstance(receivers, tuple):
        if velocity.shape[1] <= MASKED_BLOCKS:
            numbers = jnp.arange(block_count)[:, None]
            for blocks, change in zip(receivers, changes, strict=True):
                for block, part in zip(unstack(blocks, 0), unstack(_store_of_blocks(change, blocks), 1), strict=True):
                    velocity = velocity + jnp.where(block == numbers, part[:, None], 0.0)
            return velocity
        # In a turn of places no block occurs twice, so the order in which a scatter adds does not matter.
        lanes = jnp.arange(velocity.shape[2])
        for blocks, change in zip(receivers, changes, strict=True):
            velocity = velocity.at[:, blocks, lanes].add(change, mode="drop")
        return velocity
    if block_count == 1 and len(changes) == 1 and changes[0].shape[1] == 1:
        return velocity + changes[0]
    padding = jnp.zeros_like(changes[0][:, :1])
    columns = jnp.concatenate([*changes, padding], axis=1)
    if isinstance(receivers, jax.Array):
        return velocity + jnp.take(columns, receivers, axis=1, mode="clip")
    return velocity + take(columns, receivers, axis=1)  # type: ignore[arg-type]


def row_velocity(group: Rows, velocity: Array) -> Array:
    """``J v`` of all rows of a group: (turn, row, column, world)."""
    return matrix_velocity(group.table, group.matrix, group.places, velocity)


def first_row_velocity(group: Rows, velocity: Array) -> Array:
    """``J v`` of the first row of each constraint, (turn, 1, column, world)."""
    return matrix_velocity(group.table, group.matrix.first_row(), group.places, velocity)


def with_first_bias(group: Rows, first: Array) -> Rows:
    """The rows with the bias `first` (turn, 1, column, world) for the first row of each constraint."""
    return dataclasses.replace(group, bias=jnp.concatenate([first, group.bias[:, 1:]], axis=1))


def map_turns(function: Callable[[Rows, Any], Any], group: Rows, tree: Any) -> Any:
    """`function` of the rows of turns and of arrays (turn, ...), whose results have that axis too.

    Of the turns of a traced table that hold a constraint, chunk by chunk, where each turn holds one; it is 0 in the others.
    """
    places = group.places
    if places is None or places.turns is None or group.table.constraint_count > 1:
        return function(group, tree)

    def of_chunk(chunk: tuple[Any, ...]) -> Any:
        matrix, bias, law, blocks, values = chunk
        table = dataclasses.replace(group.table, turn_count=bias.shape[0])
        return function(Rows(matrix, bias, law, table, Places(blocks, None)), values)

    return map_filled(of_chunk, (group.matrix, group.bias, group.law, places.blocks, tree), places.turns)


def matrix_velocity(table: Table | TracedTable, matrix: RowMatrix, places: Places | None, velocity: Array) -> Array:
    """`row_velocity` for the parts of a group."""
    if isinstance(table, TracedTable):
        assert places is not None
        gathered = [jax.vmap(lambda b: gather(velocity, b, table.together))(blocks) for blocks in places.blocks]
    else:
        gathered = [_all_turns(velocity, blocks, table.together) for blocks in table.blocks]
    return matrix.rates(gathered)


def visiting_all_turns(rows: tuple[Rows, ...]) -> tuple[Rows, ...]:
    """The same rows, whose loops also visit the turns without constraints: those have a reverse mode."""
    return tuple(
        group
        if group.places is None
        else dataclasses.replace(group, places=dataclasses.replace(group.places, turns=None))
        for group in rows
    )


def visited(group: Rows, values: Any) -> visits.Group:
    """The constraints of a group with some values of theirs, for `visits.run`."""
    table = group.table
    if group.places is None:
        sides = [np.asarray(side, np.int32)[:, :: table.together, None] for side in table.blocks]
        blocks, turns = tuple(jnp.asarray(side) for side in sides), table.turn_count
    else:
        blocks, turns = group.places.blocks, group.places.turns
        turns = table.turn_count if turns is None else turns
    return visits.Group(values, blocks, jnp.asarray(turns))


def add_impulses(rows: tuple[Rows, ...], velocity: Array, impulses: tuple[Array, ...]) -> Array:
    """Velocity plus ``M^-1 J^T`` times impulses, over all groups."""
    for group, impulse in zip(rows, impulses, strict=True):
        velocity = add_changes(group, group.matrix, velocity, impulse)
    return velocity


def add_changes(group: Rows, matrix: Changes, velocity: Array, impulse: Array) -> Array:
    """Adds to each block what the impulses of the rows of a group change there, according to `matrix`.

    Its components may be others than those of a velocity.
    """
    table, places = group.table, group.places
    if places is None and table.turn_count <= UNROLLED_SUMS:
        for turn, (part, values) in enumerate(_by_turn((matrix, impulse))):
            velocity = receive(velocity, table.receivers[turn], part.changes(values, table.together))
        return velocity
    worlds = max(leaf.shape[-1] for leaf in jax.tree.leaves((velocity, impulse, matrix)))
    velocity = in_every_world(velocity, worlds)
    if places is not None and places.turns is not None:
        return _add_at_filled_places(table.together, places, matrix, velocity, impulse)
    if places is None and len(terms := _terms(table)) <= MOST_TERMS:
        changes = jax.vmap(lambda part, values: part.changes(values, table.together))(matrix, impulse)
        return velocity + _sum_of_terms(terms, jnp.concatenate(changes, axis=2))

    def body(velocity: Array, at_turn: tuple) -> tuple[Array, None]:
        receivers, part, values = at_turn
        return receive(velocity, receivers, part.changes(values, table.together)), None

    receivers = jnp.asarray(table.receivers) if places is None else places.blocks
    return lax.scan(body, velocity, (receivers, matrix, impulse))[0]


def _terms(table: Table) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Turns and columns (block,) in which blocks receive something, each used once, and whether there is one at all."""
    receivers = table.receivers
    columns = len(table.blocks) * table.column_count // table.together
    turns = [np.flatnonzero(of_block < columns) for of_block in receivers.T]
    terms = []
    for k in range(max(len(turn) for turn in turns)):
        turn = np.array([turn[k] if k < len(turn) else 0 for turn in turns])
        column = receivers[turn, np.arange(len(turn))]
        terms.append((turn, np.minimum(column, columns - 1), np.array([k < len(turn) for turn in turns])))
    return terms


def _sum_of_terms(terms: list[tuple[np.ndarray, np.ndarray, np.ndarray]], changes: Array) -> Array:
    """(component, block, world) sums of the changes (turn, component, column, world) that each block receives."""
    parts = []
    for turn, column, used in terms:
        chosen = jnp.swapaxes(changes[turn, :, column], 0, 1)
        parts.append(chosen if used.all() else jnp.where(used[:, None], chosen, 0.0))
    return functools.reduce(jnp.add, parts)


def _by_turn(tree: Any) -> list[Any]:
    """The turns of a pytree of arrays (turn, ...)."""
    leaves, structure = jax.tree.flatten(tree)
    return [jax.tree.unflatten(structure, turn) for turn in zip(*(unstack(x, 0) for x in leaves), strict=True)]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _add_at_filled_places(together: int, places: Places, matrix: Changes, velocity: Array, impulse: Array) -> Array:
    """`add_changes` over those turns that hold a constraint; that loop has no reverse mode."""

    def by_turns(places: Places, matrix: Changes, velocity: Array, impulse: Array) -> Array:
        def body(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            turn, velocity = carry
            blocks, part, values = counter.row((places.blocks, matrix, impulse), turn)
            # Stored: a kernel that reads rows of two arrays takes the scalar index that it should not (see `counter`).
            changes = part.changes(store(values, values), together)
            return counter.following(turn), receive(velocity, blocks, changes)

        return lax.fori_loop(0, places.turns, body, (counter.start(), velocity))[1]

    def in_one_kernel(places: Places, matrix: Changes, velocity: Array, impulse: Array) -> Array:
        def answer(_: Array, __: list[Array], values: Changes, impulse: Array) -> tuple[list[Array], Array]:
            return values.changes(impulse, impulse.shape[1]), impulse

        group = visits.Group(matrix, places.blocks, jnp.asarray(places.turns))
        return visits.run(1, [answer], (group,), velocity, (impulse,))[0]

    return by_platform(by_turns, in_one_kernel, velocity, places, matrix, velocity, impulse)


def _add_at_filled_places_jvp(together: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    places, matrix, velocity, impulse = primals
    d_places, d_matrix, d_velocity, d_impulse = tangents
    leaves, structure = jax.tree.flatten((places.blocks, matrix, impulse))
    changes = jax.tree.leaves((d_places.blocks, d_matrix, d_impulse), is_leaf=chunk_derivatives.is_zero)

    def of_turn(*leaves: Array) -> list[Array]:
        blocks, part, values = jax.tree.unflatten(structure, leaves)
        return [receive(jnp.zeros_like(velocity), blocks, part.changes(values, together))]

    shape = jax.ShapeDtypeStruct(velocity.shape, velocity.dtype)
    added = Chunked(of_turn, 0, impulse.shape[0], (shape,), summed=True)
    d_added = chunk_derivatives.tangents(added, leaves, places.turns, changes)[0]
    d_velocity = d_added if chunk_derivatives.is_zero(d_velocity) else d_velocity + d_added
    return _add_at_filled_places(together, *primals), d_velocity


_add_at_filled_places.defjvp(_add_at_filled_places_jvp, symbolic_zeros=True)


def _all_turns(velocity: Array, blocks: tuple[tuple[int, ...], ...], together: int) -> Array:
    """(turn, component, constraint, world) velocities of all blocks of a table side."""
    flat = [min(block, velocity.shape[1] - 1) for turn in blocks for block in turn[::together]]
    gathered = spread(take(velocity, flat, axis=1), (velocity.shape[0], len(flat), velocity.shape[2]))
    return jnp.moveaxis(gathered.reshape(velocity.shape[0], len(blocks), -1, velocity.shape[2]), 1, 0)
