"""Collisions of free bodies keep linear and angular momentum, and energy when they are elastic and frictionless."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Capsule, SceneBuilder, Sphere
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import invariants, motion, per_body, record_worlds, repeat, undamped

WORLDS = 12
SCENES = {
    "spheres": [Sphere(0.2), Sphere(0.3)],
    "boxes": [Box((0.3, 0.2, 0.15)), Box((0.2, 0.25, 0.2))],
    "sphere, box, capsule": [Sphere(0.2), Box((0.25, 0.2, 0.15)), Capsule(0.15, 0.25)],
}


def colliding_worlds(shapes, seed):
    """Bodies on a ring fly towards the middle with random spins; friction 0 in the first half of the worlds."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    for index, shape in enumerate(shapes):
        angle = 2 * np.pi * index / len(shapes)
        place = 0.9 * np.array([np.cos(angle), np.sin(angle), 0.0])
        builder.add_body(shape, mass=1.0 + index, position=place, velocity=-2.0 * place, restitution=1.0, friction=0.5)
    model, state = builder.build(undamped(dt=1 / 240, impact_events=3))
    rng = np.random.default_rng(seed)
    models, states = repeat(model, WORLDS), repeat(state, WORLDS)
    turn = rng.normal(size=states.orientation.shape)
    states = dataclasses.replace(
        states,
        orientation=jnp.asarray(turn / np.linalg.norm(turn, axis=-1, keepdims=True)),
        velocity=states.velocity + jnp.asarray(rng.uniform(-0.15, 0.15, states.velocity.shape)),
        angular_velocity=jnp.asarray(rng.uniform(-3, 3, states.velocity.shape)),
    )
    friction = np.where(np.arange(WORLDS) < WORLDS // 2, 0.0, 0.5)
    models = dataclasses.replace(models, friction=per_body(friction, models.friction))
    return model, models, states


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in SCENES if name != "spheres"]  # compiles for minutes


@pytest.mark.parametrize("name", ["spheres", *SLOW])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_collisions_keep_the_invariants(precision, name, gate):
    model, models, states = colliding_worlds(SCENES[name], seed=1)
    _, record = record_worlds(models, states, 240, motion)
    leaves = {"mass": model.mass, "inertia": model.inertia}
    before = invariants(leaves, states.position, states.orientation, states.velocity, states.angular_velocity)
    after = invariants(leaves, *(record[key] for key in ("position", "orientation", "velocity", "angular_velocity")))

    change = np.asarray(record["velocity"], dtype=float)[-1] - np.asarray(states.velocity, dtype=float)
    hit = np.linalg.norm(change, axis=-1).max(axis=-1) > 0.1
    assert hit.mean() > 0.8, "the bodies miss one another: the test says nothing"

    round_off = {"float32": 2e-5, "float64": 1e-10}[str(precision)]
    gate("linear momentum [kg m/s]", after[1] - before[1], round_off)
    gate("angular momentum [kg m^2/s]", after[2] - before[2], {"float32": 1e-4, "float64": 1e-9}[str(precision)])
    ratio = after[0] / before[0]
    smooth = slice(0, WORLDS // 2)
    gate("energy / start - 1, frictionless", ratio[:, smooth] - 1, {"float32": 1e-4, "float64": 1e-6}[str(precision)])
    gate(
        "energy gained / start, with friction",
        np.maximum(0.0, ratio - 1),
        {"float32": 1e-4, "float64": 1e-6}[str(precision)],
    )
