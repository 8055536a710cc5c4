"""Pencils, rulers and rods that fall on the ground: no law lets their energy rise."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Capsule, Plane, SceneBuilder, energy, step
from tests.marks import slow_but
from tests.scenes import DOWN, undamped

WORLDS = 256
SHAPES = {"pencil": Capsule(0.004, 0.08), "ruler": Box((0.15, 0.0015, 0.015)), "rod": Box((0.01, 0.15, 0.01))}
WAYS = {"pgs": {}, "soft_step": {"solver": "soft_step"}, "continuous": {"continuous": True}}
CASES = [f"{shape}-{way}" for shape in SHAPES for way in WAYS]


def energies(shape, way, dt=1 / 60, seconds=2.0):
    """(step, world) of bodies dropped from 1 m in any orientation with some spin."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.5, restitution=0.3)
    builder.add_body(SHAPES[shape], mass=0.01, position=(0, 1, 0), friction=0.5, restitution=0.3)
    model, state = builder.build(undamped(dt=dt, **WAYS[way]))
    generator = np.random.default_rng(0)
    turn = generator.normal(size=(WORLDS, 4))
    spin = generator.normal(size=(WORLDS, 3)) * 5.0
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (WORLDS, *leaf.shape)), state)
    states = dataclasses.replace(
        states,
        orientation=states.orientation.at[:, 1].set(turn / np.linalg.norm(turn, axis=1, keepdims=True)),
        angular_velocity=states.angular_velocity.at[:, 1].set(spin),
    )

    def measure(states):
        return jax.vmap(lambda state: energy(model, state))(states)

    def advance(states, _):
        states = jax.vmap(step, (None, 0))(model, states)
        return states, measure(states)

    def run(states):
        return measure(states), jax.lax.scan(advance, states, None, length=round(seconds / dt))[1]

    before, after = jax.jit(run)(states)
    return np.concatenate([before[None], after])


@pytest.mark.parametrize("case", slow_but(("pencil-pgs", "ruler-continuous"), CASES))
def test_energy_does_not_rise(case, gate):
    """An impulse across a rod seen from where it is at the end of the step made 25 times the energy of some pencils."""
    found = energies(*case.split("-"))
    gate("largest energy / that of the start - 1", np.maximum(found.max(0) / found[0] - 1.0, 0.0), 2e-3)
