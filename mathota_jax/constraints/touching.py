"""The contacts that touch in a step, in few places: what a dense matrix of rows has room for.

Pairs that may touch are many more than do at the same time. Those that would overlap most, if nothing held the bodies, get
the places, in the order in which they are listed; where one that overlaps finds none a flag is set. A pair of many points
takes several places.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.constraints.contact import ContactRows, normal_mass, push_only
from mathota_jax.constraints.contact_room import places_of_pair
from mathota_jax.solver.laws import Cone
from mathota_jax.solver.row_matrix import Dense, Points
from mathota_jax.solver.rows import Places, Rows
from mathota_jax.solver.table import Table, TracedTable
from mathota_jax.spatial.indexing import gather, in_every_world
from mathota_jax.struct import pytree, static

AnyTable = Table | TracedTable


@pytree
class Touching:
    """Which parts of the constraints of some tables touch.

    Attributes:
      chosen: (place, world) number of the part in each place, ascending; their count for none.
      place_of: (part, world) the reverse; the count of places for none.
      overflow: (world,) whether some part that overlaps found no place.
      tables: of the constraints, whose parts are numbered through all of them, in the order turn, constraint, part.
      points: of each part.
    """

    chosen: Array
    place_of: Array
    overflow: Array
    tables: tuple[AnyTable, ...] = static()
    points: int = static()

    def rows(self, groups: Sequence[Rows]) -> Rows:
        """The rows in the places, one constraint a turn, from those of the tables, all of two bodies."""
        nowhere = groups[0].table.block_count
        blocks = zip(*(_both_sides(group, self.points, self.chosen.shape[-1]) for group in groups), strict=True)
        places = Places(tuple(self._of_parts(side, nowhere)[:, None] for side in blocks), None)
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
        pairs = zip(self.tables, values, strict=True)
        return self._of_parts([_by_part(table, value, self.points) for table, value in pairs], 0)

    def to_tables(self, values: Array) -> list[Array]:
        """The reverse; 0 for what found no place."""
        full = jnp.concatenate([values, jnp.zeros_like(values[:1])])
        found, first = [], 0
        for table in self.tables:
            count = table.turn_count * table.constraint_count * _part_count(table, self.points)
            own = gather(full, self.place_of[first : first + count])
            found.append(_by_table(table, own))
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
            packed.append(_by_part(group.table, jnp.concatenate(parts, axis=2), self.points))
            inertias.append([self._for_parts(group.table, side) for side in sides])
        inertia = tuple(self._of_parts(side, 0) for side in zip(*inertias, strict=True))
        return Points(self._of_parts(packed, 0), inertia).dense()

    def _for_parts(self, table: AnyTable, values: Array) -> Array:
        """(part, entry, 1, world) from the same (turn, entry, constraint, world) for all parts."""
        of_constraints = jnp.moveaxis(values, 2, 1).reshape(-1, values.shape[1], 1, values.shape[-1])
        return jnp.repeat(of_constraints, _part_count(table, self.points), axis=0)

    def _of_parts(self, values: Sequence[Array], otherwise: int) -> Array:
        """(place, ..., world) from (part, ..., world) of each table."""
        found, first = jnp.asarray(otherwise, values[0].dtype), 0
        for value in values:
            index = self.chosen - first
            here = (index >= 0) & (index < len(value))
            mine = gather(value, jnp.clip(index, 0, len(value) - 1))
            found = jnp.where(here.reshape(len(here), *(1,) * (mine.ndim - 2), -1), mine, found)
            first += len(value)
        return found


def touching(contacts: Sequence[ContactRows], capacity: int, points: int) -> Touching:
    """The parts of constraints, of so many points, that touch, as far as the places reach."""
    ahead, gap = [], []
    for group in contacts:
        assert group.ahead is not None
        ahead.append(_lowest(group, group.ahead, points))
        gap.append(_lowest(group, group.separation, points))
    worlds = max(part.shape[-1] for part in (*ahead, *gap))
    nearest, now = (jnp.concatenate(in_every_world(parts, worlds)) for parts in (ahead, gap))
    count = len(nearest)
    first = jnp.argsort(nearest, axis=0)[:capacity]
    taken = gather(jnp.where(nearest < jnp.inf, np.arange(count)[:, None], count), first)
    chosen = jnp.sort(taken, axis=0).astype(jnp.int32)
    places = np.arange(capacity, dtype=np.int32)[:, None, None]
    holds = chosen[:, None] == np.arange(count, dtype=np.int32)[:, None]
    place_of = jnp.where(holds, places, capacity).min(0)
    overflow = jnp.where(place_of == capacity, now < 0, False).any(0)
    return Touching(chosen, place_of, overflow, tuple(group.rows.table for group in contacts), points)


def _lowest(group: ContactRows, values: Array, points: int) -> Array:
    """(part, world) lowest value (turn, 1, column, world) of the points that are contacts, without derivative."""
    active = jnp.broadcast_to(normal_mass(group.rows) > 0, group.rows.bias[:, :1].shape)
    of_contacts = lax.stop_gradient(jnp.where(active, values, jnp.inf))
    return _by_part(group.rows.table, of_contacts, points, jnp.inf)[:, 0].min(1)


def _with_grip(law: Cone) -> Cone:
    return dataclasses.replace(law, first_grip=jnp.ones_like(law.tangent_mass))


def _both_sides(group: Rows, points: int, worlds: int) -> tuple[Array, Array]:
    """(part, world) velocity blocks of sides A and B; where one alone moves it is B."""
    table = group.table
    if isinstance(table, TracedTable):
        assert group.places is not None
        sides = [side.reshape(-1, side.shape[-1]) for side in group.places.blocks]
    else:
        sides = [jnp.asarray(side, jnp.int32)[:, :: table.together].reshape(-1, 1) for side in table.blocks]
    sides = [jnp.repeat(side, _part_count(table, points), axis=0) for side in in_every_world(sides, worlds)]
    return (jnp.full_like(sides[0], table.block_count), sides[0]) if len(sides) == 1 else (sides[0], sides[1])


def _part_count(table: AnyTable, points: int) -> int:
    """Parts of each constraint."""
    return places_of_pair(table.together, points)


def _by_part(table: AnyTable, values: Array, points: int, otherwise: float = 0.0) -> Array:
    """(part, row, ..., point, world) from (turn, row, ..., column, world)."""
    turns, *rows, _, worlds = values.shape
    parts = _part_count(table, points)
    split = values.reshape(turns, *rows, table.constraint_count, table.together, worlds)
    if missing := parts * points - table.together:
        widths = [*[(0, 0)] * (split.ndim - 2), (0, missing), (0, 0)]
        split = jnp.pad(split, widths, constant_values=otherwise)
    split = split.reshape(turns, *rows, table.constraint_count * parts, points, worlds)
    return jnp.moveaxis(split, -3, 1).reshape(-1, *rows, points, worlds)


def _by_table(table: AnyTable, values: Array) -> Array:
    """The reverse, (turn, row, column, world) from (part, row, point, world)."""
    _, rows, points, worlds = values.shape
    parts = _part_count(table, points)
    split = values.reshape(table.turn_count, table.constraint_count * parts, rows, points, worlds)
    columns = jnp.moveaxis(split, 1, 2).reshape(table.turn_count, rows, table.constraint_count, -1, worlds)
    return columns[..., : table.together, :].reshape(table.turn_count, rows, -1, worlds)
