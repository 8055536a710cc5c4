"""The constraints of one step: what touches and what is joined, as rows for the solver."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.bodies import Bodies, Inertia, merge, moving, vector
from mathota_jax.collision.narrowphase import ContactSet, join_contacts
from mathota_jax.constraints import (
    compact,
    contact,
    decoupling,
    joint,
    joint_layout,
    joint_rows,
    mechanism,
    mechanism_contacts,
    mechanism_layout,
    mechanism_links,
    mechanism_rows,
    rebound_limit,
    row_coefficients,
    substep_rows,
    warm_start,
)
from mathota_jax.constraints.contact_force import warm_start_impulse
from mathota_jax.constraints.decoupling import Decoupling
from mathota_jax.constraints.ground import find_ground, has_seams, without_flush
from mathota_jax.constraints.slots import contact_offsets, matched_force, own_contacts
from mathota_jax.constraints.swept import largest_turn, undisturbed, ways
from mathota_jax.model import Model
from mathota_jax.solver.rows import Rows
from mathota_jax.solver.soft_laws import PositionError
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Vec3
from mathota_jax.state import State

LARGEST_GROWTH = 2.0
"""Of a substep over the last one, up to which it starts from the same forces; from those of a step far shorter, which may
be those of a push-out or a stop that is over, it starts with what they did in so much longer."""


class Forces(NamedTuple):
    """Mean forces of all constraints in a step, as in a `State`: (joint row, world) and (slot, 3, world)."""

    joint_force: Array
    contact_force: Array


class Problem(NamedTuple):
    """Constraints of one step: joints first, so that contacts, which must not be violated, have the last word.

    `held` are the mechanisms at the middle of the step, `responses` theirs to their rows with bounds; `errors` are those of
    all groups, for the small steps alone; `decouplings` are those of the joint rows, none where these are as they were;
    `offsets` are where contacts are matched by distance; `with_joints` are velocities (component, block, world) at the end
    of the step if mechanisms hold and nothing else does, where there are contacts beside them.
    """

    joints: joint_rows.JointRows | None
    held: mechanism_links.Links | None
    responses: mechanism_rows.Responses | None
    joint_rows: tuple[Rows, ...]
    contacts: ContactSet | None
    contact_rows: list[contact.ContactRows]
    close: compact.ClosePairs | None
    errors: tuple[PositionError, ...] = ()
    decouplings: tuple[Decoupling, ...] = ()
    offsets: Vec3 | None = None
    reduced: mechanism_contacts.Reduced | None = None
    with_joints: Array | None = None

    @property
    def overflow(self) -> Array | None:
        """Worlds (world,) where contacts found no room; None where there is room for all."""
        found = [] if self.close is None else [self.close.overflow]
        if self.reduced is not None and self.reduced.touching is not None:
            found.append(self.reduced.touching.overflow)
        return functools.reduce(jnp.logical_or, found) if found else None

    @property
    def of_joint_rows(self) -> tuple[Decoupling | None, ...]:
        """Of each group of joint rows, how they were decoupled."""
        return self.decouplings or (None,) * len(self.joint_rows)

    @property
    def rows(self) -> tuple[Rows, ...]:
        return (*self.joint_rows, *(group.rows for group in self.contact_rows))

    def with_contacts(self, contact_rows: list[contact.ContactRows]) -> Problem:
        """The same with these, which differ in their biases alone."""
        reduced = None if self.reduced is None else self.reduced.with_biases([group.rows for group in contact_rows])
        return self._replace(contact_rows=contact_rows, reduced=reduced)


def constrain(
    model: Model,
    bodies: Bodies,
    blocks: Bodies,
    inertia: Inertia,
    free: tuple[Vec3, Vec3],
    halfway: Bodies | None,
    gravity: Vec3,
    action: Array,
) -> Problem:
    """Phases 2, 3 and 5: narrow phase and rows.

    Args:
      model: parameters and static scene.
      bodies, blocks: all bodies and the moving ones at the start of the step.
      inertia: with which the moving bodies respond to impulses.
      free: their velocities at the end of the step without constraints.
      halfway: the moving ones at the middle of the step without constraints, if they were followed that far.
      gravity: components (1, world).
      action: (motor, world).
    """
    scene = model.scene
    small_steps = mechanism_layout.takes_small_steps(scene)
    joints, held, responses, tables, errors = None, None, None, (), ()
    decouplings: tuple[Decoupling, ...] = ()
    if joint_layout.joint_row_count(scene):
        joints = joint_rows.joint_rows(model, bodies)
        there = joint_rows.moved_by(bodies, 0.5 * model.dt)
        if halfway is not None:
            there = merge(scene, bodies, halfway)
        middle = joint_rows.joint_rows(model, there)
        if mechanism_layout.layout(scene) is not None and not small_steps:
            held = mechanism_links.links(scene, middle, moving(scene, there).position, inertia)
        coefficients = row_coefficients.row_coefficients(model, action, joints)
        turning = joint_rows.turning(model, bodies, joints, middle)
        joint_motion = joint.JointMotion(joints, middle, coefficients, inertia, turning)
        order = joint_layout.joint_tables(scene)
        if decoupling.applies(scene):
            rows_of = substep_rows.joint_rows if small_steps else joint.decoupled_rows
            pairs = [rows_of(scene, table, model, joint_motion) for table in order]
            tables, decouplings = tuple(rows for rows, _ in pairs), tuple(how for _, how in pairs)
        else:
            tables = tuple(joint.velocity_rows(scene, table, model, joint_motion) for table in order)
        if held is not None and (bounded := mechanism_layout.bounded_slots(scene)):
            responses = mechanism_rows.responses(held, tables, bounded)
            joint_motion = joint_motion._replace(responses=responses)
            tables = tuple(joint.velocity_rows(scene, table, model, joint_motion) for table in order)
        if small_steps:
            errors = tuple(
                substep_rows.joint_error(scene, rows, model, joint_motion, how)
                for rows, how in zip(tables, decouplings, strict=True)
            )
    found = _Contacts(None, [], None, None, None)
    if scene.slot_count:
        found = _contacts(model, bodies, blocks, inertia, free, gravity, held, tables)
    if small_steps:
        errors += tuple(substep_rows.contact_error(scene, group, model) for group in found.rows)
    reduced = None
    if held is not None and mechanism_layout.takes_contacts(scene):
        reduced = mechanism_contacts.reduce(scene, held, inertia, tables, found.rows)
    return Problem(
        joints,
        held,
        responses,
        tables,
        found.contacts,
        found.rows,
        found.close,
        errors,
        decouplings,
        found.offsets,
        reduced,
        found.with_joints,
    )


class _Contacts(NamedTuple):
    """What touches, as in a `Problem`."""

    contacts: ContactSet | None
    rows: list[contact.ContactRows]
    close: compact.ClosePairs | None
    offsets: Vec3 | None
    with_joints: Array | None


def _contacts(
    model: Model,
    bodies: Bodies,
    blocks: Bodies,
    inertia: Inertia,
    free: tuple[Vec3, Vec3],
    gravity: Vec3,
    held: mechanism_links.Links | None,
    tables: Sequence[Rows],
) -> _Contacts:
    """Contacts and their rows; arguments as for `constrain`, mechanisms and the rows of the joints."""
    scene = model.scene
    found = own_contacts(model, bodies)
    close = None if scene.broadphase is None else compact.close_pairs(model, bodies, free)
    ground, with_static = None, {}
    if has_seams(scene):
        with_static = {} if close is None else compact.contacts_with_static(model, bodies, close)
        ground = find_ground(model, bodies, found[0] if found else None, close, with_static)
        found = [without_flush(model, bodies, ground, own) for own in found]
    if scene.options.continuous:
        found = [contact.near_contacts(scene, model, own) for own in found]
    now = contact.pack_motion(scene, blocks.velocity, blocks.angular_velocity)
    then, with_joints, together = contact.pack_motion(scene, *free), None, None
    if held is not None:
        # What presses a contact is what is left when the joints hold: a force beside a joint would turn its body.
        nothing = tuple(jnp.zeros_like(rows.bias) for rows in tables)
        then = with_joints = mechanism.hold(held, tables, then, nothing)[0]
        mass = jnp.broadcast_to(1.0 / inertia.inverse_mass, (len(scene.dynamic_bodies), inertia.inverse_mass.shape[-1]))
        together = mechanism.sum_by_mechanism(held.layout, mass)
    inverse = compute_once(inertia.inverse(), bodies.position.x)
    motion = contact.Motion(blocks.position, now, then, inverse, gravity, together)
    rows = []
    if scene.pair_groups:
        way, turn = ways(scene, bodies, now, then, model.dt), largest_turn(scene, bodies, free[1], model.dt)
        own = found[0]._replace(apart=undisturbed(model, way, turn, found[0]))
        rows = [contact.contact_rows(scene, table, model, own, motion) for table in contact.contact_tables(scene)]
    if close is not None:
        sets, more = compact.contacts_and_rows(model, bodies, close, motion, ground, with_static)
        found, rows = found + sets, rows + more
    if held is not None and scene.rebounds_may_gain:
        rows = rebound_limit.with_held_falling(held, rows, gravity)
    contacts = join_contacts(found)
    return _Contacts(contacts, rows, close, contact_offsets(model, bodies, contacts, close), with_joints)


def last_impulses(model: Model, state: State, problem: Problem) -> tuple[Array, ...]:
    """Impulses of the last step where rows and features are the same (guide 12.4); those of a small step."""
    if not model.scene.options.warm_start:
        return tuple(jnp.zeros_like(rows.bias) for rows in problem.rows)
    last = state if state.end_forces is None else state.end_forces
    force = None
    if problem.contacts is not None:
        force = matched_force(model.scene, problem.contacts, problem.offsets, problem.close, state, last.contact_force)
    return _impulses(model, problem, last.joint_force, force)


def starting_impulses(
    model: Model, state: State, problem: Problem, last: tuple[Array, ...], inertia: Inertia, velocity: Array
) -> tuple[tuple[Array, ...], Array | None]:
    """Impulses to start from, of those of the last step.

    Also what they do to the velocities (component, block, world), where that is known.
    """
    if not model.scene.options.warm_start:
        return last, jnp.zeros_like(velocity)
    if state.end_forces is not None:
        longer = substep_rows.substep_length(model) / state.end_forces.time
        share = lax.stop_gradient(jnp.minimum(LARGEST_GROWTH / longer, 1.0))
        return tuple(impulse * share for impulse in last), None
    if problem.contacts is None:
        return last, None
    return warm_start.plausible(problem.rows, inertia, velocity, last)


def known_impulses(model: Model, problem: Problem, solved: Forces) -> tuple[Array, ...]:
    """Impulses of this step, from its mean forces."""
    force = None if problem.contacts is None else vector(solved.contact_force)
    return _impulses(model, problem, solved.joint_force, force)


def _impulses(model: Model, problem: Problem, joint_force: Array, contact_force: Vec3 | None) -> tuple[Array, ...]:
    """Impulses (turn, row, column, world) of all groups from forces in the order of slots."""
    impulses = [
        joint.joint_impulse_start(rows.table, joint_force, model.dt, rows.bias.shape[-1], how)
        for rows, how in zip(problem.joint_rows, problem.of_joint_rows, strict=True)
    ]
    if contact_force is not None:
        impulses += [warm_start_impulse(group, contact_force, model.dt) for group in problem.contact_rows]
    return tuple(impulses)
