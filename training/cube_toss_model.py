"""The simulated cube: rounded corners, a centre of mass off the middle, many tosses side by side, errors of a prediction."""

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
    """What the prediction depends on; numbers or arrays.

    Attributes:
        friction: between cube and table.
        restitution: between them.
        inertia: (3,) about the axes of the cube through its centre of mass [kg m^2].
        corner_radius: [m].
        half_width: [m].
        centre_of_mass: (3,) from the middle of the cube, which is what was recorded, body frame [m].
        gravity: [m/s^2], in lengths as recorded.
    """

    friction: Any
    restitution: Any
    inertia: Any
    corner_radius: Any
    half_width: Any
    centre_of_mass: Any
    gravity: Any


class Start(NamedTuple):
    """First frame of tosses: of the centre of mass, (toss, 3 or 4)."""

    position: Any
    orientation: Any
    velocity: Any
    angular_velocity: Any


def scene(dt: float, mass: float, parameters: CubeParameters) -> tuple[Model, State]:
    """A cube over a table.

    Against a plane a cube with rounded corners and edges is the same as the eight spheres in its corners: both have the
    same lowest point in every direction.
    """
    friction, restitution = float(parameters.friction), float(parameters.restitution)
    radius = float(parameters.corner_radius)
    inset = float(parameters.half_width) - radius
    spheres = [(Sphere(radius), (corner * inset, (1.0, 0.0, 0.0, 0.0))) for corner in CORNERS]
    builder = SceneBuilder(gravity=(0.0, 0.0, -GRAVITY))
    builder.add_body(
        Plane(normal=(0, 0, 1), offset=0.0), static=True, name="table", friction=friction, restitution=restitution
    )
    builder.add_body(
        Compound(spheres), mass=mass, position=(0, 0, 1), name="cube", friction=friction, restitution=restitution
    )
    model, state = builder.build(Options(dt=dt, linear_damping=0.0, angular_damping=0.0))
    return with_parameters(model, parameters), state


def with_parameters(model: Model, parameters: CubeParameters) -> Model:
    """The scene with other parameters, which may be traced."""

    def like(old: Any, new: Any) -> Any:
        return jnp.broadcast_to(jnp.asarray(new, old.dtype), old.shape)

    spheres = model.shapes["sphere"]
    inset = parameters.half_width - parameters.corner_radius
    places = CORNERS * inset - jnp.asarray(parameters.centre_of_mass)
    changed = {"local_position": places, "radius": parameters.corner_radius}
    spheres = spheres | {name: like(spheres[name], value) for name, value in changed.items()}
    return dataclasses.replace(
        model,
        gravity=like(model.gravity, jnp.asarray([0.0, 0.0, -1.0]) * parameters.gravity),
        friction=like(model.friction, parameters.friction),
        restitution=like(model.restitution, parameters.restitution),
        inertia=model.inertia.at[1].set(like(model.inertia[1], jnp.asarray(parameters.inertia))),
        size=model.size.at[1].set(like(model.size[1], parameters.half_width)),
        shapes=model.shapes | {"sphere": spheres},
    )


def start_of(tosses: Tosses, setting: str, parameters: CubeParameters) -> Start:
    """The first frame in a setting."""
    begin = tosses.recorded_start if setting == SETTINGS[0] else tosses.flight_start
    return Start(*begin(np.asarray(parameters.centre_of_mass), float(parameters.gravity)))


def errors(tosses: Tosses, setting: str, parameters: CubeParameters) -> tuple[np.ndarray, np.ndarray]:
    """Mean errors of each toss (toss,): position [% of the width given] and rotation [degree]."""
    return prediction_errors(tosses, start_of(tosses, setting, parameters), parameters)


def prediction_errors(
    tosses: Tosses, start: Start, parameters: CubeParameters, frames: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """`errors` with a start that is known already, over the first `frames` after it; None for all."""
    count = tosses.position.shape[1] - 1 if frames is None else frames
    model, state = scene(tosses.dt / SUBSTEPS, tosses.mass, parameters)
    found = simulate(model, state, as_arrays(model, parameters), as_arrays(model, start), count)
    position, orientation = (np.asarray(leaf, float) for leaf in found)
    seen = tosses.seen(count)
    distance = np.linalg.norm(position - tosses.position[:, 1 : count + 1], axis=-1) / (2 * tosses.half_width) * 100
    cosine = np.abs(np.sum(orientation * tosses.orientation[:, 1 : count + 1], -1))
    angle = np.degrees(2 * np.arccos(np.clip(cosine, 0.0, 1.0)))
    mean = lambda value: np.where(seen, value, 0.0).sum(1) / seen.sum(1)  # noqa: E731
    return mean(distance), mean(angle)


def as_arrays(model: Model, values: Any) -> Any:
    """Named tuples of arrays in the precision of a model."""
    return type(values)(*(jnp.asarray(value, model.dt.dtype) for value in values))


@functools.partial(jax.jit, static_argnames="count")
def simulate(model: Model, state: State, parameters: CubeParameters, start: Start, count: int) -> Any:
    """Positions of the middle of the cube and orientations (toss, frame, ...) in the frames after the first."""
    model = with_parameters(model, parameters)

    def one(start: Start) -> Any:
        leaves = {name: getattr(state, name).at[1].set(value) for name, value in start._asdict().items()}

        def frame(state: State, _: None) -> Any:
            state, _ = jax.lax.scan(lambda s, _: (step(model, s), None), state, None, length=SUBSTEPS)
            middle = state.position[1] - _rotate(state.orientation[1], parameters.centre_of_mass)
            return state, (middle, state.orientation[1])

        return jax.lax.scan(frame, dataclasses.replace(state, **leaves), None, length=count)[1]

    return jax.vmap(one)(start)


def _rotate(quaternion: Any, vector: Any) -> Any:
    twice = 2.0 * jnp.cross(quaternion[1:], vector)
    return vector + quaternion[0] * twice + jnp.cross(quaternion[1:], twice)
