"""One step of the engine: the order of guide 11.1, a line a phase."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.batching import batch_last
from mathota_jax.bodies import (
    Bodies,
    Inertia,
    moving,
    moving_inertia,
    pack_blocks,
    unpack,
    vector,
)
from mathota_jax.collision.narrowphase import ContactSet, find_contacts, join_contacts
from mathota_jax.constraints import compact, contact, joint, warm_start
from mathota_jax.constraints.assembly import Side, collect
from mathota_jax.constraints.lever import levers
from mathota_jax.dynamics.free_motion import free_velocity
from mathota_jax.dynamics.integrate import advance, displace
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.solver import pgs, soft_step
from mathota_jax.solver.pgs import Rows
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.settle import compute_once, materialize
from mathota_jax.spatial.vector import Vec3
from mathota_jax.state import Flag, State


def step(model: Model, state: State, action: Array | None = None) -> State:
    """Advances one world by `model.dt`.

    Pure; differentiable in every float leaf of its arguments; `jax.vmap` of it runs with the worlds last (see
    `batching`). Reverse mode stores the arguments and recomputes the step. The warm-start impulses only set where the
    solver starts: derivatives are those of the solved contacts and do not flow through them.

    Args:
      model: parameters and static scene.
      state: state of one world.
      action: (motor,) one entry for each motor, clipped to its limit; None for no effort.

    Returns:
      State at the end of the step; applied forces are cleared.

    Raises:
      ValueError: the action has the wrong shape, or a state of another scene was given.
    """
    scene = model.scene
    if action is None:
        action = jnp.zeros(len(scene.motors), state.position.dtype)
    action = jnp.asarray(action, state.position.dtype)
    if action.shape != (len(scene.motors),):
        raise ValueError(
            f"step: action must have shape ({len(scene.motors)},), one entry for each motor, got {action.shape}"
        )
    if state.position.shape != (scene.body_count, 3):
        raise ValueError(
            f"step: state.position must have shape ({scene.body_count}, 3) for this model, got {state.position.shape}; "
            "use jax.vmap for several worlds"
        )
    return _batched_step(model, state, action)


def rollout(model: Model, state: State, actions: Array | int) -> tuple[State, State]:
    """Runs many steps in one `lax.scan`.

    Args:
      model: parameters and static scene.
      state: initial state of one world.
      actions: (step, motor) actions, or the number of steps without effort.

    Returns:
      The final state, and the trajectory: a `State` whose leaves have a leading axis, entry k being the state after
      step k + 1. Differentiable like `step`; memory is linear in the number of steps.

    Raises:
      ValueError: a negative number of steps, or actions of the wrong shape.
    """
    motor_count = len(model.scene.motors)
    if isinstance(actions, int):
        if actions < 0:
            raise ValueError(f"rollout: the number of steps must be at least 0, got {actions}")
        actions = jnp.zeros((actions, motor_count), state.position.dtype)
    actions = jnp.asarray(actions)
    if actions.ndim != 2 or actions.shape[1] != motor_count:
        raise ValueError(f"rollout: actions must have shape (steps, {motor_count}), got {actions.shape}")

    def body(state: State, action: Array) -> tuple[State, State]:
        state = step(model, state, action)
        return state, state

    return jax.lax.scan(body, state, actions)


class _Problem(NamedTuple):
    """Constraints of one step: joints first, so that contacts, which must not be violated, have the last word."""

    joints: joint.JointRows | None
    middle: joint.JointRows | None
    joint_rows: tuple[Rows, ...]
    contacts: ContactSet | None
    contact_rows: list[contact.ContactRows]
    close: compact.ClosePairs | None

    @property
    def rows(self) -> tuple[Rows, ...]:
        return (*self.joint_rows, *(group.rows for group in self.contact_rows))


def step_worlds_last(model: Model, state: State, action: Array) -> State:
    """`step` for leaves with one trailing world axis; `jax.vmap(step)` calls this."""
    scene = model.scene
    bodies = materialize(unpack(state))
    if not scene.dynamic_bodies:
        return _finish(scene, state, moving(scene, bodies), {})
    blocks = moving(scene, bodies)
    inertia = compute_once(moving_inertia(scene, model, blocks.orientation), state.position)
    force, torque = _external(model, state, bodies, action)
    free, decay = compute_once(_free(model, blocks, inertia, force, torque), state.position)
    problem = _constrain(model, state, bodies, blocks, inertia, free)
    packed = _pack(scene, *free)
    start = _warm_start(model, state, problem, inertia, packed)
    lever, gained = None, None
    if scene.options.solver == "soft_step":
        solved, gained, impulses = _small_steps(model, problem, blocks, packed, start)
    else:
        solved, impulses = _solve(scene, problem, packed, start)
        lever = levers(model.dt, problem.joint_rows, problem.contact_rows, impulses, solved)
    moved, displacement = advance(blocks, inertia, free, torque, decay, solved, lever, model.dt, gained)
    moved, displacement = compute_once((moved, displacement), state.position)
    if scene.options.solver == "pgs":
        moved = _correct_positions(model, problem, bodies, inertia, moved, displacement)
    return _finish(scene, state, moved, _forces(model, problem, impulses))


_batched_step = batch_last(step_worlds_last)


def _external(model: Model, state: State, bodies: Bodies, action: Array) -> tuple[Vec3, Vec3]:
    """Phase 1: forces and torques on the moving bodies, gravity excepted."""
    force, torque = vector(state.applied_force), vector(state.applied_torque)
    if model.scene.motors:
        motor_force, motor_torque = joint.motor_forces(model, bodies, action)
        force, torque = force + motor_force, torque + motor_torque
    return take((force, torque), model.scene.dynamic_bodies)


def _free(
    model: Model, blocks: Bodies, inertia: Inertia, force: Vec3, torque: Vec3
) -> tuple[tuple[Vec3, Vec3], float | Array]:
    """Phase 4: velocities at the end of the step without constraints; also the decay of the angular momentum."""
    options, dt = model.scene.options, model.dt
    linear, angular = free_velocity(blocks, inertia, _gravity(model), force, torque, dt)
    if options.linear_damping:
        linear = linear * jnp.maximum(1.0 - options.linear_damping * dt, 0.0)
    if not options.angular_damping:
        return (linear, angular), 1.0
    decay = jnp.maximum(1.0 - options.angular_damping * dt, 0.0)
    return (linear, angular * decay), decay


def _gravity(model: Model) -> Vec3:
    return Vec3(*(model.gravity[axis][None] for axis in range(3)))


def _pack(scene: Scene, linear: Vec3, angular: Vec3) -> Array:
    return pack_blocks(linear, angular if contact.couples_rotation(scene) else None)


def _constrain(
    model: Model, state: State, bodies: Bodies, blocks: Bodies, inertia: Inertia, free: tuple[Vec3, Vec3]
) -> _Problem:
    """Phases 2, 3 and 5: narrow phase and rows."""
    scene = model.scene
    joints, middle, joint_rows = None, None, ()
    if scene.joints:
        joints = joint.joint_rows(model, bodies)
        middle = joint.joint_rows(model, joint.midpoint(bodies, model.dt))
        joint_rows = tuple(
            joint.velocity_rows(scene, table, model, joints, middle, inertia) for table in joint.joint_tables(scene)
        )
    contacts, contact_rows, close = None, [], None
    if scene.slot_count:
        found = []
        if scene.pair_groups:
            found.append(find_contacts(scene, model.shapes, bodies.position, bodies.orientation))
        if scene.broadphase:
            close = compact.close_pairs(model, bodies, free)
            found += compact.contacts_of(model, bodies, close)
        contacts = join_contacts(found)
        contacts = contacts._replace(
            **compute_once(
                {"position": contacts.position, "normal": contacts.normal, "separation": contacts.separation},
                state.position,
            )
        )
        motion = contact.Motion(
            blocks.position, Side(blocks.velocity, blocks.angular_velocity), Side(*free), inertia, _gravity(model)
        )
        contact_rows = [
            contact.contact_rows(scene, table, model, contacts, motion) for table in contact.contact_tables(scene)
        ]
        contact_rows += [
            contact.contact_rows(scene, table, model, contacts, motion, pairs)
            for group in (close.groups if close else ())
            for table, pairs in group.tables
        ]
    return _Problem(joints, middle, joint_rows, contacts, contact_rows, close)


def _warm_start(model: Model, state: State, problem: _Problem, inertia: Inertia, velocity: Array) -> tuple[Array, ...]:
    """Impulses to start from: those of the last step where rows and features are the same (guide 12.4)."""
    if not model.scene.options.warm_start:
        return tuple(jnp.zeros_like(rows.bias) for rows in problem.rows)
    start = [
        joint.joint_impulse_start(rows.table, state.joint_force, model.dt, rows.bias.shape[-1])
        for rows in problem.joint_rows
    ]
    if problem.contacts is not None:
        old, feature = vector(state.contact_force), state.contact_feature
        parts = warm_start.matched_force(model.scene, problem.contacts, old, feature)
        if problem.close is not None and state.contact_pair is not None:
            parts += compact.matched_force(
                model.scene, problem.close, problem.contacts, old, feature, state.contact_pair
            )
        force = compute_once(warm_start.join_forces(parts), state.position)
        start += [contact.warm_start_impulse(group, force, model.dt) for group in problem.contact_rows]
        if len(model.scene.dynamic_bodies) > 1 and model.scene.options.solver == "pgs":
            return warm_start.plausible(problem.rows, inertia, velocity, tuple(start))
    return tuple(start)


def _solve(
    scene: Scene, problem: _Problem, velocity: Array, start: tuple[Array, ...]
) -> tuple[Array, tuple[Array, ...]]:
    """Phase 5: velocity constraints."""
    rows = problem.rows
    worlds = max([velocity.shape[-1], *(group.bias.shape[-1] for group in rows)])
    velocity = jnp.broadcast_to(velocity, (*velocity.shape[:-1], worlds))
    iterations = scene.options.velocity_iterations
    return pgs.solve(iterations, _gradient_iterations(scene, iterations), rows, velocity, start)


def _small_steps(
    model: Model, problem: _Problem, blocks: Bodies, free: Array, start: tuple[Array, ...]
) -> tuple[Array, Array, tuple[Array, ...]]:
    """Phases 5 to 7 in small steps: velocities, displacements by the impulses, and the impulses of the whole step."""
    scene, options, rows = model.scene, model.scene.options, problem.rows
    begin, end = _pack(scene, blocks.velocity, blocks.angular_velocity), free
    worlds = max([begin.shape[-1], end.shape[-1], *(group.bias.shape[-1] for group in rows)])
    begin, end = (jnp.broadcast_to(velocity, (*velocity.shape[:-1], worlds)) for velocity in (begin, end))
    errors = tuple(contact.position_error(scene, group, model, worlds) for group in problem.contact_rows)
    if problem.joints is not None and problem.middle is not None:
        tables = (group.table for group in problem.joint_rows)
        joints = (joint.position_error(scene, t, model, problem.joints, problem.middle, worlds) for t in tables)
        errors = (*joints, *errors)
    count = options.substep_count
    start = tuple(impulse / count for impulse in start)
    rebound_sweeps = options.velocity_iterations if scene.restitution and problem.contact_rows else 0
    added, gained, impulses = soft_step.solve(count, rebound_sweeps, rows, errors, begin, end, start, model.dt)
    return end + added, gained, impulses


def _gradient_iterations(scene: Scene, iterations: int) -> int:
    return scene.options.gradient_iterations or 2 * iterations


def _correct_positions(
    model: Model, problem: _Problem, bodies: Bodies, inertia: Inertia, moved: Bodies, displacement: tuple[Vec3, Vec3]
) -> Bodies:
    """Phase 7: sequential position correction (guide 10.2) by pseudo-impulses with the full effective mass."""
    scene = model.scene
    options = scene.options
    if not options.position_iterations or not problem.rows:
        return moved
    packed = _pack(scene, *displacement)
    rows: list[Rows] = []
    if problem.joints is not None:
        error = joint.joint_rows(model, _merge(scene, bodies, moved)).error
        rows += [
            joint.position_rows(scene, group.table, problem.joints, error, inertia, options.position_percent)
            for group in problem.joint_rows
        ]
    for group in problem.contact_rows:
        change = pgs.row_velocity(group.rows, packed)[:, :1]
        rows.append(contact.position_rows(group, change, options.position_percent))
    start = tuple(jnp.zeros_like(group.bias) for group in rows)
    worlds = max(group.bias.shape[-1] for group in rows)
    zero = jnp.zeros((*packed.shape[:-1], worlds), packed.dtype)
    iterations = options.position_iterations
    correction, _ = pgs.solve(iterations, _gradient_iterations(scene, iterations), tuple(rows), zero, start)
    return displace(moved, inertia, correction)


def _merge(scene: Scene, bodies: Bodies, moved: Bodies) -> Bodies:
    """All bodies, the moving ones at their new place."""
    return jax.tree.map(lambda old, new: _place(scene, old[:, None], [new])[:, 0], bodies, moved)


def _place(scene: Scene, old: Array, components: Sequence[Array]) -> Array:
    """(body, component, world) array: static bodies from `old`, the others from components of shape (moving, world)."""
    worlds = max(old.shape[-1], *(component.shape[-1] for component in components))
    moving_count = len(scene.dynamic_bodies)
    new = jnp.stack([jnp.broadcast_to(component, (moving_count, worlds)) for component in components], axis=1)
    # Runs of bodies that are all moving or all static; a concatenation of slices is cheaper than a gather.
    parts, start = [], 0
    for is_static, run in itertools.groupby(range(scene.body_count), key=lambda body: scene.static[body]):
        bodies = list(run)
        if is_static:
            parts.append(jnp.broadcast_to(take(old, bodies), (len(bodies), *new.shape[1:])))
        else:
            parts.append(new[start : start + len(bodies)])
            start += len(bodies)
    return jnp.concatenate(parts)


def _forces(model: Model, problem: _Problem, impulses: tuple[Array, ...]) -> dict[str, Array]:
    """Mean forces over the step and what they belong to, in the form in which the state keeps them; new flags."""
    scene, count = model.scene, len(problem.joint_rows)
    changes: dict[str, Array] = {}
    if problem.joints is not None:
        tables = [rows.table for rows in problem.joint_rows]
        values = [impulse[:, 0] / model.dt for impulse in impulses[:count]]
        changes["joint_force"] = collect(tables, values, joint.joint_row_count(scene))
    if problem.contacts is not None:
        impulses = impulses[count:]
        changes["contact_force"] = contact.slot_force(problem.contact_rows, list(impulses), scene.slot_count, model.dt)
        changes["contact_feature"] = jnp.where(problem.contacts.active, problem.contacts.feature, -1)
        if problem.contacts.converged is not None or problem.close is not None:
            changes["flags"] = _collision_flags(problem.contacts, problem.close)
        if problem.close is not None:
            changes["contact_pair"] = compact.pair_keys(scene, problem.close)
    return changes


def _collision_flags(contacts: ContactSet, close: compact.ClosePairs | None) -> Array:
    """Bits (world,) for what the collision phases could not do."""
    flags = jnp.zeros(contacts.separation.shape[-1:], jnp.int32)
    if contacts.converged is not None:
        failed = (contacts.active & ~contacts.converged).any(0)
        flags = flags | jnp.where(failed, int(Flag.NOT_CONVERGED), 0)
    if close is not None:
        flags = flags | jnp.where(close.overflow, int(Flag.CONTACT_OVERFLOW), 0)
    return flags


def _finish(scene: Scene, state: State, moved: Bodies, forces: dict[str, Array]) -> State:
    """The new state with its flags."""
    moved = compute_once(moved, moved.position.x)
    position, orientation, velocity, angular_velocity = (
        _place(scene, getattr(state, name), getattr(moved, name))
        for name in ("position", "orientation", "velocity", "angular_velocity")
    )
    finite = [jnp.isfinite(value).all((0, 1)) for value in (position, orientation, velocity, angular_velocity)]
    broken = jnp.where(finite[0] & finite[1] & finite[2] & finite[3], 0, int(Flag.NON_FINITE))
    changes: dict[str, Any] = {
        "position": position,
        "orientation": orientation,
        "velocity": velocity,
        "angular_velocity": angular_velocity,
        "applied_force": jnp.zeros_like(state.applied_force),
        "applied_torque": jnp.zeros_like(state.applied_torque),
        "flags": state.flags | broken.astype(state.flags.dtype),
    }
    if "flags" in forces:
        forces = {**forces, "flags": changes["flags"] | forces["flags"].astype(state.flags.dtype)}
    return dataclasses.replace(state, **{**changes, **forces})
