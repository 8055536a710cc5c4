"""One step of the engine: the order of guide 11.1, a line a phase."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.batching import batch_last
from mathota_jax.bodies import (
    Bodies,
    Inertia,
    moving,
    moving_inertia,
    of_all_bodies,
    unpack,
    unpack_blocks,
    vector,
)
from mathota_jax.constraints import contact, graph, joint, joint_rows, mechanism, motor
from mathota_jax.constraints.lever import levers
from mathota_jax.constraints.mechanism_layout import covers, layout
from mathota_jax.constraints.problem import Problem, constrain, starting_impulses
from mathota_jax.dynamics import events, sleep
from mathota_jax.dynamics.free_motion import carried_velocity, free_velocity
from mathota_jax.dynamics.integrate import advance, displace
from mathota_jax.model import Model
from mathota_jax.outcome import forces, merge, new_state
from mathota_jax.scene import Scene
from mathota_jax.solver import converged, pgs, soft_step
from mathota_jax.solver.pgs import Rows, add_impulses
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
      State at the end of the step; applied forces are cleared. With a `model.dt` of 0 no time passes and the state comes
      back as it was, applied forces included; with one that is negative or not finite likewise, and
      `Flag.INVALID_TIME_STEP` is set. Bodies that sleep (`Options.sleep`) keep their pose, of which the derivative is the
      identity; that of their velocities is 0.

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
    if (state.sleep is not None) != scene.options.sleep:
        raise ValueError(
            f"step: the model was built with Options(sleep={scene.options.sleep}), the state was not; take both from one "
            "call of build"
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


def step_worlds_last(model: Model, state: State, action: Array) -> State:
    """`step` for leaves with one trailing world axis; `jax.vmap(step)` calls this."""
    runs = (model.dt > 0) & (model.dt < jnp.inf)
    # The program must stay finite for the derivative of the selection to be 0.
    new = _simulate_or_rest(dataclasses.replace(model, dt=jnp.where(runs, model.dt, 1.0)), state, action)
    new = jax.tree.map(lambda before, after: jnp.where(runs, after, before), state, new)
    bad = jnp.where(runs | (model.dt == 0), 0, int(Flag.INVALID_TIME_STEP))
    return dataclasses.replace(new, flags=new.flags | bad.astype(state.flags.dtype))


def _simulate_or_rest(model: Model, state: State, action: Array) -> State:
    """`_simulate`, but for batches in which everything sleeps."""
    if not (model.scene.options.sleep and model.scene.dynamic_bodies):
        return _simulate(model, state, action)
    worlds = max(leaf.shape[-1] for leaf in jax.tree.leaves((model, state, action)))

    def every_world(state: State) -> State:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], worlds)), state)

    return jax.lax.cond(
        sleep.all_rest(model.scene, state, action),
        lambda model, state, action: every_world(sleep.at_rest(state)),
        lambda model, state, action: every_world(_simulate(model, state, action)),
        model,
        state,
        action,
    )


def _simulate(model: Model, state: State, action: Array) -> State:
    """The phases of a step."""
    scene = model.scene
    bodies = materialize(unpack(state))
    if not scene.dynamic_bodies:
        return new_state(scene, state, moving(scene, bodies), {})
    blocks = moving(scene, bodies)
    inertia = compute_once(moving_inertia(scene, model, blocks.orientation), state.position)
    acting, carried = _acting_inertia(model, blocks, inertia)
    force, torque = _external(model, state, bodies, action)
    free, decay = compute_once(_free(model, blocks, acting, carried, force, torque), state.position)
    problem = constrain(model, state, bodies, blocks, acting, free, carried, _gravity(model), action)
    packed = contact.pack_motion(scene, *free)
    start = starting_impulses(model, state, problem, acting, packed)
    lever, gained, failed = None, None, None
    if scene.options.solver == "soft_step":
        solved, gained, impulses = _small_steps(model, problem, blocks, packed, start)
    else:
        solved, impulses, failed = _solve(scene, problem, packed, start)
        lever = levers(model.dt, problem.joint_rows, problem.contact_rows, impulses, solved)
    moved, displacement = advance(blocks, inertia, acting, free, torque, decay, solved, lever, model.dt, gained)
    moved, displacement = compute_once((moved, displacement), state.position)
    if scene.options.solver != "soft_step":
        moved = _correct_positions(model, problem, bodies, inertia, moved, displacement)
    if problem.held is not None:
        moved = _close_joints(model, bodies, moved)
    if scene.options.continuous and scene.pair_groups:
        moved = _stop_at_impacts(model, bodies, moved, displacement)
    new = new_state(scene, state, moved, forces(model, problem, impulses), failed)
    return _let_sleep(model, state, new, action, problem) if scene.options.sleep else new


_batched_step = batch_last(step_worlds_last)


def _external(model: Model, state: State, bodies: Bodies, action: Array) -> tuple[Vec3, Vec3]:
    """Phase 1: forces and torques on the moving bodies, gravity excepted."""
    force, torque = vector(state.applied_force), vector(state.applied_torque)
    if motor.exert_torque(model.scene):
        motor_force, motor_torque = motor.motor_forces(model, bodies, action)
        force, torque = force + motor_force, torque + motor_torque
    return take((force, torque), model.scene.dynamic_bodies)


def _acting_inertia(model: Model, blocks: Bodies, inertia: Inertia) -> tuple[Inertia, Vec3 | None]:
    """Inertia with which bodies respond to impulses: with mechanisms that of mid-step; see `carried_velocity`."""
    if layout(model.scene) is None or inertia.rotation is None:
        return inertia, None
    middle = inertia.at(joint_rows.moved_by(blocks, 0.5 * model.dt).orientation)
    return compute_once((middle, carried_velocity(blocks, inertia, middle)), blocks.position.x)


def _free(
    model: Model, blocks: Bodies, inertia: Inertia, carried: Vec3 | None, force: Vec3, torque: Vec3
) -> tuple[tuple[Vec3, Vec3], float | Array]:
    """Phase 4: velocities at the end of the step without constraints; also the decay of the angular momentum."""
    options, dt = model.scene.options, model.dt
    linear, angular = free_velocity(blocks, inertia, carried, _gravity(model), force, torque, dt)
    if options.linear_damping:
        linear = linear * jnp.maximum(1.0 - options.linear_damping * dt, 0.0)
    if not options.angular_damping:
        return (linear, angular), 1.0
    decay = jnp.maximum(1.0 - options.angular_damping * dt, 0.0)
    return (linear, angular * decay), decay


def _gravity(model: Model) -> Vec3:
    return Vec3(*(model.gravity[axis][None] for axis in range(3)))


def _solve(
    scene: Scene, problem: Problem, velocity: Array, start: tuple[Array, ...]
) -> tuple[Array, tuple[Array, ...], Array | None]:
    """Phase 5: velocity constraints. Also 1 for each world (world,) that was not solved; None from "pgs"."""
    rows = problem.rows
    worlds = max([velocity.shape[-1], *(group.bias.shape[-1] for group in rows)])
    velocity = jnp.broadcast_to(velocity, (*velocity.shape[:-1], worlds))
    if problem.held is None:
        return _sweep(scene, rows, velocity, start)
    hold = functools.partial(mechanism.hold, problem.held, problem.joint_rows)
    if covers(scene):
        return *hold(velocity, tuple(jnp.zeros_like(impulse) for impulse in start)), None
    _, start = lax.stop_gradient(hold(add_impulses(rows, velocity, start), start))
    velocity, impulses, failed = _sweep(scene, rows, velocity, start)
    return *hold(velocity, impulses), failed


def _sweep(
    scene: Scene, rows: tuple[Rows, ...], velocity: Array, start: tuple[Array, ...]
) -> tuple[Array, tuple[Array, ...], Array | None]:
    """All rows by the solver of the scene."""
    if scene.options.solver == "converged":
        return converged.solve(rows, velocity, start)
    iterations = scene.options.velocity_iterations
    return *pgs.solve(iterations, _gradient_iterations(scene, iterations), rows, velocity, start), None


def _small_steps(
    model: Model, problem: Problem, blocks: Bodies, free: Array, start: tuple[Array, ...]
) -> tuple[Array, Array, tuple[Array, ...]]:
    """Phases 5 to 7 in small steps: velocities, displacements by the impulses, and the impulses of the whole step."""
    scene, options, rows = model.scene, model.scene.options, problem.rows
    begin = contact.pack_motion(scene, blocks.velocity, blocks.angular_velocity)
    worlds = max([begin.shape[-1], free.shape[-1], *(group.bias.shape[-1] for group in rows)])
    begin, free = (jnp.broadcast_to(velocity, (*velocity.shape[:-1], worlds)) for velocity in (begin, free))
    count = options.substep_count
    start = tuple(impulse / count for impulse in start)
    rebound_sweeps = options.velocity_iterations if scene.restitution and problem.contact_rows else 0
    added, gained, impulses = soft_step.solve(count, rebound_sweeps, rows, problem.errors, begin, free, start, model.dt)
    return free + added, gained, impulses


def _gradient_iterations(scene: Scene, iterations: int) -> int:
    return scene.options.gradient_iterations or 2 * iterations


def _correct_positions(
    model: Model, problem: Problem, bodies: Bodies, inertia: Inertia, moved: Bodies, displacement: tuple[Vec3, Vec3]
) -> Bodies:
    """Phase 7: sequential position correction (guide 10.2) by pseudo-impulses with the full effective mass."""
    scene = model.scene
    options = scene.options
    if not options.position_iterations or not problem.rows or covers(scene):
        return moved
    packed = contact.pack_motion(scene, *displacement)
    rows: list[Rows] = []
    if problem.joints is not None:
        error = joint_rows.joint_rows(model, merge(scene, bodies, moved)).error
        rows += [
            joint.position_rows(scene, group.table, problem.joints, error, inertia) for group in problem.joint_rows
        ]
    for group in problem.contact_rows:
        known = group.rows
        change = pgs.first_row_velocity(known.table, known.jacobian, known.places, packed)
        rows.append(contact.position_rows(group, change, options.position_percent))
    start = tuple(jnp.zeros_like(group.bias) for group in rows)
    worlds = max(group.bias.shape[-1] for group in rows)
    zero = jnp.zeros((*packed.shape[:-1], worlds), packed.dtype)
    if options.solver == "converged":
        return displace(moved, inertia, converged.solve(tuple(rows), zero, start)[0])
    iterations = options.position_iterations
    correction, _ = pgs.solve(iterations, _gradient_iterations(scene, iterations), tuple(rows), zero, start)
    return displace(moved, inertia, correction)


def _close_joints(model: Model, bodies: Bodies, moved: Bodies) -> Bodies:
    """Mechanisms at the end of the step: their joints closed, and velocities along which they stay closed.

    The second is a projection in the metric of the kinetic energy, and so never adds any.
    """
    scene = model.scene

    def close(moved: Bodies, is_last: Array) -> tuple[Bodies, None]:
        inertia = moving_inertia(scene, model, moved.orientation)
        joints = joint_rows.joint_rows(model, merge(scene, bodies, moved))
        weights = jax.tree.map(lambda a, b: jnp.where(is_last, a, b), inertia, mechanism.correction_weights(inertia))
        links = mechanism.links(scene, joints, moved.position, weights)
        velocity = contact.pack_motion(scene, moved.velocity, moved.angular_velocity)
        excess, errors = mechanism.rates(links, velocity), mechanism.of_slots(links, joints.error)
        wanted = jax.tree.map(lambda rate, error: -jnp.where(is_last, rate, error), excess, errors)
        change = mechanism.push(links, mechanism.solve(links, wanted))
        linear, angular = unpack_blocks(jnp.where(is_last, velocity + change, velocity))
        assert angular is not None
        moved = moved._replace(velocity=linear, angular_velocity=angular)
        if not rounds:
            return moved, None
        shift = jnp.where(is_last, mechanism.closing_shift(links, errors), mechanism.bounded(change))
        return displace(moved, inertia, shift), None

    rounds = mechanism.ROUNDS if scene.options.position_iterations else 0
    worlds = max(leaf.shape[-1] for leaf in jax.tree.leaves((moved, model)))
    moved = jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], worlds)), moved)
    return lax.scan(close, moved, jnp.arange(rounds + 1) == rounds)[0]


def _stop_at_impacts(model: Model, bodies: Bodies, moved: Bodies, displacement: tuple[Vec3, Vec3]) -> Bodies:
    """Fast bodies stop at the first touch on their way (guide 10.4)."""
    scene = model.scene
    motion = events.Motion(bodies.position, bodies.orientation, *(of_all_bodies(scene, part) for part in displacement))
    return moving(scene, events.stop_at_impacts(model, motion, merge(scene, bodies, moved)))


def _let_sleep(model: Model, old: State, new: State, action: Array, problem: Problem) -> State:
    """Phase 8: islands fall asleep and wake (guide 3.4 and 12.2)."""
    edges = graph.body_graph(model, old, new, problem.contacts, problem.close)
    new, sleepers = sleep.let_sleep(model, old, new, action, edges)
    return dataclasses.replace(new, **graph.keep_forces(model, old, new, problem.close, sleepers))
