"""One step of the engine: the order of guide 11.1, a line a phase."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.batching import Shortcut, batch_last
from mathota_jax.bodies import moving, moving_inertia, unpack
from mathota_jax.constraints import contact
from mathota_jax.constraints.lever import levers
from mathota_jax.constraints.mechanism_layout import layout, takes_small_steps
from mathota_jax.constraints.problem import Forces, constrain, known_impulses, starting_impulses
from mathota_jax.dynamics import sleep
from mathota_jax.dynamics.integrate import advance
from mathota_jax.impact_splitting import split_at_impacts
from mathota_jax.model import Model
from mathota_jax.outcome import end_forces, forces, new_state
from mathota_jax.phases import (
    acting_inertia,
    close_joints,
    correct_positions,
    external,
    free_velocities,
    gravity,
    let_sleep,
    small_steps,
    solve_rows,
    stop_at_impacts,
)
from mathota_jax.spatial.indexing import in_every_world
from mathota_jax.spatial.settle import compute_once, materialize
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
    if (state.end_forces is not None) != (scene.options.solver == "soft_step"):
        raise ValueError(
            f"step: the model was built with Options(solver={scene.options.solver!r}), the state was not; take both from "
            "one call of build"
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


def step_worlds_last(model: Model, state: State, action: Array, solved: Forces | None = None) -> State:
    """`step` for leaves with one trailing world axis; `jax.vmap(step)` calls this.

    `solved` are the forces that the solver found in this very step; None if it has still to find them.
    """
    runs = (model.dt > 0) & (model.dt < jnp.inf)
    # The program must stay finite for the derivative of the selection to be 0.
    new = _simulate_or_rest(dataclasses.replace(model, dt=jnp.where(runs, model.dt, 1.0)), state, action, solved)
    new = jax.tree.map(lambda before, after: jnp.where(runs, after, before), state, new)
    bad = jnp.where(runs | (model.dt == 0), 0, int(Flag.INVALID_TIME_STEP))
    return dataclasses.replace(new, flags=new.flags | bad.astype(state.flags.dtype))


def _simulate_or_rest(model: Model, state: State, action: Array, solved: Forces | None) -> State:
    """`_simulate`, but for batches in which everything sleeps."""
    if not (model.scene.options.sleep and model.scene.dynamic_bodies):
        return _simulate(model, state, action, solved)
    worlds = max(leaf.shape[-1] for leaf in jax.tree.leaves((model, state, action)))
    return jax.lax.cond(
        sleep.all_rest(model.scene, state, action),
        lambda model, state, action: in_every_world(sleep.at_rest(state), worlds),
        lambda model, state, action: in_every_world(_simulate(model, state, action, None), worlds),
        model,
        state,
        action,
    )


def _simulate(model: Model, state: State, action: Array, known: Forces | None) -> State:
    """The phases of a step; `known` are its solved forces, if they are."""
    scene = model.scene
    if scene.options.impact_events and scene.restitution and scene.pair_groups:
        return split_at_impacts(model, state, action)
    bodies = materialize(unpack(state))
    if not scene.dynamic_bodies:
        return new_state(scene, state, moving(scene, bodies), {})
    blocks = moving(scene, bodies)
    inertia = compute_once(moving_inertia(scene, model, blocks.orientation), state.position)
    acting, halfway = acting_inertia(model, blocks, inertia)
    force, torque = external(model, state, bodies, action)
    free, decay = compute_once(free_velocities(model, blocks, acting, halfway, force, torque), state.position)
    problem = constrain(model, state, bodies, blocks, acting, free, halfway, gravity(model), action)
    packed = contact.pack_motion(scene, *free)
    if known is not None:
        start, change = known_impulses(model, problem, known), None
    else:
        start, change = starting_impulses(model, state, problem, acting, packed)
    lever, beyond, gained, failed, last = None, None, None, None, None
    small = takes_small_steps(scene)
    if small:
        solved, gained, impulses, last = small_steps(model, problem, blocks, packed, start)
    else:
        solved, impulses, failed = solve_rows(scene, problem, packed, start, change, known is not None)
        lever, beyond = levers(scene, model.dt, problem.joint_rows, problem.contact_rows, impulses, packed, solved)
    moved, displacement = advance(
        blocks, inertia, acting, halfway, free, torque, decay, solved, lever, model.dt, beyond, gained
    )
    moved, displacement = compute_once((moved, displacement), state.position)
    if not small:
        moved = correct_positions(model, problem, bodies, inertia, moved, displacement)
    if scene.options.continuous and scene.pair_groups:
        moved = stop_at_impacts(model, bodies, moved, displacement)
    if problem.held is not None:
        moved = close_joints(model, bodies, moved)
    new = new_state(scene, state, moved, forces(model, problem, impulses), failed)
    if last is not None and state.end_forces is not None:
        new = dataclasses.replace(new, end_forces=end_forces(model, problem, state.end_forces, last))
    return let_sleep(model, state, new, action, problem) if scene.options.sleep else new


def _reusable_forces(new: State, model: Model, state: State, action: Array) -> Forces | None:
    """The solved forces of the step to `new`, where they are all that its solver found."""
    del state, action
    options = model.scene.options
    # Sleeping islands keep the forces of another step; small steps and impacts share out theirs among their parts;
    # mechanisms are solved directly.
    if options.sleep or options.impact_events or options.solver == "soft_step" or layout(model.scene) is not None:
        return None
    return Forces(new.joint_force, new.contact_force)


def _step_again(solved: Forces | None, model: Model, state: State, action: Array) -> State:
    return step_worlds_last(model, state, action, solved)


_batched_step = batch_last(step_worlds_last, Shortcut(_reusable_forces, _step_again))
