"""One step of the engine: the order of guide 11.1, a line a phase."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.batching import Shortcut, batch_last
from mathota_jax.bodies import moving, moving_inertia, unpack
from mathota_jax.constraints import contact
from mathota_jax.constraints.lever import levers
from mathota_jax.constraints.mechanism import Solutions
from mathota_jax.constraints.mechanism_layout import layout, takes_small_steps
from mathota_jax.constraints.problem import Forces, constrain, known_impulses, last_impulses, starting_impulses
from mathota_jax.dynamics import sleep
from mathota_jax.dynamics.integrate import advance
from mathota_jax.impact_splitting import split_at_impacts
from mathota_jax.leaf_shapes import check_actions, check_leaves
from mathota_jax.leaf_values import values_in_range
from mathota_jax.model import Model
from mathota_jax.outcome import closing_force, end_forces, forces, new_state
from mathota_jax.phases import (
    acting_inertia,
    close_joints,
    correct_positions,
    external,
    free_velocities,
    gravity,
    let_rest,
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
      ValueError: the action or a leaf has the wrong shape or type, or a state of another scene was given.
    """
    check_leaves("step", model, state)
    scene = model.scene
    if action is None:
        action = jnp.zeros(len(scene.motors), state.position.dtype)
    action = jnp.asarray(action, state.position.dtype)
    if action.shape != (len(scene.motors),):
        raise ValueError(
            f"step: action must have shape ({len(scene.motors)},), one entry for each motor, got {action.shape}"
        )
    if (state.sleep is not None) != scene.options.sleep:
        raise ValueError(
            f"step: the model was built with Options(sleep={scene.options.sleep}), the state was not; take both from one "
            "call of build"
        )
    if (state.end_forces is not None) != takes_small_steps(scene):
        raise ValueError(
            f"step: the model was built with Options(solver={scene.options.solver!r}), the state was not; take both from "
            "one call of build"
        )
    return _batched_step(model, state, action)[0]


def rollout(model: Model, state: State, actions: Array | int) -> tuple[State, State]:
    """Runs many steps in one `lax.scan`; compiled at the first call for a scene and a number of steps.

    Args:
      model: parameters and static scene.
      state: initial state of one world.
      actions: (step, motor) actions, or the number of steps without effort.

    Returns:
      The final state, and the trajectory: a `State` whose leaves have a leading axis, entry k being the state after
      step k + 1. Differentiable like `step`; memory is linear in the number of steps.

    Raises:
      ValueError: a negative number of steps or a traced one, or actions of the wrong shape.
    """
    check_leaves("rollout", model, state)
    return _run(model, state, check_actions("rollout", model, state, actions))


@jax.jit
def _run(model: Model, state: State, actions: Array) -> tuple[State, State]:
    """Compiled once for each scene and number of steps, also where nothing around it is."""

    def body(state: State, action: Array) -> tuple[State, State]:
        state = step(model, state, action)
        return state, state

    return jax.lax.scan(body, state, actions)


class Solved(NamedTuple):
    """What the solvers of a step find.

    Attributes:
      forces: of all constraints; None where they are not all that the sweeps find.
      mechanisms: solutions, where there are mechanisms.
      uncut: impulses with the full rebounds, where some may be cut.
    """

    forces: Forces | None = None
    mechanisms: Solutions | None = None
    uncut: tuple[Array, ...] | None = None


def step_worlds_last(model: Model, state: State, action: Array) -> State:
    """`step` for leaves with one trailing world axis."""
    return _solve_step(model, state, action)[0]


def _solve_step(model: Model, state: State, action: Array, solved: Solved | None = None) -> tuple[State, Solved]:
    """The same, and what the solvers found beside it; `jax.vmap(step)` calls this.

    `solved` is what the solvers found in this very step; None if they have still to find it.
    """
    runs = (model.dt > 0) & (model.dt < jnp.inf)
    # The program must stay finite for the derivative of the selection to be 0.
    passing = dataclasses.replace(model, dt=jnp.where(runs, model.dt, 1.0))
    new, found = _simulate_or_rest(passing, state, action, solved)
    new = jax.tree.map(lambda before, after: jnp.where(runs, after, before), state, new)
    bad = jnp.where(runs | (model.dt == 0), 0, int(Flag.INVALID_TIME_STEP))
    bad = bad | jnp.where(values_in_range(model), 0, int(Flag.INVALID_PARAMETER))
    return dataclasses.replace(new, flags=new.flags | bad.astype(state.flags.dtype)), jax.lax.stop_gradient(found)


