"""Rows with bounds on the joints of mechanisms: limits, motors, springs, friction, solved with all that hangs on them.

An impulse of such a row moves the whole tree. Swept like rows of two free bodies, in turn with the rows that hold, it finds
the inertia of the tree only after as many sweeps as the tree is heavier than the two: a stop throws the arm back, and what
friction should hold creeps. Here the response of the tree to each row is found first (`solver.tree`, all rows side by side
as if they were worlds), and the sweeps run over the small dense matrix of the rows, in which the joints hold throughout.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.constraints import mechanism, mechanism_drives, mechanism_links, row_sides
from mathota_jax.constraints.assembly import collect, pack_scalars, select
from mathota_jax.constraints.joint_rows import JointRows
from mathota_jax.constraints.joints.rows import STOP
from mathota_jax.solver import bounded_rows
from mathota_jax.solver.delassus import Whole
from mathota_jax.solver.laws import Bounded
from mathota_jax.solver.rows import Rows
from mathota_jax.solver.table import EMPTY
from mathota_jax.spatial.indexing import put, take
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.spread import add_scaled, diagonal, repeat_worlds

STIFF = 16
"""Multiples of the machine epsilon, relative to two bodies alone, of the least motion that a tree can be said to allow."""


class Responses(NamedTuple):
    """What rows with bounds do to the trees that they act on.

    Attributes:
      sides: the rows on single bodies.
      velocity: (component, block, row, world) under a unit impulse of each row, with the joints held.
      matrix: (row, row, world) what a unit impulse of the second does to the rate of the first.
    """

    sides: row_sides.RowSides
    velocity: Array
    matrix: Array


def responses(links: mechanism_links.Links, joint_rows: Sequence[Rows], slots: tuple[int, ...]) -> Responses:
    """The responses to the rows of some slots, which act on nothing but links.

    Args:
      links: mechanisms at the pose at which the rows act.
      joint_rows: all joint rows; their laws do not matter.
      slots: of the rows.
    """
    worlds = max(leaf.shape[-1] for leaf in (links.offset.x, *(group.bias for group in joint_rows)))
    places = row_sides.places_of_slots(joint_rows, slots)
    sides = row_sides.RowSides(row_sides.fixed_sides(joint_rows, places, worlds))
    return Responses(sides, *respond(links, sides, worlds))


def respond(links: mechanism_links.Links, sides: row_sides.RowSides, worlds: int) -> tuple[Array, Array]:
    """Velocity and matrix, as in `Responses`, of any rows; bodies that are not in mechanisms move alone."""
    block_count = links.layout.block_count
    force = sides.forces(block_count)
    force = compute_once(force, force)
    tiled = repeat_worlds(links, force.shape[2], worlds)
    velocity = mechanism.respond(tiled, force.reshape(*force.shape[:2], -1)).reshape(force.shape)
    if links.layout.alone:
        velocity = jnp.where(links.layout.is_link[:, None, None], velocity, sides.alone(block_count))
    velocity = compute_once(velocity, velocity)
    matrix = sides.matrix(velocity)
    return velocity, compute_once(matrix, matrix)


def felt_mass(own: Array, alone: Array) -> Array:
    """``J M^-1 J^T`` of rows (row, world) with the tree, not less than round-off leaves of that of two bodies alone."""
    return jnp.maximum(own, STIFF * jnp.finfo(own.dtype).eps * alone)


def solve(
    responses: Responses,
    joint_rows: Sequence[Rows],
    slots: tuple[int, ...],
    joints: JointRows,
    sweeps: int,
    velocity: Array,
    impulses: tuple[Array, ...],
    start: tuple[Array, ...],
) -> tuple[Array, tuple[Array, ...]]:
    """Velocity with the rows of some slots solved, and the changes of their impulses.

    Args:
      responses: to these rows.
      joint_rows: all joint rows.
      slots: of the rows to solve.
      joints: all joint rows, of which the laws matter.
      sweeps: over these rows.
      velocity: (component, block, world) with `impulses`, along which the joints hold.
      impulses: of the joint groups.
      start: where the sweeps start from, likewise.

    Returns:
      Velocity (component, block, world), along which the joints hold, and for each joint group the change of the impulses
      of these rows. Differentiable in both modes, at the solution.
    """
    law = jax.tree.map(lambda *parts: of_slots(joint_rows, slots, parts), *(group.law for group in joint_rows))
    bias = of_slots(joint_rows, slots, [group.bias for group in joint_rows])
    error = bias + responses.sides.rates(velocity[:, :, None])[:, 0]
    old, first = (of_slots(joint_rows, slots, values) for values in (impulses, start))
    laws = joints.laws[np.asarray(slots)]
    if mechanism_drives.are_stiff(laws):
        without = error - add_scaled(responses.matrix, old)
        first = _closer_start(sweeps, laws, *lax.stop_gradient((law, Whole(responses.matrix), without, first)))
    law = with_tree(diagonal(responses.matrix), law)
    change = bounded_rows.solve(sweeps, responses.matrix, law, error, old, first) - old
    moved = velocity + add_scaled(responses.velocity, change)
    return moved, to_tables(joint_rows, slots, change)


def _closer_start(
    sweeps: int, laws: np.ndarray, law: Bounded, delassus: Whole, errors: Array, impulses: Array
) -> Array:
    """Impulses (row, world) from which to sweep over all rows, see `mechanism_drives`; `errors` are without any."""
    alone = with_tree(delassus.diagonal(delassus.count), law)

    def sweep(found: mechanism_drives.Elimination, start: Array) -> Array:
        of_left = found.delassus
        left = with_tree(of_left.diagonal(of_left.count), take(law, found.left))
        return bounded_rows.solve(sweeps, of_left.whole(), left, found.errors, jnp.zeros_like(start), start)

    def left_to_do(impulses: Array) -> Array:
        change = alone.update(impulses, errors + delassus.times(impulses)) - impulses
        return safe_divide(change * change, jnp.broadcast_to(alone.effective_mass, change.shape)).sum(0)

    return mechanism_drives.closer_start(laws, law, delassus, errors, impulses, sweep, left_to_do)


def has_stops(slots: tuple[int, ...], joints: JointRows) -> bool:
    """Whether some of the rows are stops."""
    return bool((joints.laws[np.asarray(slots)] == STOP).any())


def leave_stops(
    responses: Responses,
    joint_rows: Sequence[Rows],
    slots: tuple[int, ...],
    joints: JointRows,
    error: Array,
    sweeps: int,
) -> Array:
    """Displacement (component, block, world) that takes trees back from what they are beyond their stops.

    Args:
      responses: to the rows of `slots`.
      joint_rows: all joint rows, as the velocity solver had them.
      slots: of these rows.
      joints: all joint rows.
      error: (slot, world) of all rows at the end of the step.
      sweeps: over the rows.
    """
    stops = np.flatnonzero(joints.laws[np.asarray(slots)] == STOP)
    matrix = responses.matrix[stops][:, stops]
    error = take(error, np.asarray(slots)[stops])
    worlds = max(error.shape[-1], matrix.shape[-1])
    nothing = jnp.zeros((len(stops), worlds), error.dtype)
    masses = [group.law.effective_mass for group in joint_rows if isinstance(group.law, Bounded)]
    alone = of_slots(joint_rows, tuple(np.asarray(slots)[stops]), masses)
    law = with_tree(diagonal(matrix), Bounded(alone, nothing, nothing, nothing + jnp.inf))
    pushes = bounded_rows.solve(sweeps, matrix, law, error, nothing, nothing)
    return add_scaled(responses.velocity[:, :, stops], pushes)


def of_slots(joint_rows: Sequence[Rows], slots: tuple[int, ...], values: Sequence[Array]) -> Array:
    """(row, world) from the (turn, 1, column, world) values of all tables."""
    tables = [group.table for group in joint_rows]
    worlds = max(value.shape[-1] for value in values)
    full = [jnp.broadcast_to(value[:, 0], (*value.shape[:1], *value.shape[2:-1], worlds)) for value in values]
    return take(collect(tables, full, _slot_count(joint_rows)), np.asarray(slots))


def to_tables(joint_rows: Sequence[Rows], slots: tuple[int, ...], values: Array) -> tuple[Array, ...]:
    """(turn, 1, column, world) for all tables from (row, world), 0 for other slots."""
    of_all = put(values, slots, _slot_count(joint_rows))
    return tuple(pack_scalars(group.table, [select(group.table, of_all)], values.shape[-1]) for group in joint_rows)


def _slot_count(joint_rows: Sequence[Rows]) -> int:
    return sum(int((group.table.order != EMPTY).sum()) for group in joint_rows)


def with_tree(own: Array, law: Bounded) -> Bounded:
    """Laws (row, world) that are those of two bodies alone, with all that hangs on them: `own` is the matrix's diagonal."""
    works = law.effective_mass > 0
    own = felt_mass(own, 1.0 / jnp.where(works, law.effective_mass, 1.0))
    mass = lax.stop_gradient(jnp.where(works, 1.0 / (own + law.softness), 0.0))
    return jax.tree.map(lambda x: jnp.broadcast_to(x, mass.shape), dataclasses.replace(law, effective_mass=mass))
