"""One step of the engine: the order of guide 11.1, a line a phase."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

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
    vector,
)
from mathota_jax.constraints import collisions, contact, graph, joint, joint_layout, joint_rows, motor
from mathota_jax.constraints.lever import levers
from mathota_jax.constraints.problem import Problem, constrain, starting_impulses
from mathota_jax.dynamics import events, sleep
from mathota_jax.dynamics.flight import flight, with_static
from mathota_jax.dynamics.free_motion import free_velocity
from mathota_jax.dynamics.impact_times import FirstImpact, first_impact
from mathota_jax.dynamics.integrate import advance, displace
from mathota_jax.model import Model
from mathota_jax.outcome import forces, merge, new_state
from mathota_jax.scene import Scene
from mathota_jax.solver import converged, pgs, soft_step
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
    if scene.options.impact_events and scene.restitution and scene.pair_groups:
        return _split_at_impacts(model, state, action)
    bodies = materialize(unpack(state))
    if not scene.dynamic_bodies:
        return new_state(scene, state, moving(scene, bodies), {})
    blocks = moving(scene, bodies)
    inertia = compute_once(moving_inertia(scene, model, blocks.orientation), state.position)
    force, torque = _external(model, state, bodies, action)
    free, decay = compute_once(_free(model, blocks, inertia, force, torque), state.position)
    problem = constrain(model, state, bodies, blocks, inertia, free, _gravity(model), action)
    packed = contact.pack_motion(scene, *free)
    start = starting_impulses(model, state, problem, inertia, packed)
    lever, gained, failed = None, None, None
    if scene.options.solver == "soft_step":
        solved, gained, impulses = _small_steps(model, problem, blocks, packed, start)
    else:
        solved, impulses, failed = _solve(scene, problem, packed, start)
        lever = levers(model.dt, problem.joint_rows, problem.contact_rows, impulses, solved)
    moved, displacement = advance(blocks, inertia, free, torque, decay, solved, lever, model.dt, gained)
    moved, displacement = compute_once((moved, displacement), state.position)
    if scene.options.solver != "soft_step":
        moved = _correct_positions(model, problem, bodies, inertia, moved, displacement)
    if scene.options.continuous and scene.pair_groups:
        moved = _stop_at_impacts(model, bodies, moved, displacement)
    new = new_state(scene, state, moved, forces(model, problem, impulses), failed)
    return _let_sleep(model, state, new, action, problem) if scene.options.sleep else new


class _Progress(NamedTuple):
    """How far a step with impacts has come: the state, the time left, whether it ended, and the forces so far.

    The forces are those that the scene has (`_forces_of`), means over the whole step.
    """

    state: State
    left: Array
    ended: Array
    forces: list[Array]


def _split_at_impacts(model: Model, state: State, action: Array) -> State:
    """The phases of a step, split at its first impacts; what follows the last of them is an ordinary step."""
    count = model.scene.options.impact_events
    worlds = max(leaf.shape[-1] for leaf in jax.tree.leaves((model, state, action)))
    state = jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], worlds)), state)
    begin = _Progress(
        state,
        jnp.broadcast_to(model.dt, (worlds,)),
        jnp.zeros(worlds, bool),
        [jnp.zeros_like(getattr(state, name)) for name in _forces_of(model.scene)],
    )

    def part(progress: _Progress, index: Array) -> tuple[_Progress, None]:
        new = lax.cond(
            progress.ended.all(),
            lambda progress: progress,
            lambda progress: _until_impact(model, progress, action, index == count),
            progress,
        )
        return new, None

    end = lax.scan(part, begin, jnp.arange(count + 1))[0]
    return dataclasses.replace(
        end.state,
        **dict(zip(_forces_of(model.scene), end.forces, strict=True)),
        applied_force=jnp.zeros_like(state.applied_force),
        applied_torque=jnp.zeros_like(state.applied_torque),
    )


def _forces_of(scene: Scene) -> list[str]:
    """Names of the forces in a state that a scene has."""
    return ["contact_force", "joint_force"] if joint_layout.joint_row_count(scene) else ["contact_force"]


def _until_impact(whole: Model, progress: _Progress, action: Array, last: Array) -> _Progress:
    """The step up to the next impact and the impact itself, or to its end; worlds that have ended stay."""
    scene, state = whole.scene, progress.state
    left = jnp.where(progress.ended, whole.dt, progress.left)
    model = dataclasses.replace(whole, dt=left)
    bodies = materialize(unpack(state))
    blocks = moving(scene, bodies)
    inertia = compute_once(moving_inertia(scene, model, blocks.orientation), state.position)
    force, torque = _external(model, state, bodies, action)
    free, decay = compute_once(_free(model, blocks, inertia, force, torque), state.position)
    problem = constrain(model, state, bodies, blocks, inertia, free, _gravity(model), action)
    packed = contact.pack_motion(scene, *free)
    now = contact.pack_motion(scene, blocks.velocity, blocks.angular_velocity)
    foreseen, bounces = collisions.foreseen(whole, problem, now, packed, _gravity(model), left)
    split = bounces & ~last & ~progress.ended
    # Rows would hold together what has just rebounded and is still near.
    dropped = tuple((apart & split) | clear for apart, clear in foreseen)
    contact_rows = [
        group._replace(rows=collisions.without(group.rows, none))
        for group, none in zip(problem.contact_rows, dropped, strict=True)
    ]
    problem = problem._replace(contact_rows=contact_rows)
    start = starting_impulses(model, state, problem, inertia, packed)
    joint_count = len(problem.joint_rows)
    start = start[:joint_count] + tuple(
        jnp.where(none, 0.0, impulse) for impulse, none in zip(start[joint_count:], dropped, strict=True)
    )
    solved, impulses, failed = _solve(scene, problem, packed, start)
    lever = levers(left, problem.joint_rows, problem.contact_rows, impulses, solved)
    moved, displacement = advance(blocks, inertia, free, torque, decay, solved, lever, left)
    path = flight(blocks, inertia, free, torque, decay, solved, left)
    quiet = FirstImpact(left, jnp.zeros_like(split))
    impact = lax.cond(
        split.any(),
        lambda path: first_impact(whole, with_static(scene, bodies, path), _gravity(whole), left, split),
        lambda path: quiet,
        path,
    )
    moved, displacement = jax.tree.map(
        lambda split, whole: jnp.where(impact.happens, split, whole),
        path.at(impact.time[None]),
        (moved, displacement),
    )
    moved, displacement = compute_once((moved, displacement), state.position)
    moved = _correct_positions(model, problem, bodies, inertia, moved, displacement)
    kept = forces(model, problem, impulses)
    share = impact.time / whole.dt
    means = [kept[name] * share for name in _forces_of(scene)]
    moved, added = lax.cond(
        impact.happens.any(),
        lambda moved: collisions.collide(whole, merge(scene, bodies, moved), moved, impact.happens, _gravity(whole)),
        lambda moved: (moved, [jnp.zeros_like(mean) for mean in means]),
        moved,
    )
    new = new_state(scene, state, moved, kept, failed)
    new = dataclasses.replace(new, applied_force=state.applied_force, applied_torque=state.applied_torque)
    total = [old + mean + more for old, mean, more in zip(progress.forces, means, added, strict=True)]
    after = _Progress(new, left - impact.time, progress.ended | ~impact.happens, total)
    return jax.tree.map(lambda old, new: jnp.where(progress.ended, old, new), progress, after)


_batched_step = batch_last(step_worlds_last)


def _external(model: Model, state: State, bodies: Bodies, action: Array) -> tuple[Vec3, Vec3]:
    """Phase 1: forces and torques on the moving bodies, gravity excepted."""
    force, torque = vector(state.applied_force), vector(state.applied_torque)
    if motor.exert_torque(model.scene):
        motor_force, motor_torque = motor.motor_forces(model, bodies, action)
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


def _solve(
    scene: Scene, problem: Problem, velocity: Array, start: tuple[Array, ...]
) -> tuple[Array, tuple[Array, ...], Array | None]:
    """Phase 5: velocity constraints. Also 1 for each world (world,) that was not solved; None from "pgs"."""
    rows = problem.rows
    worlds = max([velocity.shape[-1], *(group.bias.shape[-1] for group in rows)])
    velocity = jnp.broadcast_to(velocity, (*velocity.shape[:-1], worlds))
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
    if not options.position_iterations or not problem.rows:
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