def _simulate_or_rest(model: Model, state: State, action: Array, solved: Solved | None) -> tuple[State, Solved]:
    """`_simulate`, but for batches in which everything sleeps."""
    if not (model.scene.options.sleep and model.scene.dynamic_bodies):
        return _simulate(model, state, action, solved)
    worlds = max(leaf.shape[-1] for leaf in jax.tree.leaves((model, state, action)))
    new = jax.lax.cond(
        sleep.all_rest(model.scene, state, action),
        lambda model, state, action: in_every_world(sleep.at_rest(state), worlds),
        lambda model, state, action: in_every_world(_simulate(model, state, action, None)[0], worlds),
        model,
        state,
        action,
    )
    return new, Solved()


def _simulate(model: Model, state: State, action: Array, solved_before: Solved | None) -> tuple[State, Solved]:
    """The phases of a step."""
    scene = model.scene
    if scene.splits_at_impacts:
        return split_at_impacts(model, state, action), Solved()
    bodies = materialize(unpack(state))
    if not scene.dynamic_bodies:
        return new_state(scene, state, moving(scene, bodies), {}), Solved()
    known, mechanisms, uncut = solved_before or Solved()
    held, closed = mechanisms or (None, None)
    blocks = moving(scene, bodies)
    inertia = compute_once(moving_inertia(scene, model, blocks.orientation), state.position)
    acting, halfway = acting_inertia(model, blocks, inertia)
    force, torque = external(model, state, bodies, action)
    free, decay = compute_once(free_velocities(model, blocks, acting, halfway, force, torque), state.position)
    problem = constrain(model, bodies, blocks, acting, free, halfway, gravity(model), action)
    packed = contact.pack_motion(scene, *free)
    last = last_impulses(model, state, problem)
    small = takes_small_steps(scene)
    if scene.restitution and problem.contact_rows and not small:
        problem = let_rest(model, problem, last, model.dt)
    if uncut is not None:
        start, change = uncut, None
    elif known is not None:
        start, change = known_impulses(model, problem, known), None
    else:
        start, change = starting_impulses(model, state, problem, last, acting, packed)
    lever, beyond, gained, failed, ended_with = None, None, None, None, None
    if small:
        solved, gained, impulses, ended_with = small_steps(model, problem, blocks, packed, start)
    else:
        is_solved = known is not None or uncut is not None
        solved, impulses, failed, held, uncut = solve_rows(
            scene, problem, acting, packed, start, change, is_solved, held
        )
        lever, beyond = levers(
            scene, model.dt, problem.joint_rows, problem.contact_rows, impulses, packed, solved, problem.with_joints
        )
    moved, displacement = advance(
        blocks, inertia, acting, halfway, free, torque, decay, solved, lever, model.dt, beyond, gained
    )
    moved, displacement = compute_once((moved, displacement), state.position)
    if not small:
        moved = correct_positions(model, problem, bodies, inertia, moved, displacement)
    if scene.options.continuous and scene.pair_groups:
        moved = stop_at_impacts(model, bodies, inertia, moved, displacement, force)
    if layout(scene) is not None:
        moved, closed = close_joints(model, bodies, moved, closed)
    found = forces(model, problem, impulses)
    closing = None if closed is None else closing_force(model, closed.impulses)
    if closing is not None:
        found["joint_force"] = found["joint_force"] + closing
    new = new_state(scene, state, moved, found, failed)
    if ended_with is not None:
        assert state.end_forces is not None
        ends = end_forces(model, problem, state.end_forces, ended_with)
        if closing is not None:
            ends = dataclasses.replace(ends, joint_force=ends.joint_force + closing)
        new = dataclasses.replace(new, end_forces=ends)
    new = let_sleep(model, state, new, action, problem) if scene.options.sleep else new
    return new, Solved(None, None if closed is None else Solutions(held, closed), uncut)


def _reusable(result: tuple[State, Solved], model: Model, state: State, action: Array) -> Solved | None:
    """What the solvers of a step found, as far as derivatives can do without finding it again."""
    del state, action
    new, found = result
    if found.mechanisms is not None:
        return found._replace(uncut=None)
    scene = model.scene
    # Sleeping islands keep the forces of another step; small steps and impacts share out theirs among their parts.
    if scene.options.sleep or scene.splits_at_impacts or scene.options.solver == "soft_step":
        return None
    return found if found.uncut is not None else Solved(Forces(new.joint_force, new.contact_force))


def _step_again(solved: Solved | None, model: Model, state: State, action: Array) -> tuple[State, Solved]:
    return _solve_step(model, state, action, solved)


_batched_step = batch_last(_solve_step, Shortcut(_reusable, _step_again), in_parts=True)
