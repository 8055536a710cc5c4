"""The simulated cube: rounded corners, many tosses side by side, and the errors of a prediction."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import Compound, Model, Options, Plane, SceneBuilder, Sphere, State, step
from training.cube_toss_data import GRAVITY, Tosses

SETTINGS = ("recorded first frame", "start fitted to the free flight")
CORNERS = np.asarray(list(itertools.product((-1.0, 1.0), repeat=3)))
SUBSTEPS = 2


class CubeParameters(NamedTuple):
    """What the prediction depends on.

    Attributes:
        friction: between cube and table.
        restitution: between them.
        inertia: about every axis [kg m^2].
        corner_radius: [m].
        half_width: [m].
    """

    friction: float
    restitution: float
    inertia: float
    corner_radius: float
    half_width: float


def scene(dt: float, mass: float, parameters: CubeParameters) -> tuple[Model, State]:
    """A cube over a table.

    Against a plane a cube with rounded corners and edges is the same as the eight spheres in its corners: both have the
    same lowest point in every direction.
    """
    inset = parameters.half_width - parameters.corner_radius
    spheres = [(Sphere(parameters.corner_radius), (corner * inset, (1.0, 0.0, 0.0, 0.0))) for corner in CORNERS]
    friction, restitution = parameters.friction, parameters.restitution
    builder = SceneBuilder(gravity=(0.0, 0.0, -GRAVITY))
    builder.add_body(
        Plane(normal=(0, 0, 1), offset=0.0), static=True, name="table", friction=friction, restitution=restitution
    )
    builder.add_body(
        Compound(spheres), mass=mass, position=(0, 0, 1), name="cube", friction=friction, restitution=restitution
    )
    model, state = builder.build(Options(dt=dt, linear_damping=0.0, angular_damping=0.0))
    inertia = jnp.full(3, parameters.inertia, model.inertia.dtype)
    size = jnp.asarray(parameters.half_width, model.size.dtype)
    return dataclasses.replace(model, inertia=model.inertia.at[1].set(inertia), size=model.size.at[1].set(size)), state


def start_of(tosses: Tosses, setting: str) -> tuple[np.ndarray, ...]:
    """Position, orientation, velocity and angular velocity (toss, 3 or 4) of the first frame in a setting."""
    return tosses.recorded_start() if setting == SETTINGS[0] else tosses.flight_start()


def errors(tosses: Tosses, setting: str, parameters: CubeParameters) -> tuple[np.ndarray, np.ndarray]:
    """Mean errors of each toss (toss,): position [% of the width given] and rotation [degree]."""
    return prediction_errors(tosses, start_of(tosses, setting), parameters)


def prediction_errors(
    tosses: Tosses, start: tuple[np.ndarray, ...], parameters: CubeParameters
) -> tuple[np.ndarray, np.ndarray]:
    """`errors` with a start that is known already."""
    model, state = scene(tosses.dt / SUBSTEPS, tosses.mass, parameters)
    frames = tosses.position.shape[1]
    leaves = (jnp.asarray(leaf, state.position.dtype) for leaf in start)
    position, orientation = (np.asarray(leaf, float) for leaf in _simulate(model, state, tuple(leaves), frames - 1))
    seen = np.arange(1, frames)[None] < tosses.length[:, None]
    distance = np.linalg.norm(position - tosses.position[:, 1:], axis=-1) / (2 * tosses.half_width) * 100
    cosine = np.abs(np.sum(orientation * tosses.orientation[:, 1:], -1))
    angle = np.degrees(2 * np.arccos(np.clip(cosine, 0.0, 1.0)))
    mean = lambda value: np.where(seen, value, 0.0).sum(1) / seen.sum(1)  # noqa: E731
    return mean(distance), mean(angle)


@functools.partial(jax.jit, static_argnames="count")
def _simulate(model: Model, state: State, start: Any, count: int) -> Any:
    """Positions and orientations (toss, frame, ...) of the cube in the frames after the first."""

    def one(position: Any, orientation: Any, velocity: Any, angular_velocity: Any) -> Any:
        own = dataclasses.replace(
            state,
            position=state.position.at[1].set(position),
            orientation=state.orientation.at[1].set(orientation),
            velocity=state.velocity.at[1].set(velocity),
            angular_velocity=state.angular_velocity.at[1].set(angular_velocity),
        )

        def frame(state: State, _: None) -> Any:
            state, _ = jax.lax.scan(lambda s, _: (step(model, s), None), state, None, length=SUBSTEPS)
            return state, (state.position[1], state.orientation[1])

        return jax.lax.scan(frame, own, None, length=count)[1]

    return jax.vmap(one)(*start)
