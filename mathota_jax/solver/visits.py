"""All visits of constraints in one kernel, on GPUs: a thread for each world goes from one constraint to the next.

What is done turn by turn elsewhere takes some ten kernels for each turn, which on a GPU take longer to launch than to run.
Here velocities and impulses stay in memory, where each thread reads what it wrote itself. The constraints of a turn share
no block, so that nothing changes if one follows the other.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.spatial.lanes import Entries, entries, written_out
from mathota_jax.struct import pytree

LANES = 32
"""Worlds of one program of the kernel: few, so that with some thousands every multiprocessor has its share."""

MOST_NUMBERS = 2**31 - 1
"""In one array: a thread finds its own by a number of 32 bits."""

Answer = Callable[[Array, list[Array], Any, Array], tuple[list[Array], Array]]
"""From the number of the round, the velocities (component, 1, world) of each side of a constraint, its values and its
impulse (row, column, world): how the velocity of each side changes, and the new impulse. It may add over the columns of a
constraint, else each is by itself: they are a vector, which was measured to compile in a sixth of the time."""


@pytree
class Group:
    """Constraints that are visited in the order turn, column.

    Attributes:
      values: pytree of arrays (turn, ..., column or constraint or 1, world or 1).
      blocks: for each side, (turn, constraint, world or 1) velocity block; one that does not exist receives nothing.
      turns: () number of turns that are visited, the first ones.
    """

    values: Any
    blocks: tuple[Array, ...]
    turns: Array


def run(
    rounds: int,
    answers: Sequence[Answer],
    groups: tuple[Group, ...],
    velocity: Array,
    impulses: tuple[Array, ...],
    interpret: bool = False,
) -> tuple[Array, tuple[Array, ...]]:
    """A number of rounds through all groups.

    Args:
      rounds: that number.
      answers: how the constraints of each group answer to a visit.
      groups: what is visited.
      velocity: (component, block, world).
      impulses: of each group (turn, row, column, world); the columns of a constraint are neighbours, a power of 2.
      interpret: whether to run on any device, slowly, to test it.

    Returns:
      The velocity and the impulses after the last round.

    Raises:
      ValueError: an array is too large.
    """
    from jax.experimental import pallas  # takes long to import, and only GPUs need it
    from jax.experimental.pallas import triton

    # Where kernels are interpreted, what is not to be stored is stored as it was.
    lane_count = velocity.shape[-1] if interpret else LANES
    groups = tuple(dataclasses.replace(group, turns=jnp.reshape(group.turns, (1, 1))) for group in groups)
    worlds, state = velocity.shape[-1], (velocity, *impulses)
    leaves, tree = jax.tree.flatten((groups, state))
    fixed = len(leaves) - len(state)
    if (largest := max(leaf.size for leaf in leaves)) > MOST_NUMBERS:
        raise ValueError(
            f"step: on a GPU {worlds} worlds need an array of {largest} numbers, more than the {MOST_NUMBERS} that 32 bits "
            f"count; take at most {worlds * MOST_NUMBERS // largest} worlds of this scene in one batch"
        )

    def kernel(*refs: Any) -> None:
        # What the state was is what its place in the results starts from.
        refs = (*refs[:fixed], *refs[len(leaves) :])
        world = pallas.program_id(0) * lane_count + jnp.arange(lane_count, dtype=jnp.int32)[None]
        lanes = _Lanes(jnp.minimum(world, worlds - 1), world < worlds, triton.store)
        own, (moved, *answered) = jax.tree.unflatten(
            tree, [_Stored(ref, leaf.shape) for ref, leaf in zip(refs, leaves, strict=True)]
        )

        def one_round(number: Array, _: None) -> None:
            for answer, group, impulse in zip(answers, own, answered, strict=True):
                visit = functools.partial(_visit, lanes, number, answer, group, moved, impulse)
                visits = lanes.read(group.turns, 0) * group.blocks[0].shape[1]
                lax.fori_loop(0, visits, lambda k, _, visit=visit: visit(k), None)

        lax.fori_loop(0, rounds, one_round, None)

    found = pallas.pallas_call(
        kernel,
        out_shape=[jax.ShapeDtypeStruct((x.size,), x.dtype) for x in state],
        grid=(-(-worlds // lane_count),),
        input_output_aliases={fixed + place: place for place in range(len(state))},
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="visits",
    )(*(leaf.reshape(-1) for leaf in leaves))
    velocity, *others = (x.reshape(like.shape) for x, like in zip(found, state, strict=True))
    return velocity, tuple(others)


def _visit(
    lanes: _Lanes, number: Array, answer: Answer, group: Any, moved: _Stored, answered: _Stored, place: Array
) -> None:
    """Lets one constraint answer, and stores what changes."""
    constraints = np.int32(group.blocks[0].shape[1])
    together = answered.shape[2] // int(constraints)
    turn, constraint = lax.div(place, constraints), lax.rem(place, constraints)
    components, block_count, _ = moved.shape
    blocks = [lanes.read(side, turn * constraints + constraint) for side in group.blocks]
    held = [jnp.minimum(block, block_count - 1) for block in blocks]
    moving = [
        entries((components, 1), [lanes.read(moved, k * block_count + block) for k in range(components)])
        for block in held
    ]

    def at_visit(stored: _Stored) -> Entries:
        *natural, size, _ = stored.shape[1:]
        rows, columns = math.prod(natural), together if size == constraints * together else 1
        first = turn * (rows * size) + (0 if size == 1 else constraint * columns)
        found = [lanes.read(stored, first + row * size, columns) for row in range(rows)]
        several = columns > 1
        return entries(tuple(natural) if several else (*natural, 1), found, several)

    values, impulse = jax.tree.map(at_visit, (group.values, answered), is_leaf=lambda x: isinstance(x, _Stored))
    changes, new = written_out(answer, together, number, moving, values, impulse)
    for block, row, old, change in zip(blocks, held, moving, changes, strict=True):
        for k, value in enumerate(change.vectors[:, 0]):
            lanes.write(moved, k * block_count + row, old.vectors[k, 0] + value, where=block < block_count)
    _, rows, size, _ = answered.shape
    for row, value in enumerate(new.vectors.reshape(rows)):
        lanes.write(answered, (turn * rows + row) * size + constraint * together, value, columns=together)


class _Stored(NamedTuple):
    """An array in memory: in one axis, so that its entries are found by one number, and its shape (..., world or 1)."""

    ref: Any
    shape: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class _Lanes:
    """The worlds of one program of the kernel, each a thread.

    Attributes:
      world: (1, lane) their numbers, of one that exists if there is no such world.
      exists: (1, lane) whether there is.
      store: writes to memory.
    """

    world: Array
    exists: Array
    store: Callable[..., None]

    def read(self, stored: _Stored, row: Any, columns: int = 1) -> Array:
        """(column, lane) entries of rows of an array (row, world) from `row`, a number or one for each world, on.

        The worlds may share the array.
        """
        if stored.shape[-1] > 1:
            return stored.ref[self._places(stored, row, columns)]
        return stored.ref[row if columns == 1 else row + _numbers(columns) + jnp.zeros_like(self.world)]

    def write(self, stored: _Stored, row: Any, value: Array, where: Any = True, columns: int = 1) -> None:
        """Stores (column, lane) entries in rows from `row` on."""
        place = self._places(stored, row, columns)
        value = jnp.broadcast_to(value, place.shape).astype(stored.ref.dtype)
        self.store(stored.ref.at[place], value, mask=jnp.broadcast_to(self.exists & where, place.shape))

    def _places(self, stored: _Stored, row: Any, columns: int) -> Array:
        first = row if columns == 1 else row + _numbers(columns)
        return first * stored.shape[-1] + self.world


def _numbers(count: int) -> Array:
    """(column, 1) from 0 on."""
    return jnp.arange(count, dtype=jnp.int32)[:, None]
