"""Contact rows: non-penetration, restitution at the time of impact, isotropic friction (guide 8 and 9).

A row acts on the velocities at the *end* of the step, while the position moves by
``dt (v_start + v_free) / 2 + lever (v_end - v_free)``: the impulse of a contact that lasts the whole step acts, on
average, at half time (lever dt/2), that of an impact at its time of impact (lever dt - tau). So a sliding block keeps its
exact parabola and a bounce at tau is followed by the rest of the step in flight, whose derivative is the saltation matrix.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import InverseInertia, pack_blocks, smaller_moving
from mathota_jax.collision.narrowphase import SPECULATIVE, ContactSet, stored
from mathota_jax.constraints.assembly import (
    gather_columns,
    pack_directions,
    pack_scalars,
    select,
    select_blocks,
    smaller_side,
    turn_of_points,
)
from mathota_jax.constraints.effective_mass import (
    first_grip,
    meeting,
    normal_bound,
    sliding_step,
    step_length,
    tangent_bound,
)
from mathota_jax.constraints.impact import Approach, impact, let_in, loaded, rebound, stop
from mathota_jax.constraints.mechanism_layout import contact_places
from mathota_jax.constraints.unreached import Turns, lone_spheres, unreached
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.solver.laws import Cone, Push
from mathota_jax.solver.row_matrix import FirstRow, Points
from mathota_jax.solver.rows import Places, Rows, map_turns, matrix_velocity, row_velocity
from mathota_jax.solver.table import Constraint, Table, TracedTable, make_tables
from mathota_jax.spatial.chunks import map_filled
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import compute_once, settle, store_cotangents
from mathota_jax.spatial.vector import Vec3, dot, norm, tangent_basis


class Motion(NamedTuple):
    """Moving bodies at the start of a step.

    Attributes:
      position: of their centres of mass.
      velocity, free_velocity: (component, block, world) now, and at the end of the step if nothing constrained them.
      inertia: inverse, in the world frame.
      gravity: [m/s^2].
      mass_together: (block, world) of the mechanism of each body, of a body of none its own; None without mechanisms.
    """

    position: Vec3
    velocity: Array
    free_velocity: Array
    inertia: InverseInertia
    gravity: Vec3
    mass_together: Array | None = None


class Load(NamedTuple):
    """Rebounds of contacts that may carry others, (turn, 1, column, world).

    Attributes:
      alone: impulse that the rebound takes if nothing else is carried; 0 for no rebound.
      lever: time [s] that the impulse has to act if most of it carries others.
      bias, resting: of the rows and their lever without rebound.
    """

    alone: Array
    lever: Array
    bias: Array
    resting: Array


class ContactRows(NamedTuple):
    """Rows of one table with what else the step needs to know of its contacts.

    Attributes:
      rows: for the velocity solver.
      lever: (turn, 1, column, world) time [s] that the contact's impulse has to act on the position.
      directions: row directions in the world frame, components (turn * column, world); none where the matrix of the rows
        keeps them, with the sign of the only side that moves.
      separation: (turn, 1, column, world) at the start of the step.
      slop: (turn, 1, column, world) penetration left alone, for good or till the next step.
      size: (turn, 1, column, world) inner radius of the smaller moving body.
      falling: (turn, row, column, world) change of each row's velocity by gravity during the lever; None where no rebounds
        need a limit.
      sign: (turn, 1, world) of the directions that the matrix keeps; None where it is +.
      load: what becomes of the lever where a rebound also carries others; None where nothing bounces.
      ahead: (turn, 1, column, world) lowest separation at the end of the step if nothing held the bodies; None where places
        are not given by it (`touching`).
    """

    rows: Rows
    lever: Array
    directions: tuple[Vec3, ...]
    separation: Array
    slop: Array
    size: Array
    falling: Array | None = None
    sign: Array | None = None
    load: Load | None = None
    ahead: Array | None = None


class PlacedPairs(NamedTuple):
    """Pairs in the places of a traced table, components of shape (turn, constraint, world).

    Attributes:
      places: their velocity blocks.
      bodies: bodies A and B; any body where the place is empty.
      sign: of the row directions, where one side alone moves: + if that is B; None where both sides move.
    """

    places: Places
    bodies: tuple[Array, Array]
    sign: Array | None


def contact_tables(scene: Scene) -> tuple[Table, ...]:
    """Order in which the solver visits the contact slots."""
    block_of = {body: block for block, body in enumerate(scene.dynamic_bodies)}
    constraints, slot = [], 0
    for group in scene.pair_groups:
        for a, b in zip(group.bodies_a, group.bodies_b, strict=True):
            blocks = tuple(block_of[body] for body in (a, b) if body in block_of)
            constraints.append(Constraint(blocks, tuple(range(slot, slot + group.point_count))))
            slot += group.point_count
    return make_tables(constraints, len(block_of), together=True)


def couples_rotation(scene: Scene) -> bool:
    """Whether any row exerts a torque: not if the scene has only frictionless contacts between spheres and planes."""
    groups = (*scene.pair_groups, *scene.compact_groups)
    kinds = {kind for group in groups for kind in (group.kind_a, group.kind_b)}
    return scene.friction or bool(scene.joints) or not kinds <= {"plane", "sphere"}


def pack_motion(scene: Scene, linear: Vec3, angular: Vec3) -> Array:
    """(component, block, world) motion of the moving bodies, without rotation where nothing couples to it."""
    return pack_blocks(linear, angular if couples_rotation(scene) else None)


def near_contacts(scene: Scene, model: Model, contacts: ContactSet) -> ContactSet:
    """The contacts without those so far ahead that they are left to the search along the motion (`SPECULATIVE`)."""
    reach = SPECULATIVE * smaller_moving(model, *scene.slot_bodies)
    near = settle(jnp.where(contacts.separation <= reach, 1.0, 0.0)) > 0.5
    return contacts._replace(active=contacts.active & near)


def contact_rows(
    scene: Scene,
    table: Table | TracedTable,
    model: Model,
    contacts: ContactSet,
    motion: Motion,
    pairs: PlacedPairs | None = None,
) -> ContactRows:
    """Rows of the contacts in one table; `pairs` are those of a traced table."""
    places = None if pairs is None else pairs.places
    chosen: ContactSet = select(table, contacts)
    worlds = max(chosen.separation.shape[-1], motion.velocity.shape[-1], motion.free_velocity.shape[-1])
    normal = chosen.normal
    directions = (normal, *tangent_basis(normal)) if scene.friction else (normal,)
    points, beyond = _points(scene, table, chosen, directions, motion, pairs, worlds)
    # Points are less to read, which pays where sweeps go through lists; where pairs have turns of their own, sweeps have
    # fewer kernels with all entries. The other solvers need those.
    room = contact_places(scene)
    listed = pairs is not None or (room is not None and room.for_all)
    matrix = points.stored() if listed and scene.options.solver == "pgs" else points.dense()
    start, free = (
        _rates(table, matrix, places, velocity, chosen) for velocity in (motion.velocity, motion.free_velocity)
    )
    turns = None
    if beyond is not None:
        spins, free_spins = (velocity.at[:3].set(0.0) for velocity in (motion.velocity, motion.free_velocity))
        turns = Turns(
            _rates(table, matrix, places, spins, chosen), _rates(table, matrix, places, free_spins, chosen), beyond
        )
    further = unreached(chosen.separation, start, free, turns, chosen.apart, model.dt)
    chosen = chosen._replace(separation=chosen.separation + further)
    restitution = pair_restitution(scene, table, model, pairs) if scene.restitution else None
    approach = Approach(chosen.separation, start, free, restitution, motion.gravity)
    admitted, stopped = None, None
    if scene.options.solver == "soft_step":
        target, lever = rebound(approach, model.dt, model.dt * (1.0 + 1.0 / scene.options.substep_count))
    else:
        admitted = let_in(approach, jnp.minimum(*_of_bodies(scene, table, pairs, model.size)), model.dt)
        stopped = stop(approach, admitted, model.dt)
        target, lever = impact(approach, stopped, model.dt)
    active = compute_once(pack_scalars(table, [chosen.active.astype(normal.x.dtype)], worlds)[:, 0], normal.x)
    # Empty columns of a table have no response.
    entries = step_length(scene, matrix).entries()
    size = pack_scalars(table, [smaller_side(table, take(model.size, scene.dynamic_bodies), places)], worlds)
    slop = scene.options.slop * size
    meets = active
    if scene.options.solver != "soft_step":  # of which the lengths of steps are a part
        lowest = pack_scalars(table, [_lowest(approach, model.dt)], worlds)[:, 0] - slop[:, 0]
        meets = meeting(table.together, active, lowest)
    mass = safe_divide(active, normal_bound(entries, table.together, active, meets))
    bias = [-target]
    if scene.friction:
        law = Cone(
            normal_mass=mass,
            tangent_mass=safe_divide(active, tangent_bound(entries, table.together, active, meets)),
            friction=pack_scalars(table, [_pair_friction(scene, table, model, pairs)], worlds)[:, 0],
            meets=meets,
            first_grip=_first_grip(table, approach, meets, model.dt) if scene.options.solver == "pgs" else None,
        )
        if scene.options.solver == "pgs" and couples_rotation(scene):
            slip = lax.stop_gradient(matrix_velocity(table, matrix.other_rows(), places, motion.free_velocity))
            halted = pack_scalars(table, [jnp.maximum(target - free, 0.0)], worlds)[:, 0]
            factor = sliding_step(entries, table.together, meets, law, lax.stop_gradient(halted), slip)
            law = dataclasses.replace(law, normal_mass=law.normal_mass * factor)
        bias += [jnp.zeros(()), jnp.zeros(())]
    else:
        law = push_only(mass[:, None])
    rows = Rows(
        matrix=matrix,
        bias=pack_scalars(table, bias, worlds),
        law=law,
        table=table,
        places=places,
    )
    separation = jnp.where(chosen.active, chosen.separation, 0.0)
    falling, load = None, None
    if scene.restitution and stopped is not None:
        of_load = (*loaded(approach, target, lever, model.dt), -stopped.target, stopped.lever)
        asked, lasting, still, resting = (pack_scalars(table, [x], worlds) for x in of_load)
        load = Load(asked * _rebounding_mass(table, rows, motion, worlds), lasting, still, resting)
    if scene.rebounds_may_gain:
        side = sum(_signs(scene, table, pairs))  # 0 for two moving bodies, which fall together
        falling = pack_scalars(table, [side * dot(along, motion.gravity) * lever for along in directions], worlds)
    ahead = None
    if room is not None and listed:
        ahead = pack_scalars(table, [chosen.separation + model.dt * jnp.minimum(start, free)], worlds)
    return ContactRows(
        rows,
        pack_scalars(table, [lever], worlds),
        directions,
        pack_scalars(table, [separation], worlds),
        slop if admitted is None else slop + pack_scalars(table, [admitted], worlds),
        size,
        falling,
        load=load,
        ahead=ahead,
    )


def _rebounding_mass(table: Table | TracedTable, rows: Rows, motion: Motion, worlds: int) -> Array:
    """(turn, 1, column, world) mass that rebounds at each contact, where links rebound with their whole mechanisms."""
    mass = normal_mass(rows)
    if motion.mass_together is None:
        return mass
    sides = range(len(rows.places.blocks if rows.places is not None else table.blocks))  # type: ignore[union-attr]

    def of_pairs(lightness: Array) -> Array:
        return functools.reduce(jnp.add, [select_blocks(table, side, lightness, rows.places) for side in sides])

    share = of_pairs(motion.inertia.inverse_mass) / of_pairs(1.0 / motion.mass_together)
    return mass * pack_scalars(table, [share], worlds)


def _rates(table: Table | TracedTable, matrix: Any, places: Places | None, velocity: Array, like: ContactSet) -> Array:
    """Normal velocities (column, world).

    Stored for reverse mode: else their cotangents are computed again for each entry of the Jacobians.
    """
    along = matrix_velocity(table, matrix.first_row(), places, velocity)
    return compute_once(along.reshape(-1, along.shape[-1]), like.separation)


def _first_grip(table: Table | TracedTable, approach: Approach, meets: Array, dt: Array) -> Array | None:
    """`first_grip` of the contacts whose points approach or part by no more than gravity does in a step."""
    slow = jnp.where(jnp.abs(approach.start) <= norm(approach.gravity) * dt, 1.0, 0.0).astype(meets.dtype)
    return first_grip(table.together, meets, pack_scalars(table, [slow], meets.shape[-1])[:, 0])


def _lowest(approach: Approach, dt: Array) -> Array:
    """Lowest separation in a step if nothing held the bodies, less twice the way of gravity: what rests may push on.

    Bodies that fall together do not approach each other, whatever holds the lower one.
    """
    speed = jnp.minimum(jnp.minimum(approach.start, approach.free), 0.0)
    return approach.separation + dt * (speed - 2.0 * dt * norm(approach.gravity))


def _points(
    scene: Scene,
    table: Table | TracedTable,
    contacts: ContactSet,
    directions: Sequence[Vec3],
    motion: Motion,
    pairs: PlacedPairs | None,
    worlds: int,
) -> tuple[Points, Array | None]:
    """Jacobian and response of the contacts of one table, which are in its order.

    Also by how much each contact (column, world) comes closer if its bodies turn about their centres so that its points
    lie farthest towards each other.
    """
    places = None if pairs is None else pairs.places
    signs = _signs(scene, table, pairs)
    along = [direction * signs[0] for direction in directions] if len(signs) == 1 else directions
    packed = pack_directions(table, along, worlds)
    angular, inertias, beyond = [], [], []
    for side, sign in enumerate(signs):
        position, inertia = select_blocks(table, side, (motion.position, motion.inertia), places)
        entries = [_of_constraints(table, entry, worlds) for entry in jax.tree.leaves(inertia)]
        inertias.append(jnp.stack(entries, axis=1))
        if not couples_rotation(scene):
            continue
        # Where there still is a gap, the arm ends on the body's own surface, as it will when the gap has closed.
        surface = contacts.position + contacts.normal * (jnp.maximum(contacts.separation, 0.0) * (0.5 * sign))
        arm = compute_once(surface - position, contacts.separation)
        angular.append(turn_of_points(table, packed, arm if side == len(signs) - 1 else -arm, worlds))
        if not lone_spheres(scene):
            beyond.append(norm(arm) + dot(arm, contacts.normal) * sign)
    points = Points(jnp.concatenate([packed, *angular], axis=2), tuple(inertias))
    return points, functools.reduce(jnp.add, beyond) if beyond else None


def _of_constraints(table: Table | TracedTable, values: Array, worlds: int) -> Array:
    """(turn, constraint, world) from the same value (turn * column, world) in all columns of a constraint."""
    values = jnp.broadcast_to(values, (table.turn_count * table.column_count, worlds))
    return values.reshape(table.turn_count, -1, table.together, worlds)[:, :, 0]


def rows_one_by_one(
    scene: Scene,
    table: TracedTable,
    model: Model,
    contacts: Callable[[tuple], ContactSet],
    shapes: tuple,
    motion: Motion,
    pairs: PlacedPairs,
) -> tuple[ContactSet, ContactRows]:
    """Contacts and their rows of a table with one pair a turn, 0 in the turns that hold none.

    `contacts` finds those of some places from `shapes`, a pytree of arrays (place, world).
    """
    blocks, turns = pairs.places.blocks, pairs.places.turns
    assert turns is not None

    def rows(of_turns: tuple[Any, tuple[Array, ...], PlacedPairs]) -> tuple[ContactSet, ContactRows]:
        shapes, blocks, pairs = of_turns
        chosen = stored(contacts(shapes), motion.velocity)
        part = dataclasses.replace(table, turn_count=blocks[0].shape[0], first_slot=0)
        found = contact_rows(scene, part, model, chosen, motion, pairs._replace(places=Places(blocks, None)))
        found = found._replace(rows=dataclasses.replace(found.rows, places=None))
        return chosen, found._replace(directions=()) if isinstance(found.rows.matrix, Points) else found

    chosen, found = map_filled(rows, (shapes, blocks, pairs._replace(places=None)), turns)
    return chosen, found._replace(
        rows=dataclasses.replace(found.rows, table=table, places=pairs.places), sign=pairs.sign
    )


def push_only(effective_mass: Array) -> Push:
    """The law of contacts without friction, from effective masses (turn, 1, column, world)."""
    zero = jnp.zeros((1,) * effective_mass.ndim, effective_mass.dtype)
    shape = (effective_mass.shape[0], 1, 1, 1)
    return Push(
        effective_mass,
        jnp.broadcast_to(zero, shape),
        jnp.broadcast_to(zero, shape),
        jnp.broadcast_to(zero + jnp.inf, shape),
    )


def _slot_bodies(scene: Scene, table: Table) -> tuple[np.ndarray, np.ndarray]:
    slots = np.maximum(table.order, 0)
    return tuple(np.asarray(side, np.int32)[slots] for side in scene.slot_bodies)  # type: ignore[return-value]


def _of_bodies(scene: Scene, table: Table | TracedTable, pairs: PlacedPairs | None, values: Array) -> list[Array]:
    """Values (body, world) of bodies A and B of each column."""
    if isinstance(table, TracedTable):
        assert pairs is not None
        return [gather_columns(table, bodies, values) for bodies in pairs.bodies]
    return [take(values, bodies) for bodies in _slot_bodies(scene, table)]


def _signs(scene: Scene, table: Table | TracedTable, pairs: PlacedPairs | None) -> Sequence[np.ndarray | float | Array]:
    """Sign of the row directions on each side: + on body B, - on body A."""
    if isinstance(table, TracedTable):
        assert pairs is not None
        if pairs.sign is None:
            return [-1.0, 1.0]
        return [jnp.repeat(pairs.sign.reshape(-1, pairs.sign.shape[-1]), table.together, axis=0)]
    if len(table.blocks) == 2:
        return [-1.0, 1.0]
    is_static = np.asarray(scene.static)
    signs = np.where(is_static[_slot_bodies(scene, table)[1]], -1.0, 1.0)
    return [float(signs[0])] if (signs == signs[0]).all() else [signs[:, None]]


def _pair_friction(scene: Scene, table: Table | TracedTable, model: Model, pairs: PlacedPairs | None) -> Array:
    """Geometric mean (guide 8.4); derivative 0 where either coefficient is 0."""
    a, b = _of_bodies(scene, table, pairs, model.friction)
    return safe_sqrt(a * b)


def pair_restitution(scene: Scene, table: Table | TracedTable, model: Model, pairs: PlacedPairs | None) -> Array:
    """Smaller of the two coefficients (guide 8.2), (turn * column, world)."""
    a, b = _of_bodies(scene, table, pairs, model.restitution)
    return jnp.minimum(a, b)


def normal_mass(rows: Rows) -> Array:
    """(turn, 1, column, world) effective mass of each contact along its normal; 0 where there is none."""
    return rows.law.normal_mass[:, None] if isinstance(rows.law, Cone) else rows.law.effective_mass


def position_rows(contact: ContactRows, displacement: Array, percent: float) -> Rows:
    """Normal rows that move the bodies out of what remains of the overlap after the step (guide 10.2).

    Args:
      contact: rows of one table.
      displacement: (component, block, world) of the moving bodies in this step.
      percent: share of the overlap beyond the slop that is corrected.
    """
    rows, first = contact.rows, FirstRow(contact.rows.matrix)

    def bias(part: Rows, levels: tuple[Array, Array, Array]) -> Array:
        separation, slop, size = levels
        # The change is of first order in the turn. For a body that turns by a radian and more it says little, and never
        # that the overlap went beyond the body's middle.
        change = store_cotangents(row_velocity(part, displacement))
        error = jnp.maximum(separation + change, jnp.minimum(separation, -size)) + slop
        return jnp.where(error < 0, percent * error, error)

    firsts = dataclasses.replace(rows, matrix=first, law=push_only(normal_mass(rows)))
    levels = (contact.separation, contact.slop, contact.size)
    return dataclasses.replace(firsts, bias=map_turns(bias, firsts, levels))
