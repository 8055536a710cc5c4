"""The contacts of the broadphase that touch now, in few places: what a dense matrix of rows has room for.

The broadphase lists pairs whose bounds overlap, which are many more than touch at the same time. Of those that touch the
deepest get a place, in the order in which they are listed; what finds none sets a flag.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.constraints.contact import ContactRows, normal_mass, push_only
from mathota_jax.solver.laws import Cone
from mathota_jax.solver.row_matrix import Dense, Points
from mathota_jax.solver.rows import Places, Rows
from mathota_jax.solver.table import TracedTable
from mathota_jax.spatial.indexing import gather, in_every_world
from mathota_jax.struct import pytree, static


@pytree
class Touching:
    """Which constraints of some traced tables touch.

    Attributes:
      chosen: (place, world) number of the constraint in each place, ascending; their count for none.
      place_of: (constraint, world) the reverse; the count of places for none.
      overflow: (world,) whether some constraint that touches found no place.
      tables: of the constraints, which are numbered through all of them, in the order turn, constraint.
    """

    chosen: Array
    place_of: Array
    overflow: Array
    tables: tuple[TracedTable, ...] = static()

    @property
    def points(self) -> int:
        """Points of each place."""
        return max(table.together for table in self.tables)

    def rows(self, groups: Sequence[Rows]) -> Rows:
        """The rows in the places, one constraint a turn, from those of the tables, all of two bodies."""
        nowhere = groups[0].table.block_count
        blocks = zip(*(_both_sides(group) for group in groups), strict=True)
        places = Places(tuple(self._of_constraints(side, nowhere)[:, None] for side in blocks), None)
        table = TracedTable(len(self.chosen), 1, self.points, 0, nowhere)
        return self.with_laws(Rows(self._matrix(groups), jnp.zeros(()), groups[0].law, table, places), groups)

    def with_laws(self, rows: Rows, groups: Sequence[Rows]) -> Rows:
        """Rows in the places with the laws and biases of those of the tables; 0 where nothing touches."""
        bias = self.of_tables([group.bias for group in groups])
        laws = [group.law for group in groups if isinstance(group.law, Cone)]
        if not laws:
            mass = self.of_tables([normal_mass(group) for group in groups])
            return dataclasses.replace(rows, bias=bias, law=push_only(mass))
        if any(law.first_grip is not None for law in laws):
            # Absent where pairs have one point, for which it would be 1.
            laws = [law if law.first_grip is not None else _with_grip(law) for law in laws]
        law = jax.tree.map(lambda *parts: self.of_tables([part[:, None] for part in parts])[:, 0], *laws)
        return dataclasses.replace(rows, bias=bias, law=law)

    def of_tables(self, values: Sequence[Array]) -> Array:
        """(place, row, point, world) from (turn, row, column, world) of the tables; 0 where nothing touches."""
        return self._of_constraints(
            [self._padded(_by_constraint(table, value)) for table, value in zip(self.tables, values, strict=True)],
            0,
        )

    def to_tables(self, values: Array) -> list[Array]:
        """The reverse; 0 for what found no place."""
        full = jnp.concatenate([values, jnp.zeros_like(values[:1])])
        found, first = [], 0
        for table in self.tables:
            count = table.turn_count * table.constraint_count
            own = gather(full, self.place_of[first : first + count])[..., : table.together, :]
            split = own.reshape(table.turn_count, table.constraint_count, *own.shape[1:])
            found.append(jnp.moveaxis(split, 1, 2).reshape(table.turn_count, own.shape[1], -1, own.shape[-1]))
            first += count
        return found

    def _matrix(self, groups: Sequence[Rows]) -> Dense:
        packed, inertias = [], []
        for group in groups:
            points = group.matrix
            assert isinstance(points, Points)
            parts = [points.directions, *points.angular]
            sides = list(points.packed_inertia)
            if len(sides) == 1:
                # The other side is no body at all.
                parts[1:] = [jnp.zeros_like(part) for part in parts[1:]] + parts[1:]
                sides.insert(0, jnp.zeros_like(sides[0]))
            packed.append(self._padded(_by_constraint(group.table, jnp.concatenate(parts, axis=2))))
            inertias.append([_by_constraint(group.table, side) for side in sides])
        inertia = tuple(self._of_constraints(side, 0) for side in zip(*inertias, strict=True))
        return Points(self._of_constraints(packed, 0), inertia).dense()

    def _padded(self, values: Array) -> Array:
        """(..., point, world) with as many points as all tables."""
        missing = self.points - values.shape[-2]
        return jnp.pad(values, [*[(0, 0)] * (values.ndim - 2), (0, missing), (0, 0)]) if missing else values

    def _of_constraints(self, values: Sequence[Array], otherwise: int) -> Array:
        """(place, ..., world) from (constraint, ..., world) of each table."""
        found, first = jnp.asarray(otherwise, values[0].dtype), 0
        for value in values:
            index = self.chosen - first
            here = (index >= 0) & (index < len(value))
            mine = gather(value, jnp.clip(index, 0, len(value) - 1))
            found = jnp.where(here.reshape(len(here), *(1,) * (mine.ndim - 2), -1), mine, found)
            first += len(value)
        return found


def touching(contacts: Sequence[ContactRows], capacity: int) -> Touching:
    """The constraints of traced tables that touch, as far as the places reach."""
    tables, depth = [], []
    for group in contacts:
        active = jnp.broadcast_to(normal_mass(group.rows) > 0, group.rows.bias[:, :1].shape)
        separation = jnp.where(active, group.separation, jnp.inf)
        tables.append(group.rows.table)
        depth.append(lax.stop_gradient(_by_constraint(group.rows.table, separation)[:, 0].min(1)))
    worlds = max(part.shape[-1] for part in depth)
    of_all = jnp.concatenate(in_every_world(depth, worlds))
    count = len(of_all)
    touches = of_all < jnp.inf
    deepest = jnp.argsort(of_all, axis=0)[:capacity]
    taken = gather(jnp.where(touches, np.arange(count)[:, None], count), deepest)
    chosen = jnp.sort(taken, axis=0).astype(jnp.int32)
    places = np.arange(capacity, dtype=np.int32)[:, None, None]
    holds = chosen[:, None] == np.arange(count, dtype=np.int32)[:, None]
    place_of = jnp.where(holds, places, capacity).min(0)
    return Touching(chosen, place_of, touches.sum(0) > capacity, tuple(tables))


def _with_grip(law: Cone) -> Cone:
    return dataclasses.replace(law, first_grip=jnp.ones_like(law.tangent_mass))


def _both_sides(group: Rows) -> tuple[Array, Array]:
    """(constraint, world) velocity blocks of sides A and B; where one alone moves it is B."""
    assert group.places is not None
    sides = [side.reshape(-1, side.shape[-1]) for side in group.places.blocks]
    return (jnp.full_like(sides[0], group.table.block_count), sides[0]) if len(sides) == 1 else (sides[0], sides[1])


def _by_constraint(table: TracedTable, values: Array) -> Array:
    """(constraint, row, ..., point, world) from (turn, row, ..., column, world)."""
    turns, *rows, columns, worlds = values.shape
    split = values.reshape(turns, *rows, table.constraint_count, columns // table.constraint_count, worlds)
    return jnp.moveaxis(split, -3, 1).reshape(-1, *rows, columns // table.constraint_count, worlds)
