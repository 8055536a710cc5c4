"""Where simulated trajectories and the segments of multiple shooting begin: guesses from the data, and changes of them.

The chart of a `Motion` has 12 numbers for each moving body: displacement [m], rotation vector [rad], changes of velocity
[m/s] and of angular velocity [rad/s], world frame.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial.transform import Rotation

from mathota_jax.fit.arrays import rotation_between, turned
from mathota_jax.fit.trajectories import Trajectories
from mathota_jax.model import Model
from mathota_jax.state import State


class Motion(NamedTuple):
    """Motions of all bodies of the scene; leaves may have further axes in front.

    Attributes:
        position: (body, 3) [m].
        orientation: (body, 4).
        velocity: (body, 3) [m/s].
        angular_velocity: (body, 3) [rad/s].
    """

    position: Any
    orientation: Any
    velocity: Any
    angular_velocity: Any


CHART = 12
"""Numbers of the chart for each moving body."""

WINDOW = 5
"""Frames from which a velocity is guessed."""


def motion_of(state: State) -> Motion:
    """The motion of all bodies."""
    return Motion(state.position, state.orientation, state.velocity, state.angular_velocity)


def with_motion(state: State, motion: Motion) -> State:
    """The state with another motion."""
    position, orientation, velocity, angular_velocity = motion
    return dataclasses.replace(
        state,
        position=position,
        orientation=orientation,
        velocity=velocity,
        angular_velocity=angular_velocity,
    )


def changed(motion: Motion, chart: Array, moving: tuple[int, ...]) -> Motion:
    """The motion at a point (moving * 12,) of its chart; differentiable."""
    position, orientation, velocity, angular_velocity = motion
    step = jnp.reshape(chart, (len(moving), 4, 3))
    index = jnp.asarray(moving)
    return Motion(
        position.at[index].add(step[:, 0]),
        orientation.at[index].set(turned(step[:, 1], orientation[index])),
        velocity.at[index].add(step[:, 2]),
        angular_velocity.at[index].add(step[:, 3]),
    )


def difference(first: Motion, second: Motion, moving: tuple[int, ...]) -> Array:
    """Chart (moving * 12,) of `second` about `first`; differentiable."""
    index = jnp.asarray(moving)
    turn = rotation_between(first[1][index], second[1][index])
    shift, speed, spin = (second[leaf][index] - first[leaf][index] for leaf in (0, 2, 3))
    return jnp.ravel(jnp.stack((shift, turn, speed, spin), 1))


def guesses(
    model: Model, state: State, data: Trajectories, frames: list[int], recorded: bool
) -> tuple[Motion, np.ndarray]:
    """Motions of all bodies at some frames of each trajectory, and which components of their leaves the data tell.

    The motions have leaves (trajectory, frame, body, ...), NumPy float64; what is told is (trajectory, frame, body, leaf,
    3), for an orientation all three or none.

    Positions and orientations are those recorded at the frame, or the nearest recorded ones moved along by the velocity;
    velocities are recorded ones, or the slope over the nearest frames; each component of a vector by itself. Bodies,
    channels and components that were not recorded keep the state of the scene.

    Args:
        model: the scene.
        state: what holds for bodies and channels that were not recorded.
        data: recorded motions.
        frames: indices of the frames.
        recorded: the first frame must be recorded in full, velocities included.

    Raises:
        ValueError: `recorded`, and it is not.
    """
    if recorded:
        _check_recorded(data)
    names = model.scene.body_names
    outer = (data.count, len(frames))
    motion = [np.broadcast_to(np.asarray(leaf, float), (*outer, *leaf.shape)).copy() for leaf in motion_of(state)]
    told = np.zeros((*outer, len(names), len(motion), 3), bool)
    for column, body in enumerate(data.bodies):
        index = names.index(body)
        for trajectory in range(data.count):
            for place, frame in enumerate(frames):
                found = _guess(data, trajectory, column, frame)
                told[trajectory, place, index] = [~np.isnan(value[:3]) for value in found]
                for leaf, value in zip(motion, found, strict=True):
                    own = leaf[trajectory, place, index]
                    own[:] = np.where(np.isnan(value), own, value)
    return Motion(*motion), told


def _check_recorded(data: Trajectories) -> None:
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        value = getattr(data, name)
        if value is None:
            raise ValueError(f'fit: start="recorded" needs the {name} of every body in frame 0; use start="free"')
        missing = np.isnan(value[:, 0]).any(-1)
        if missing.any():
            trajectory, body = np.argwhere(missing)[0]
            raise ValueError(
                f"fit: start=\"recorded\" needs the {name} of '{data.bodies[body]}' in frame 0 of trajectory {trajectory}, "
                'which is NaN; use start="free"'
            )


def _guess(data: Trajectories, trajectory: int, body: int, frame: int) -> list[np.ndarray]:
    """Leaves of the motion of one body; NaN where nothing was recorded."""
    rates = _at(data.velocity, trajectory, body, frame)
    position, velocity = np.transpose(
        [_coordinate(data.position[trajectory, :, body, k], rates[k], frame, data.dt) for k in range(3)]
    )
    orientation, angular_velocity = _rotation(data, trajectory, body, frame)
    return [position, orientation, velocity, angular_velocity]


def _at(channel: np.ndarray | None, trajectory: int, body: int, frame: int) -> np.ndarray:
    return np.full(3, np.nan) if channel is None else channel[trajectory, frame, body]


def _nearest(recorded: np.ndarray, frame: int) -> np.ndarray:
    """The recorded frames nearest to a frame, in order of time."""
    known = np.flatnonzero(recorded)
    return np.sort(known[np.argsort(np.abs(known - frame), kind="stable")[:WINDOW]])


def _coordinate(values: np.ndarray, rate: float, frame: int, dt: float) -> tuple[float, float]:
    """Value and rate at a frame of one coordinate (frame,) of a position; `rate` is the recorded one."""
    near = _nearest(~np.isnan(values), frame)
    if len(near) == 0:
        return np.nan, rate
    closest = near[np.argmin(np.abs(near - frame))]
    if np.isnan(rate) and len(near) > 1:
        time = (near - near.mean()) * dt
        rate = time @ values[near] / (time @ time)
    return values[closest] + np.nan_to_num(rate) * (frame - closest) * dt, rate


def _rotation(data: Trajectories, trajectory: int, body: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Orientation and angular velocity at a frame."""
    rate = _at(data.angular_velocity, trajectory, body, frame)
    if data.orientation is None:
        return np.full(4, np.nan), rate
    values = data.orientation[trajectory, :, body]
    near = _nearest(~np.isnan(values[:, 0]), frame)
    if len(near) == 0:
        return np.full(4, np.nan), rate
    turns = Rotation.from_quat(values[near][:, [1, 2, 3, 0]])
    closest = int(np.argmin(np.abs(near - frame)))
    if np.isnan(rate).any() and len(near) > 1:
        steps = (turns[1:] * turns[:-1].inv()).as_rotvec() / (np.diff(near)[:, None] * data.dt)
        rate = np.where(np.isnan(rate), steps.mean(0), rate)
    moved = Rotation.from_rotvec(np.nan_to_num(rate) * (frame - near[closest]) * data.dt) * turns[closest]
    return moved.as_quat()[[3, 0, 1, 2]], rate
