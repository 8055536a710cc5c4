"""Collisions: which contacts will meet at speed within a step, and what happens when they do.

Bodies that meet exchange impulses in rounds: in each, the contacts that approach, and only those, are solved together
with Newton's restitution and Coulomb's friction; those that approach after it have the next round. So the points of a
face that lands are symmetric, and a cradle passes its velocity on from ball to ball. Every round keeps the momenta, and
elastic ones without friction the energy (B. Smith, D. Kaufman, E. Vouga, R. Tamstorf, E. Grinspun, "Reflections on
Simultaneous Impact", ACM Trans. Graph. 31(4), 2012: generalized reflections).
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import Bodies, Inertia, moving_inertia, smaller_moving, unpack_blocks
from mathota_jax.collision.narrowphase import SPECULATIVE, ContactSet, find_contacts
from mathota_jax.collision.rest import TOUCHING, meet, next_touch, rest_speed
from mathota_jax.constraints import contact, joint
from mathota_jax.constraints.assembly import collect, pack_scalars, select
from mathota_jax.constraints.contact import ContactRows
from mathota_jax.constraints.contact_force import slot_force
from mathota_jax.constraints.joint_layout import joint_row_count, joint_tables, solves_together
from mathota_jax.constraints.joint_rows import JointRows, joint_rows
from mathota_jax.constraints.problem import Problem
from mathota_jax.constraints.rebound_limit import share_without_gain
from mathota_jax.constraints.row_coefficients import row_coefficients
from mathota_jax.constraints.swept import Way, largest_turn, may_strike, misses, ways
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.solver import converged, pgs
from mathota_jax.solver.laws import Bounded, Cone
from mathota_jax.solver.row_matrix import Dense
from mathota_jax.solver.rows import (
    Rows,
    add_impulses,
    first_row_velocity,
    matrix_velocity,
    row_velocity,
    with_first_bias,
)
from mathota_jax.solver.table import TracedTable
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once, settle
from mathota_jax.spatial.spread import add_all_slices
from mathota_jax.spatial.vector import Vec3, cross, dot, norm

ROUNDS = 16
"""Largest number of rounds; what still approaches then is stopped by the contacts of the next step."""

Impulses = tuple[Array, ...]


class Foreseen(NamedTuple):
    """What contacts of one group will do until the end of a step if nothing stops them, (turn, 1, column, world).

    Attributes:
      apart: what a step that is split leaves to the search, since it meets at speed or is apart.
      clear: what no contact row should touch: it parts at speed and does not meet again, or flies past.
      leaves: what touches and leaves, for good or to meet again.
      target, lever: for those that leave, the velocity to reach in the end [m/s] and the lever of the impulse [s].
    """

    apart: Array
    clear: Array
    leaves: Array
    target: Array
    lever: Array


def foreseen(
    model: Model, problem: Problem, bodies: Bodies, now: Array, then: Array, gravity: Vec3, left: Array
) -> tuple[tuple[Foreseen, ...], Array]:
    """What the contacts will do within the time `left` if nothing stops them.

    Args:
      model: parameters, `dt` being the whole time step, and static scene.
      problem: of the time that is left.
      bodies: all of them.
      now, then: (component, block, world) velocities now and after that time without constraints.
      gravity: components (1, world).
      left: (world,) time [s].

    Returns:
      For each group of contact rows; and (world,) whether any contact that bounces meets at speed.
    """
    found, worlds = [], now.shape[-1]
    bounces = jnp.zeros(worlds, bool)
    pull, left = norm(gravity), left[None]
    exact = (model, problem.contact_rows, now, then, left)
    fixed = lax.stop_gradient((model, problem.contact_rows, bodies, now, then, pull, left))
    model, groups, bodies, now, then, pull, left = fixed
    way = ways(model.scene, bodies, now, then, left)
    past = misses(model, way)
    bounces = bounces | _turn_into_each_other(model, bodies, way, then, left, problem.contacts)
    for group, exact_group in zip(groups, exact[1], strict=True):
        rows = group.rows
        if isinstance(rows.table, TracedTable):
            none = jnp.zeros((*rows.bias.shape[:1], 1, *rows.bias.shape[2:]), bool)
            found.append(Foreseen(none, none, none, group.lever, group.lever))
            continue

        start, free = (first_row_velocity(rows, v) for v in (now, then))
        e = _restitution(model, rows, worlds)
        # One of two bodies that fall may be held: to foresee too much costs a search, too little a contact.
        gap, acceleration = jnp.maximum(group.separation, 0.0), jnp.minimum((free - start) / left, -pull)
        time, speed = next_touch(gap, start, acceleration)
        rests = rest_speed(pull, model.dt, group.size, _speeds(rows, now))
        fast = (jnp.where(e > 0, e, 1.0) * speed > rests) & (contact.normal_mass(rows) > 0)
        reaches = time <= left
        # The search follows what is apart; its rows, which extrapolate along one normal, could only disturb it.
        followed = ~reaches & (group.separation > TOUCHING * group.size)
        meets = settle(jnp.where(fast & reaches, 1.0, 0.0)) > 0.5
        followed = settle(jnp.where(followed, 1.0, 0.0)) > 0.5
        clear = fast & (start > 0) & (time > left)
        if past is not None:
            flies_past = pack_scalars(rows.table, [select(rows.table, past.astype(now.dtype))], worlds) > 0.5
            clear = clear | (flies_past & (group.separation > SPECULATIVE * group.size))
        clear = settle(jnp.where(clear, 1.0, 0.0)) > 0.5
        found.append(Foreseen(meets | followed, clear, *_leave(exact[0], exact_group, *exact[2:], fast)))
        bounces = bounces | (meets & (e > 0)).any((0, 1, 2))
    return tuple(found), bounces


def _turn_into_each_other(
    model: Model, bodies: Bodies, way: Way, then: Array, left: Array, contacts: ContactSet | None
) -> Array:
    """(world,) whether any that bounce may meet where they have no contact yet, since they turn; arguments as above."""
    _, spins = unpack_blocks(then)
    if spins is None or contacts is None:
        return jnp.zeros(then.shape[-1], bool)
    pairs = [(a, b) for group in model.scene.pair_groups for a, b in zip(group.bodies_a, group.bodies_b, strict=True)]
    bounce = jnp.minimum(*(take(model.restitution, side) for side in zip(*pairs, strict=True))) > 0
    turn = largest_turn(model.scene, bodies, spins, left)
    return (bounce & may_strike(model, way, turn, contacts)).any(0)


def _leave(
    model: Model, group: ContactRows, now: Array, then: Array, left: Array, fast: Array
) -> tuple[Array, Array, Array]:
    """Which contacts touch and leave, the velocity to reach, and the lever of the impulse.

    Those that do not come back are stopped by nothing, unless something presses them back: no further than to where they
    touched. Those that do rebound once more if they come back at speed and are in flight at the end. Else they end where
    they touched: their own impacts are over by then, or too many to follow.
    """
    start, free = (first_row_velocity(group.rows, v) for v in (now, then))
    acceleration = (free - start) / left
    leaves = (group.separation <= 0) & (start > 0)
    comes_back = leaves & (start + free < 0)
    time = jnp.where(comes_back, -2.0 * start / jnp.where(comes_back, acceleration, 1.0), 0.0)
    velocity = _restitution(model, group.rows, now.shape[-1]) * start + acceleration * (left - time)
    rebounds = comes_back & fast & (velocity > 0)
    chosen = settle(jnp.where(leaves, 1.0, 0.0) + jnp.where(comes_back, 1.0, 0.0) + jnp.where(rebounds, 1.0, 0.0))
    target = jnp.where(chosen > 2.5, velocity, jnp.where(chosen > 1.5, 0.0, -start))
    stopped = 0.5 * left * (1.0 + start / jnp.where(comes_back, free, -1.0))
    lever = jnp.where(chosen > 2.5, left - time, jnp.where(chosen > 1.5, stopped, 0.5 * left))
    return chosen > 0.5, target, lever


def corrected(group: ContactRows, found: Foreseen, split: Array) -> tuple[ContactRows, Array]:
    """Rows of the contacts that count in this part of a step, and which do not; `split` (world,) if an impact ends it."""
    dropped = (found.apart & split) | found.clear
    leaves = found.leaves & ~split
    first = jnp.where(leaves, -found.target, group.rows.bias[:, :1])
    rows = with_first_bias(group.rows, first)
    lever = jnp.where(leaves, found.lever, group.lever)
    falling = group.falling
    if falling is not None:
        falling = falling * safe_divide(lever, group.lever)
    return group._replace(rows=without(rows, dropped), lever=lever, falling=falling), dropped


def _restitution(model: Model, rows: Rows, worlds: int) -> Array:
    """(turn, 1, column, world) of contacts that have slots of their own."""
    return pack_scalars(rows.table, [contact.pair_restitution(model.scene, rows.table, model, None)], worlds)


def _speeds(rows: Rows, velocity: Array) -> Array:
    """(turn, 1, column, world) sum of the speeds of both bodies along the normal of each contact, or more."""
    sides = Dense(tuple(jnp.abs(side) for side in rows.jacobian), ())
    return matrix_velocity(rows.table, sides.first_row(), rows.places, jnp.abs(velocity))


def without(rows: Rows, dropped: Array) -> Rows:
    """The rows of contacts without those `dropped` (turn, 1, column, world)."""
    law = rows.law
    if isinstance(law, Cone):
        keep = jnp.where(dropped, 0.0, 1.0)[:, 0]
        law = dataclasses.replace(law, normal_mass=law.normal_mass * keep, tangent_mass=law.tangent_mass * keep)
    else:
        law = dataclasses.replace(law, effective_mass=law.effective_mass * jnp.where(dropped, 0.0, 1.0))
    return dataclasses.replace(rows, law=law)


class Collision(NamedTuple):
    """What a collision does.

    Attributes:
      moved: the moving bodies with their velocities after it.
      forces: the impulses as mean forces over the whole step: those on the contact slots (slot, 3, world), then those of the
        joint rows (slot, world) if there are joints.
      failed: 1 for each world (world,) that was not solved; None from sweeps.
    """

    moved: Bodies
    forces: list[Array]
    failed: Array | None


def collide(model: Model, bodies: Bodies, blocks: Bodies, chosen: Array, gravity: Vec3) -> Collision:
    """What approaches where it touches collides.

    Args:
      model: parameters, `dt` being the whole time step, and static scene.
      bodies, blocks: all bodies and the moving ones, where they meet, with their velocities before.
      chosen: (world,) worlds in which there is a collision.
      gravity: components (1, world).
    """
    scene = model.scene
    pull = norm(gravity)
    contacts = find_contacts(scene, model.shapes, bodies.position, bodies.orientation)
    active = contacts.active & chosen & _touch(model, bodies, contacts, pull)
    contacts = compute_once(contacts._replace(active=active), bodies.position.x)
    inertia = moving_inertia(scene, model, blocks.orientation)
    end, held, groups = _rounds(model, bodies, blocks, inertia, contacts, gravity)
    velocity, impulses, failed = end
    linear, angular = unpack_blocks(velocity)
    moved = blocks._replace(velocity=linear)
    if angular is not None:
        moved = moved._replace(angular_velocity=angular)
    forces = [slot_force(groups, list(impulses[len(held) :]), scene.slot_count, model.dt)]
    if held:
        values = [impulse[:, 0] / model.dt for impulse in impulses[: len(held)]]
        forces.append(collect([rows.table for rows in held], values, joint_row_count(scene)))
    return Collision(moved, forces, failed)


def nothing(scene: Scene, moved: Bodies, like: list[Array]) -> Collision:
    """Where nothing collides; `like` is as the forces."""
    failed = jnp.zeros_like(moved.position.x[0]) if solves_together(scene) else None
    return Collision(moved, [jnp.zeros_like(force) for force in like], failed)


class _Round(NamedTuple):
    """Velocities (component, block, world) after a round, the impulses so far, and `Collision.failed`."""

    velocity: Array
    impulses: Impulses
    failed: Array | None


def _rounds(
    model: Model, bodies: Bodies, blocks: Bodies, inertia: Inertia, contacts: ContactSet, gravity: Vec3
) -> tuple[_Round, tuple[Rows, ...], list[ContactRows]]:
    """The end of all rounds, and the rows of joints and contacts."""
    scene = model.scene
    pull = norm(gravity)
    before = contact.pack_motion(scene, blocks.velocity, blocks.angular_velocity)
    inverse = compute_once(inertia.inverse(), before)
    motion = contact.Motion(blocks.position, before, before, inverse, gravity)
    groups = [contact.contact_rows(scene, table, model, contacts, motion) for table in contact.contact_tables(scene)]
    held = _joint_rows(model, joint_rows(model, bodies), inertia) if joint_row_count(scene) else ()
    fast = [_approach(group.rows, before) for group in groups]
    worlds = before.shape[-1]
    fastest = jnp.zeros((1, worlds), before.dtype)
    for speed in fast:
        fastest = jnp.maximum(fastest, speed.max((0, 1, 2)))
    # What the solver leaves of the first approach is no second one.
    least = lax.stop_gradient(float(jnp.finfo(before.dtype).eps) ** 0.5 * fastest)
    bounce = [_restitution(model, group.rows, worlds) for group in groups]
    iterations = 4 * scene.options.velocity_iterations

    def solve(last: _Round) -> _Round:
        velocity = last.velocity
        rows = [_keeping_rates(row, velocity) for row in held]
        rebounds = [jnp.zeros_like(row.bias) for row in rows]
        for group, e in zip(groups, bounce, strict=True):
            speed = first_row_velocity(group.rows, velocity)
            rebound = jnp.where(_leaves(model, group, pull, e, speed, velocity), e * speed, 0.0)
            # What does not bounce at all just holds: a ball rebounds from a plate that lies on the ground.
            chosen = without(group.rows, (_approach(group.rows, velocity) <= least) & (e > 0))
            zero = jnp.zeros_like(chosen.bias)
            rebounds.append(jnp.concatenate([rebound, zero[:, 1:]], axis=1))
            rows.append(dataclasses.replace(chosen, bias=zero))
        start = tuple(jnp.zeros_like(part) for part in last.impulses)
        gradient = pgs.gradient_sweeps(tuple(rows), iterations, scene.options.gradient_iterations)

        def with_restitution(share: Array | float) -> tuple[Impulses, Array | None]:
            biased = tuple(
                dataclasses.replace(row, bias=row.bias + share * rebound)
                for row, rebound in zip(rows, rebounds, strict=True)
            )
            if solves_together(scene):
                return converged.solve(biased, velocity, start)[1:]
            return pgs.solve(iterations, gradient, False, biased, velocity, start, jnp.zeros_like(velocity))[1], None

        if scene.friction:
            both, failed = lax.map(with_restitution, jnp.array([0.0, 1.0], velocity.dtype))
            stopping, full = (tuple(part[k] for part in both) for k in range(2))
            impulses = _without_gain(tuple(rows), velocity, stopping, full)
            failed = None if failed is None else failed.max(0)
        else:
            impulses, failed = with_restitution(1.0)
        velocity = add_impulses(tuple(rows), velocity, impulses)
        if last.failed is not None and failed is not None:
            failed = jnp.maximum(last.failed, failed)
        return _Round(velocity, tuple(a + b for a, b in zip(last.impulses, impulses, strict=True)), failed)

    def approaches(velocity: Array) -> Array:
        going = jnp.asarray(False)
        for group in groups:
            going = going | (_approach(group.rows, lax.stop_gradient(velocity)) > least).any()
        return going

    def one_round(last: _Round, _: None) -> tuple[_Round, None]:
        return lax.cond(approaches(last.velocity), solve, lambda last: last, last), None

    everything = (*held, *(group.rows for group in groups))
    start = tuple(jnp.zeros((*rows.bias.shape[:-1], worlds), before.dtype) for rows in everything)
    begin = _Round(before, start, jnp.zeros(worlds, before.dtype) if solves_together(scene) else None)
    return lax.scan(one_round, begin, None, length=ROUNDS)[0], held, groups


def _without_gain(rows: tuple[Rows, ...], velocity: Array, stopping: Impulses, full: Impulses) -> Impulses:
    """As much of the restitution as gains no energy.

    With friction Newton's restitution can (T. R. Kane, D. A. Levinson, "Dynamics: Theory and Applications", 1985); an
    impact without it never does, and between the two sets of impulses the energy is a parabola.
    """
    difference = tuple(b - a for a, b in zip(stopping, full, strict=True))
    stopped = add_impulses(rows, velocity, stopping)
    at_end = add_impulses(rows, velocity, full)
    zero = jnp.zeros(velocity.shape[-1], velocity.dtype)
    lost, slope, bend = zero, zero, zero
    for group, first, more in zip(rows, stopping, difference, strict=True):
        before, middle, after = (row_velocity(group, v) for v in (velocity, stopped, at_end))
        lost = lost - add_all_slices(0.5 * first * (before + middle))
        slope = slope + add_all_slices(more * middle)
        bend = bend + add_all_slices(more * (after - middle))
    gains = settle(jnp.where(slope + 0.5 * bend > lost, 1.0, 0.0)) > 0.5
    share = share_without_gain(gains, lost, slope, bend)
    return tuple(first + share * more for first, more in zip(stopping, difference, strict=True))


def _approach(rows: Rows, velocity: Array) -> Array:
    """(turn, 1, column, world) speed at which each contact approaches; 0 where there is none."""
    speed = -first_row_velocity(rows, velocity)
    return jnp.where(contact.normal_mass(rows) > 0, jnp.maximum(speed, 0.0), 0.0)


def _leaves(model: Model, group: ContactRows, pull: Array, e: Array, speed: Array, velocity: Array) -> Array:
    """Whether the bodies of a contact leave each other after the impact, or rest."""
    rests = rest_speed(pull, model.dt, group.size, _speeds(group.rows, velocity))
    return settle(jnp.where(-e * speed > rests, 1.0, 0.0)) > 0.5


def _touch(model: Model, bodies: Bodies, contacts: ContactSet, pull: Array) -> Array:
    """(slot, world) whether the contact passes on an impulse: it meets now, or it touches and rests.

    One that is about to meet, a moment later, has its own impact.
    """
    scene = model.scene
    sides = scene.slot_bodies
    velocities = []
    for side in sides:
        body: Bodies = take(bodies, np.asarray(side))
        moves = 1.0 - np.asarray([float(scene.static[b]) for b in side])[:, None]
        turned = cross(body.angular_velocity, contacts.position - body.position)
        velocities.append((body.velocity + turned) * moves.astype(contacts.separation.dtype))
    speed = jnp.abs(dot(contacts.normal, velocities[1] - velocities[0]))
    scale = norm(velocities[0]) + norm(velocities[1])
    size = smaller_moving(model, *sides)
    rests = speed <= rest_speed(pull, model.dt, size, scale)
    gap = contacts.separation
    return settle(jnp.where(meet(gap, size) | (rests & (gap <= TOUCHING * size)), 1.0, 0.0)) > 0.5


def _joint_rows(model: Model, joints: JointRows, inertia: Inertia) -> tuple[Rows, ...]:
    """Rows of the joints during a collision."""
    scene = model.scene
    # Motors keep the rates that they have: what is told to them means nothing here.
    no_action = jnp.zeros((len(scene.motors), 1), joints.error.dtype)
    coefficients = row_coefficients(model, no_action, joints)
    return tuple(joint.collision_rows(scene, table, joints, coefficients, inertia) for table in joint_tables(scene))


def _keeping_rates(rows: Rows, velocity: Array) -> Rows:
    """Rows of joints that keep the rates they have, or whose rotors do; stops, which only push, let none pass."""
    assert isinstance(rows.law, Bounded)
    return dataclasses.replace(rows, bias=jnp.where(rows.law.lower < 0, -row_velocity(rows, velocity), 0.0))
