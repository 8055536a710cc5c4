"""Time between the steps: frames of any length from steps of a fixed one, sub-steps, and poses in between.

All functions are pure, for one world (`jax.vmap` for many) and differentiable in the states, the model and the action;
how many steps are taken is a discrete decision without a derivative.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.model import Model
from mathota_jax.spatial.quaternion import Quaternion, exponential, multiply, normalize, turn_between
from mathota_jax.spatial.settle import settle
from mathota_jax.state import Flag, State
from mathota_jax.step import step

ROUNDING = 8
"""Multiples of the machine epsilon by which the time at hand may fall short of a step and still pay for it: frames of
exactly one step must not come out as none and two by turns."""


class Frame(NamedTuple):
    """What `advance` returns.

    Attributes:
      state: after the last step taken.
      accumulator: () time at hand that no step has used yet [s]; pass it to the next call.
      alpha: () the same as a share of a step, in [0, 1), for `interpolate`.
      previous: state before the last step taken, for `interpolate`; `state` itself if none was taken.
      step_count: () int32 steps taken.
      dropped: () time [s] beyond the largest number of steps, which is lost.
    """

    state: State
    accumulator: Array
    alpha: Array
    previous: State
    step_count: Array
    dropped: Array


def advance(
    model: Model,
    state: State,
    accumulator: Any,
    elapsed: Any,
    action: Array | None = None,
    *,
    max_steps: int = 8,
) -> Frame:
    """Advances by as many steps of `model.dt` as the elapsed time pays for (guide 11.2, fixed time step).

    Steps that are not taken cost nothing in one world; under `jax.vmap` all `max_steps` are computed.

    Args:
      model: parameters and static scene.
      state: state of one world.
      accumulator: () time left over by the last call [s], which rounding may have left a little below 0; 0 at the start.
      elapsed: () time since the last call [s], at least 0. One of the two that is negative or not finite counts as 0 and
        sets `Flag.INVALID_TIME_STEP`.
      action: (motor,) for all steps of this call, None for no effort.
      max_steps: largest number of steps, static. More time than they take is dropped and reported, since a program that
        is slower than its clock would fall behind more and more.

    Returns:
      A `Frame`. Applied forces act in the first step taken and wait if none is.

    Raises:
      ValueError: `max_steps` is not a positive integer, `accumulator` or `elapsed` not a number, or as `step`.
    """
    _positive_integer("advance: max_steps", max_steps)
    accumulator, elapsed = (
        _scalar(f"advance: {name}", value, model)
        for name, value in (("accumulator", accumulator), ("elapsed", elapsed))
    )
    dt = model.dt
    # What rounding left over may be a little less than nothing.
    real, owed = (elapsed >= 0) & (elapsed < jnp.inf), (accumulator >= -dt) & (accumulator < jnp.inf)
    valid = real & owed
    at_hand = jnp.where(owed, accumulator, 0.0) + jnp.where(real, elapsed, 0.0)
    runs = (dt > 0) & (dt < jnp.inf)
    safe_dt = jnp.where(runs, dt, 1.0)
    share = ROUNDING * jnp.finfo(dt.dtype).eps
    wanted = settle(jnp.where(runs, jnp.floor(jnp.maximum(at_hand, 0.0) / safe_dt * (1.0 + share) + share), 0.0))
    taken = jnp.minimum(wanted, max_steps)
    dropped = (wanted - taken) * dt
    count = taken.astype(jnp.int32)

    def body(states: tuple[State, State], index: Array) -> tuple[tuple[State, State], None]:
        return jax.lax.cond(index < count, lambda s: (s[1], step(model, s[1], action)), lambda s: s, states), None

    (previous, final), _ = jax.lax.scan(body, (state, state), jnp.arange(max_steps))
    bad = jnp.where(valid & (runs | (dt == 0)), 0, int(Flag.INVALID_TIME_STEP)).astype(state.flags.dtype)
    final = dataclasses.replace(final, flags=final.flags | bad)
    left = at_hand - wanted * jnp.where(runs, dt, 0.0)
    alpha = jnp.clip(jnp.where(runs, left / safe_dt, 0.0), 0.0, 1.0)
    return Frame(final, left, alpha, previous, count, dropped)


def substep(model: Model, state: State, action: Array | None = None, *, count: int = 4) -> State:
    """One step of `model.dt` in `count` equal sub-steps (guide 12.3), for fast bodies and stiff joints.

    Applied forces act in all sub-steps: the impulse is that of one step. Forces of contacts and joints in the returned
    state are those of the last sub-step. The model keeps its time step.

    Args:
      model: parameters and static scene.
      state: state of one world.
      action: as for `step`.
      count: number of sub-steps, static.

    Raises:
      ValueError: `count` is not a positive integer, or as `step`.
    """
    _positive_integer("substep: count", count)
    part = dataclasses.replace(model, dt=model.dt / count)
    force, torque = state.applied_force, state.applied_torque

    def body(state: State, _: None) -> tuple[State, None]:
        return step(part, dataclasses.replace(state, applied_force=force, applied_torque=torque), action), None

    return jax.lax.scan(body, state, None, length=count)[0]


def interpolate(previous: State, current: State, alpha: Any) -> State:
    """The state with poses between those of two states, for drawing (guide 11.2 and 12.3).

    Positions lie on the straight line, orientations on the shortest turn (spherical linear interpolation, K. Shoemake,
    "Animating rotation with quaternion curves", SIGGRAPH 1985); everything else is that of `current`. Differentiable in
    both states and in `alpha`; at half a turn apart, where the shortest turn is not unique, in one of the two.

    Args:
      previous: state of one world.
      current: a later state of the same world.
      alpha: () 0 for the poses of `previous`, 1 for those of `current`; beyond, the motion is continued.

    Raises:
      ValueError: states of different scenes.
    """
    if previous.position.shape != current.position.shape:
        raise ValueError(
            f"interpolate: the states have positions of shapes {previous.position.shape} and {current.position.shape}: "
            "they belong to different scenes"
        )
    alpha = jnp.asarray(alpha, current.position.dtype)
    start = Quaternion(*jnp.moveaxis(previous.orientation, -1, 0))
    end = Quaternion(*jnp.moveaxis(current.orientation, -1, 0))
    turned = normalize(multiply(exponential(turn_between(start, end) * alpha), start))
    return dataclasses.replace(
        current,
        position=previous.position + alpha * (current.position - previous.position),
        orientation=jnp.stack(list(turned), axis=-1),
    )


def _positive_integer(label: str, value: Any) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ValueError(f"{label} must be a positive integer, got {value!r}")


def _scalar(label: str, value: Any, model: Model) -> Array:
    array = jnp.asarray(value, model.dt.dtype)
    if array.shape != ():
        raise ValueError(f"{label} must be a number of seconds, got an array of shape {array.shape}")
    return array
