"""Sleeping: islands of bodies at rest stop until something disturbs them (guide 3.4 and 12.2).

The solver does not know of sleep. A step is computed for all bodies alike; what it did to a sleeping island is then
dropped, unless the island was touched by an awake body: if no impulse passed between the two, neither knew of the other,
and if one did, the result stands and the island is awake, in the same step. So no sleeping body ever acts as immovable.
A step is skipped where every moving body of every world of the batch sleeps.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.bodies import Edges
from mathota_jax.dynamics.islands import any_in_island, island_labels
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.spatial.indexing import gather
from mathota_jax.spatial.settle import settle
from mathota_jax.state import Sleep, State, check_handle

STEADY = 0.25
"""A body is at rest only if its acceleration would change its velocity by less than this share of the threshold within
`Options.sleep_time`: at its turning point, a body that accelerates more is slow but not at rest."""

UNSUPPORTED = 0.5
"""A body that gains this share of the velocity that gravity gives is falling, however slowly it moves."""


def is_asleep(model: Model, state: State) -> Array:
    """Whether each body sleeps, (body,) bool. False for static bodies, and everywhere if `Options.sleep` is off."""
    if state.sleep is None:
        return jnp.zeros(model.scene.body_count, bool)
    return state.sleep.asleep


def wake(state: State, body: int) -> State:
    """Wakes a body; its whole island wakes in the next step. No effect if `Options.sleep` is off.

    What is changed in the state (a pose, a velocity, a force, an action) wakes by itself. A model with other leaves (gravity
    tilted, a mass changed) does not: wake the bodies concerned.

    Args:
      state: state of one world.
      body: handle of the body; a traced one is not checked.

    Raises:
      ValueError: `body` is out of range, or the state is one of several worlds.
    """
    check_handle("wake", state, body)
    if state.sleep is None:
        return state
    awake = dataclasses.replace(
        state.sleep, asleep=state.sleep.asleep.at[body].set(False), time=state.sleep.time.at[body].set(0.0)
    )
    return dataclasses.replace(state, sleep=awake)


def poses(state: State) -> Array:
    """(body, 7, world) what `Sleep.pose` keeps."""
    worlds = max(state.position.shape[-1], state.orientation.shape[-1])
    parts = [jnp.broadcast_to(x, (*x.shape[:-1], worlds)) for x in (state.position, state.orientation)]
    return lax.stop_gradient(jnp.concatenate(parts, axis=1))


def disturbed(scene: Scene, state: State, action: Array) -> Array:
    """(body, world) whether the user moved, pushed or drives each body: its pose, its velocity, a force, a motor."""
    assert state.sleep is not None
    moves = ~_static(scene)
    changed = (poses(state) != state.sleep.pose).any(1)
    pushed = ((state.applied_force != 0) | (state.applied_torque != 0)).any(1)
    given_speed = ((state.velocity != 0) | (state.angular_velocity != 0)).any(1) & state.sleep.asleep
    result = changed | (moves & (pushed | given_speed))
    for motor, entry in enumerate(scene.motors):
        # A motor that holds a velocity or a position is at work whatever its target.
        driven = (action[motor] != 0) | (entry.kind != "torque")
        for body in (scene.joints[entry.joint].parent, scene.joints[entry.joint].child):
            result = result.at[body].set(result[body] | driven) if not scene.static[body] else result
    return result


def all_rest(scene: Scene, state: State, action: Array) -> Array:
    """() whether every moving body of every world sleeps and nothing disturbs it: then the step changes nothing."""
    assert state.sleep is not None
    return ((state.sleep.asleep | _static(scene)) & ~disturbed(scene, state, action)).all()


def at_rest(state: State) -> State:
    """The state after a step in which everything slept: poses pass on with the identity as derivative, all else is 0."""
    names = ("velocity", "angular_velocity", "applied_force", "applied_torque")
    return dataclasses.replace(state, **{name: jnp.zeros_like(getattr(state, name)) for name in names})


def let_sleep(model: Model, old: State, new: State, action: Array, edges: Edges) -> tuple[State, Array]:
    """Puts islands to sleep, wakes others, and undoes what the step did to those that sleep on.

    Args:
      model: parameters and static scene.
      old, new: states before and after the step.
      action: (motor, world).
      edges: what touches or is joined, now or in the last step.

    Returns:
      The new state but for the forces of its contacts and joints, and (body, world) which bodies slept all through.
    """
    scene, options, before = model.scene, model.scene.options, old.sleep
    assert before is not None
    static = _static(scene)
    worlds = max(new.position.shape[-1], edges.active.shape[-1], before.time.shape[-1], action.shape[-1])
    disturbance = jnp.broadcast_to(disturbed(scene, old, action), (scene.body_count, worlds))
    disturbance = disturbance | _beside_disturbed_static(static, edges, disturbance)
    links = edges._replace(active=edges.active & ~static[edges.first, 0] & ~static[edges.second, 0])
    labels = island_labels(links, scene.body_count, worlds)
    sleepers = before.asleep & ~any_in_island(labels, ~static & (disturbance | ~before.asleep))

    woken = before.asleep & ~sleepers
    still = _still(model, old, new) & ~disturbance & ~woken & ~static
    time = jnp.where(sleepers, before.time, jnp.where(still, before.time + model.dt, 0.0))
    rested = settle(jnp.where(time >= options.sleep_time, 1.0, 0.0)) > 0.5
    asleep = ~static & (sleepers | ~any_in_island(labels, ~static & ~rested))

    def of_sleepers(name: str) -> Array:
        return jnp.where(sleepers[:, None], getattr(old, name), getattr(new, name))

    def no_motion(name: str) -> Array:
        return jnp.where(asleep[:, None], 0.0, getattr(new, name))

    new = dataclasses.replace(
        new,
        position=of_sleepers("position"),
        orientation=of_sleepers("orientation"),
        velocity=no_motion("velocity"),
        angular_velocity=no_motion("angular_velocity"),
    )
    sleep = Sleep(time=lax.stop_gradient(time), asleep=asleep, pose=poses(new))
    return dataclasses.replace(new, sleep=sleep), sleepers


def _static(scene: Scene) -> Array:
    return jnp.asarray(scene.static)[:, None]


def _beside_disturbed_static(static: Array, edges: Edges, disturbance: Array) -> Array:
    """Bodies that touch a static one which the user moved: static bodies connect no islands, but hold them up."""
    worlds = disturbance.shape[-1]
    shape, lanes = (edges.active.shape[0], worlds), jnp.arange(worlds)
    first, second, active = (jnp.broadcast_to(part, shape) for part in edges)
    moved = static & disturbance
    result = jnp.zeros_like(disturbance)
    for end, other in ((first, second), (second, first)):
        result = result.at[end, lanes].max(active & gather(moved, other))
    return result


def _still(model: Model, old: State, new: State) -> Array:
    """(body, world) whether each body was slow in this step and hardly accelerated.

    Slowness alone would stop a pendulum at its turning point and a ball at its apex, where both are slow for a time of
    twice the threshold over their acceleration.
    """
    options, dt = model.scene.options, model.dt
    gravity = jnp.sqrt((model.gravity * model.gravity).sum(0))
    result = jnp.asarray(True)
    for name, threshold in (
        ("velocity", options.sleep_velocity),
        ("angular_velocity", options.sleep_angular_velocity),
    ):
        value = lax.stop_gradient(getattr(new, name))
        change = _length(value - lax.stop_gradient(getattr(old, name)))
        result = result & (_length(value) < threshold) & (change * options.sleep_time <= STEADY * threshold * dt)
        if name == "velocity":
            result = result & ((change <= UNSUPPORTED * gravity * dt) | (gravity == 0))
    return settle(jnp.where(result, 1.0, 0.0)) > 0.5


def _length(vectors: Array) -> Array:
    """Of vectors (body, 3, world)."""
    return jnp.sqrt((vectors * vectors).sum(1))
