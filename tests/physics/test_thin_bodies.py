"""Pencils, rulers and rods that fall on the ground: no law lets their energy rise."""

import dataclasses

import jax
import numpy as np
import pytest

from mathota_jax import Box, Capsule, energy
from tests.marks import slow_but
from tests.scenes import body_on_plane, record_worlds, repeat, undamped

WORLDS = 256
SHAPES = {"pencil": Capsule(0.004, 0.08), "ruler": Box((0.15, 0.0015, 0.015)), "rod": Box((0.01, 0.15, 0.01))}
WAYS = {"pgs": {}, "soft_step": {"solver": "soft_step"}, "continuous": {"continuous": True}}
CASES = [f"{shape}-{way}" for shape in SHAPES for way in WAYS]


def energies(shape, way, dt=1 / 60, seconds=2.0):
    """(step, world) of bodies dropped from 1 m in any orientation with some spin."""
    model, state = body_on_plane(
        SHAPES[shape], restitution=0.3, mass=0.01, position=(0, 1, 0), options=undamped(dt=dt, **WAYS[way])
    )
    generator = np.random.default_rng(0)
    turn = generator.normal(size=(WORLDS, 4))
    spin = generator.normal(size=(WORLDS, 3)) * 5.0
    models, states = repeat((model, state), WORLDS)
    states = dataclasses.replace(
        states,
        orientation=states.orientation.at[:, 1].set(turn / np.linalg.norm(turn, axis=1, keepdims=True)),
        angular_velocity=states.angular_velocity.at[:, 1].set(spin),
    )
    _, after = record_worlds(models, states, round(seconds / dt), energy)
    return np.concatenate([jax.vmap(energy)(models, states)[None], after])


@pytest.mark.parametrize("case", slow_but(("pencil-pgs", "ruler-continuous"), CASES))
def test_energy_does_not_rise(case, gate):
    """An impulse across a rod seen from where it is at the end of the step made 25 times the energy of some pencils."""
    found = energies(*case.split("-"))
    gate("largest energy / that of the start - 1", np.maximum(found.max(0) / found[0] - 1.0, 0.0), 2e-3)
