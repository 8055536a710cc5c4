"""Order in which a sweep visits the rows, fixed at build time: turns of rows that share no moving body.

Rows of one turn are solved side by side as one vector operation; turns follow one another. A greedy colouring of the
constraints gives the turns: two constraints may share a colour if they share no moving body. The rows of one constraint
follow one another too, unless they are solved *together*: then they share the turn, and their law must bound the step.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

EMPTY = -1


class Constraint(NamedTuple):
    """Rows that act on the same velocity blocks. `blocks` has one entry (other body static) or two."""

    blocks: tuple[int, ...]
    slots: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Table:
    """Turns of a sweep over constraints that all have the same number of moving bodies.

    Attributes:
      slots: (turn, column) slot solved there, EMPTY for padding.
      blocks: for each side, (turn, column) velocity block; padding points at block `block_count`, which does not exist.
      block_count: number of velocity blocks.
      together: number of neighbouring columns that belong to one constraint.
    """

    slots: tuple[tuple[int, ...], ...]
    blocks: tuple[tuple[tuple[int, ...], ...], ...]
    block_count: int
    together: int

    @property
    def turn_count(self) -> int:
        """Number of turns in one sweep."""
        return len(self.slots)

    @property
    def column_count(self) -> int:
        """Columns of each turn."""
        return len(self.slots[0])

    @property
    def constraint_count(self) -> int:
        """Constraints of each turn."""
        return self.column_count // self.together

    @functools.cached_property
    def order(self) -> np.ndarray:
        """(turn * column,) slots in the order of the table, EMPTY for padding."""
        return np.asarray(self.slots, np.int32).reshape(-1)

    @functools.cached_property
    def receivers(self) -> np.ndarray:
        """(turn, block) constraint of the concatenated sides whose impulse the block gets; one past the end for none."""
        constraints = len(self.slots[0]) // self.together
        receivers = np.full((self.turn_count, self.block_count + 1), len(self.blocks) * constraints, np.int32)
        for side, blocks in enumerate(self.blocks):
            for turn, row in enumerate(blocks):
                receivers[turn, list(row[:: self.together])] = side * constraints + np.arange(constraints)
        return receivers[:, : self.block_count]


@dataclasses.dataclass(frozen=True)
class TracedTable:
    """Turns of a sweep whose constraints are known only in the step, in place of `Table`; `Rows.places` has the blocks.

    Attributes:
      turn_count: number of turns that there is room for.
      constraint_count: number of constraints in a turn.
      together: number of neighbouring columns that belong to one constraint.
      first_slot: slots are numbered from here in the order turn, column.
      block_count: number of velocity blocks.
    """

    turn_count: int
    constraint_count: int
    together: int
    first_slot: int
    block_count: int

    @property
    def column_count(self) -> int:
        """Columns of each turn."""
        return self.constraint_count * self.together

    @property
    def order(self) -> np.ndarray:
        """(turn * column,) slots in the order of the table."""
        return self.first_slot + np.arange(self.turn_count * self.column_count, dtype=np.int32)


def make_tables(constraints: Sequence[Constraint], block_count: int, together: bool) -> tuple[Table, ...]:
    """Tables that together visit every slot once: first the one-sided constraints, then the two-sided.

    Args:
      constraints: in the order in which they are to be visited.
      block_count: number of velocity blocks.
      together: whether the rows of a constraint are solved in one turn or one after the other.
    """
    tables = []
    for side_count in (1, 2):
        chosen = [constraint for constraint in constraints if len(constraint.blocks) == side_count]
        if chosen:
            tables.append(_make_table(chosen, side_count, block_count, together))
    return tuple(tables)


def _make_table(constraints: list[Constraint], side_count: int, block_count: int, together: bool) -> Table:
    turns: list[list[tuple[int, tuple[int, ...]]]] = []
    count = max(len(constraint.slots) for constraint in constraints) if together else 1
    for colour in _colour(constraints):
        if together:
            padded_slots = [(c, [*c.slots, *[EMPTY] * (count - len(c.slots))]) for c in colour]
            turns.append([(slot, c.blocks) for c, slots in padded_slots for slot in slots])
            continue
        for row in range(max(len(constraint.slots) for constraint in colour)):
            turns.append([(c.slots[row], c.blocks) for c in colour if row < len(c.slots)])
    width = max(len(turn) for turn in turns)
    padding = (EMPTY, (block_count,) * side_count)
    padded = [turn + [padding] * (width - len(turn)) for turn in turns]
    return Table(
        slots=tuple(tuple(slot for slot, _ in turn) for turn in padded),
        blocks=tuple(tuple(tuple(blocks[side] for _, blocks in turn) for turn in padded) for side in range(side_count)),
        block_count=block_count,
        together=count,
    )


def _colour(constraints: list[Constraint]) -> list[list[Constraint]]:
    """Greedy colouring in the given order."""
    colours: list[tuple[set[int], list[Constraint]]] = []
    for constraint in constraints:
        free = (colour for colour in colours if colour[0].isdisjoint(constraint.blocks))
        used, members = next(free, (set(), []))
        if not members:
            colours.append((used, members))
        used.update(constraint.blocks)
        members.append(constraint)
    return [members for _, members in colours]
