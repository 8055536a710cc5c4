"""Contacts of mechanisms, and rows with bounds on their joints: solved together, in a space in which the joints hold.

An impulse on a link moves the whole tree. Swept in turn with the rows that hold, a contact finds the inertia of the tree
only after as many sweeps as the tree is heavier than the link: a robot sinks through the ground on its light feet. Here the
matrix ``J M^-1 J^T`` of all rows with the joints held is found first (`solver.delassus`). What the sweeps then act on is not
the velocities of bodies, but generalized impulses of the mechanisms, or the rates of the rows where these are fewer.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import Inertia, respond_alone
from mathota_jax.constraints import contact, mechanism, mechanism_coordinates, mechanism_links, row_sides
from mathota_jax.constraints.contact import ContactRows
from mathota_jax.constraints.effective_mass import normal_bound, tangent_bound
from mathota_jax.constraints.mechanism_layout import bounded_slots, contact_places
from mathota_jax.constraints.mechanism_rows import of_slots, respond, to_tables, with_tree
from mathota_jax.constraints.touching import Touching, touching
from mathota_jax.scene import Scene
from mathota_jax.solver.delassus import Delassus, Factored, Whole
from mathota_jax.solver.laws import Bounded, Cone
from mathota_jax.solver.row_matrix import Dense, Entries
from mathota_jax.solver.rows import Rows
from mathota_jax.solver.table import EMPTY, Table, TracedTable
from mathota_jax.spatial.indexing import in_every_world, take
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once


class _Class(NamedTuple):
    """Constraints of one number of points; a table pads all to as many as its largest has.

    Attributes:
      members: numbers of the constraints in their table, turn by turn.
      points: points of each.
    """

    members: tuple[int, ...]
    points: int

    def rows(self, table: Table, rows: int) -> np.ndarray:
        """(member, point, row) places among the rows of the table, in the order turn, column, row; `rows` are of a point."""
        columns = np.asarray(self.members)[:, None] * table.together + np.arange(self.points)
        return columns[..., None] * rows + np.arange(rows)


class Reduced(NamedTuple):
    """The rows of a step, reduced.

    Attributes:
      links: the mechanisms at the pose at which the rows act.
      inertia: of the moving bodies.
      sides: the rows on single bodies.
      delassus: ``J M^-1 J^T`` of the rows with the joints held, without derivative.
      rows: one group for the rows with bounds on joints, if there are any, then one for each class of each contact table.
      close: the last of these, of contacts that have places, as they act on single bodies; None if all have rows.
      touching: which these are.
    """

    links: mechanism_links.Links
    inertia: Inertia
    sides: row_sides.RowSides
    delassus: Delassus
    rows: tuple[Rows, ...]
    close: Rows | None = None
    touching: Touching | None = None

    def rates(self, velocity: Array) -> Array:
        """Rates (row, world) of the velocities (component, block, world)."""
        return self.sides.rates(velocity[:, :, None])[:, 0]

    def change(self, impulses: Array) -> Array:
        """Velocities (component, block, world) that impulses (row, world) change, with the joints held."""
        layout = self.links.layout
        force = self.sides.push(impulses, layout.block_count)
        force = compute_once(force, force)
        moved = mechanism.respond(self.links, force)
        return jnp.where(layout.is_link[:, None], moved, respond_alone(self.inertia, force)) if layout.alone else moved

    def contacts(self, groups: Sequence[Rows]) -> list[Rows]:
        """Those of all contacts that have places here, with laws and biases of `groups`: laws of all contacts."""
        if self.close is None or self.touching is None:
            return [*groups]
        count = len(groups) - len(self.touching.tables)
        return [*groups[:count], self.touching.with_laws(self.close, groups[count:])]

    def with_biases(self, contacts: Sequence[Rows]) -> Reduced:
        """The same with those of `contacts`."""
        contacts = self.contacts(contacts)
        biases = _by_class([group.table for group in contacts], [group.bias for group in contacts])
        count = len(self.rows) - len(biases)
        groups = (dataclasses.replace(mine, bias=bias) for mine, bias in zip(self.rows[count:], biases, strict=True))
        return self._replace(rows=(*self.rows[:count], *groups))


def reduce(
    scene: Scene,
    links: mechanism_links.Links,
    inertia: Inertia,
    joint_rows: Sequence[Rows],
    groups: Sequence[ContactRows],
) -> Reduced:
    """The rows of a scene whose mechanisms take contacts, from those that act on single bodies."""
    contacts = [group.rows for group in groups]
    worlds = max(leaf.shape[-1] for leaf in (links.offset.x, *(group.bias for group in (*joint_rows, *contacts))))
    room = contact_places(scene)
    assert room is not None
    count = len(_fixed_tables(scene))
    contacts, traced, found = contacts[:count], groups[count:], None
    fixed = (*joint_rows, *contacts)
    sides, close = row_sides.RowSides(row_sides.fixed_sides(fixed, _places(scene, joint_rows, contacts), worlds)), None
    if traced:
        found = touching(traced, room.count, room.points)
        close = found.rows([group.rows for group in traced])
        sides, contacts = sides._replace(traced=row_sides.traced_sides(close, worlds)), [*contacts, close]
    # Of the sides a part is static.
    delassus = lax.stop_gradient(_delassus(*lax.stop_gradient((links, inertia)), sides, worlds))
    bounded = bounded_slots(scene)
    rows, first = [], len(bounded)
    if bounded:
        rows.append(_joint_group(joint_rows, bounded, delassus))
    rows += contact_groups(contacts, delassus, first)
    return Reduced(links, inertia, sides, delassus, tuple(rows), close, found)


def _delassus(links: mechanism_links.Links, inertia: Inertia, sides: row_sides.RowSides, worlds: int) -> Delassus:
    """In the smaller form."""
    if not 0 < mechanism_coordinates.coordinate_count(links.layout) < sides.count:
        return Whole(respond(links, sides, worlds)[1])
    rates = sides.rates(mechanism_coordinates.responses(links, inertia, worlds))
    forces = sides.rates(mechanism_coordinates.motions(links, worlds))
    return Factored(compute_once(rates, rates), compute_once(forces, forces))


def to_reduced(
    scene: Scene, joint_rows: Sequence[Rows], reduced: Reduced, values: Sequence[Array]
) -> tuple[Array, ...]:
    """Values of all groups (turn, row, column, world), in the order of the reduced ones."""
    bounded = bounded_slots(scene)
    joints, contacts = values[: len(joint_rows)], values[len(joint_rows) :]
    found = [of_slots(joint_rows, bounded, joints)[:, None, None]] if bounded else []
    tables = _fixed_tables(scene)
    found += _by_class(tables, contacts[: len(tables)])
    return (*found, reduced.touching.of_tables(contacts[len(tables) :])) if reduced.touching else tuple(found)


def in_order(impulses: Sequence[Array]) -> Array:
    """(row, world) in the order of the reduced rows, from those of their groups."""
    return jnp.concatenate([jnp.moveaxis(part, 1, 2).reshape(-1, part.shape[-1]) for part in impulses])


def by_group(groups: Sequence[Rows], values: Array) -> tuple[Array, ...]:
    """The reverse: (turn, row, point, world) of each group."""
    found, first = [], 0
    for group in groups:
        turns, rows, points = group.bias.shape[:3]
        own = values[first : first + turns * rows * points].reshape(turns, points, rows, -1)
        found.append(jnp.swapaxes(own, 1, 2))
        first += turns * rows * points
    return tuple(found)


def from_reduced(
    scene: Scene, joint_rows: Sequence[Rows], reduced: Reduced, values: Sequence[Array]
) -> tuple[Array, ...]:
    """The reverse; 0 for rows that always hold, and for contacts without a place."""
    bounded = bounded_slots(scene)
    worlds = max(value.shape[-1] for value in values)
    if bounded:
        joints = to_tables(joint_rows, bounded, values[0][:, 0, 0])
    else:
        joints = tuple(jnp.zeros((*group.bias.shape[:-1], worlds), group.bias.dtype) for group in joint_rows)
    own, close = values[bool(bounded) :], []
    if reduced.touching is not None:
        own, close = own[:-1], reduced.touching.to_tables(own[-1])
    return (*joints, *_by_turn(_fixed_tables(scene), own), *close)


def normal_rows(reduced: Reduced, contacts: Sequence[Rows]) -> tuple[tuple[Rows, ...], Array, np.ndarray]:
    """Groups for the normals of the contacts alone, with the biases of `contacts`.

    Also what their sweeps act on, at rest, and their numbers among all rows.
    """
    contacts = reduced.contacts(contacts)
    groups = reduced.rows[len(reduced.rows) - sum(len(_classes(group.table)) for group in contacts) :]
    first = reduced.delassus.count - sum(group.bias[..., 0].size for group in groups)
    numbers = []
    for group in groups:
        turns, rows, points = group.bias.shape[:3]
        numbers.append(first + np.arange(turns * rows * points).reshape(turns, points, rows)[:, :, 0].reshape(-1))
        first += turns * rows * points
    chosen = np.concatenate(numbers)
    of_normals = reduced.delassus.chosen(chosen)
    rows = tuple(contact_groups(contacts, of_normals, 0))
    return rows, at_rest(of_normals, max(group.bias.shape[-1] for group in rows)), chosen


def at_rest(delassus: Delassus, worlds: int) -> Array:
    """What sweeps act on, (component, 1, world), without impulses and rates."""
    like = jax.tree.leaves(delassus)[0]
    return jnp.zeros((delassus.size, 1, worlds), like.dtype)


def with_rates(groups: Sequence[Rows], delassus: Delassus, rates: Array) -> tuple[tuple[Rows, ...], Array]:
    """Groups, and what their sweeps act on, where the rates (row, world) are some without impulses.

    Not as biases, by which sweeps know what bounces: generalized impulses get a component more, which is 1 throughout.
    """
    if isinstance(delassus, Whole):
        return tuple(groups), rates[:, None]
    found = []
    for group, more in zip(groups, by_group(groups, rates), strict=True):
        dense = group.matrix.dense()
        (jacobian,), (response,) = dense.jacobian, dense.response
        jacobian = jnp.concatenate(in_every_world([jacobian, more[:, :, None]], rates.shape[-1]), axis=2)
        response = jnp.concatenate([response, jnp.zeros_like(response[:, :, :1])], axis=2)
        found.append(dataclasses.replace(group, matrix=Dense((jacobian,), (response,))))
    still = at_rest(delassus, rates.shape[-1])
    return tuple(found), jnp.concatenate([still, jnp.ones_like(still[:1])])


def with_errors(groups: Sequence[Rows], errors: Array) -> tuple[Rows, ...]:
    """The groups with the errors (row, world) added to their biases, in the order of their rows."""
    parts = zip(groups, by_group(groups, errors), strict=True)
    return tuple(dataclasses.replace(group, bias=group.bias + error) for group, error in parts)


def _fixed_tables(scene: Scene) -> tuple[Table, ...]:
    """Of the contacts each point of which has rows; they come first."""
    room = contact_places(scene)
    return () if room is not None and room.for_all else contact.contact_tables(scene)


def _places(scene: Scene, joint_rows: Sequence[Rows], contacts: Sequence[Rows]) -> np.ndarray:
    """Of all rows that do not always hold, see `row_sides.sides`."""
    parts = [row_sides.places_of_slots(joint_rows, bounded_slots(scene))]
    first = sum(group.table.order.size for group in joint_rows)
    for group in contacts:
        parts += [
            first + members.rows(group.table, group.bias.shape[1]).reshape(-1) for members in _classes(group.table)
        ]
        first += group.bias[..., 0].size
    return np.concatenate(parts)


def _group(table: Table, law: Bounded | Cone, bias: Array, delassus: Delassus, first: int) -> Rows:
    """Rows that start at `first`, one constraint a turn."""
    turns, rows, points = bias.shape[:3]
    return Rows(delassus.turns(first, turns, points, rows), bias, law, table)  # type: ignore[arg-type]


def _one_a_turn(turns: int, points: int) -> Table:
    slots = tuple(tuple(range(points * turn, points * (turn + 1))) for turn in range(turns))
    return Table(slots, (((0,) * points,) * turns,), 1, points)


def _joint_group(joint_rows: Sequence[Rows], bounded: tuple[int, ...], delassus: Delassus) -> Rows:
    law = jax.tree.map(lambda *parts: of_slots(joint_rows, bounded, parts), *(group.law for group in joint_rows))
    return scalar_group(law, of_slots(joint_rows, bounded, [group.bias for group in joint_rows]), delassus)


def scalar_group(law: Bounded, bias: Array, delassus: Delassus) -> Rows:
    """The first rows, one after the other; law and bias (row, world), the masses those of two bodies alone."""
    law = with_tree(delassus.diagonal(len(bias)), law)
    law, bias = jax.tree.map(lambda x: jnp.broadcast_to(x, law.softness.shape)[:, None, None], (law, bias))
    return _group(_one_a_turn(len(bias), 1), law, bias, delassus, 0)


def contact_groups(contacts: Sequence[Rows], delassus: Delassus, first: int) -> list[Rows]:
    """The groups of all contacts, whose rows start at `first`."""
    found = []
    for group in contacts:
        for members in _classes(group.table):
            found.append(_contact_group(group, members, delassus, first))
            first += found[-1].bias[..., 0].size
    return found


def _contact_group(group: Rows, members: _Class, delassus: Delassus, first: int) -> Rows:
    bias = _of_class(group.table, members, group.bias)
    turns, rows, points = bias.shape[:3]
    size = rows * points
    own = delassus.blocks(first, turns, size)
    own = compute_once(own, own).reshape(turns, size, points, rows, -1)

    def of_points(values: Array) -> Array:
        return _of_class(group.table, members, values[:, None])[:, 0]

    law = group.law
    mass = of_points(law.normal_mass if isinstance(law, Cone) else law.effective_mass[:, 0])
    active = jnp.broadcast_to(jnp.where(mass > 0, 1.0, 0.0), (turns, points, own.shape[-1])).astype(own.dtype)
    entries = _entries(own)
    meets = active * of_points(law.meets) if isinstance(law, Cone) else active
    normal = safe_divide(active, normal_bound(entries, points, active, meets))
    if not isinstance(law, Cone):
        return _group(_one_a_turn(turns, points), contact.push_only(normal[:, None]), bias, delassus, first)
    tangent = safe_divide(active, tangent_bound(entries, points, active, meets))
    grip = None if law.first_grip is None else of_points(law.first_grip)
    law = Cone(normal, tangent, of_points(law.friction), meets, grip)
    return _group(_one_a_turn(turns, points), law, bias, delassus, first)


def _entries(own: Array) -> tuple[Entries, Entries]:
    """Two matrices whose product is (turn, row, point, row of the point, world): the unit matrix, and itself."""
    turns, size, points, rows, worlds = own.shape
    units = np.eye(size).reshape(size, 1, points, rows, 1)
    unit = jnp.broadcast_to(jnp.asarray(units, own.dtype), (size, turns, points, rows, worlds))
    return tuple(  # type: ignore[return-value]
        [[[values[m, :, :, row] for m in range(size)] for row in range(rows)]]
        for values in (unit, jnp.moveaxis(own, 1, 0))
    )


@functools.cache
def _classes(table: Table | TracedTable) -> tuple[_Class, ...]:
    """The constraints of a table by their number of points; padding is none."""
    points = (table.order.reshape(-1, table.together) != EMPTY).sum(1)
    return tuple(_Class(tuple(np.flatnonzero(points == n).tolist()), n) for n in sorted(set(points.tolist()) - {0}))


def _of_class(table: Table | TracedTable, members: _Class, values: Array) -> Array:
    """(member, row, point, world) from (turn, row, column, world)."""
    turns, rows, columns, worlds = values.shape
    split = values.reshape(turns, rows, columns // table.together, table.together, worlds)
    of_all = jnp.moveaxis(split, 1, 2).reshape(-1, rows, table.together, worlds)
    return take(of_all, members.members)[:, :, : members.points]


def _by_class(tables: Sequence[Table | TracedTable], values: Sequence[Array]) -> list[Array]:
    """(member, row, point, world) of all classes from (turn, row, column, world) of the tables."""
    pairs = zip(tables, values, strict=True)
    return [_of_class(table, members, value) for table, value in pairs for members in _classes(table)]


def _by_turn(tables: Sequence[Table], values: Sequence[Array]) -> list[Array]:
    """The reverse; 0 for padding."""
    found, left = [], list(values)
    for table in tables:
        classes = _classes(table)
        parts, left = left[: len(classes)], left[len(classes) :]
        widths = [(0, table.together - members.points) for members in classes]
        padded = [jnp.pad(part, ((0, 0), (0, 0), width, (0, 0))) for part, width in zip(parts, widths, strict=True)]
        count = table.order.size // table.together
        solved = np.concatenate([members.members for members in classes])
        place = np.full(count, len(solved))
        place[solved] = np.arange(len(solved))
        if len(solved) < count:
            padded.append(jnp.zeros_like(padded[0][:1]))
        of_all = take(jnp.concatenate(padded), place)
        rows, worlds = of_all.shape[1], of_all.shape[-1]
        split = of_all.reshape(table.turn_count, -1, rows, table.together, worlds)
        found.append(jnp.moveaxis(split, 2, 1).reshape(table.turn_count, rows, -1, worlds))
    return found
