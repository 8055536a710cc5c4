"""A feature with its neutral parameter equals the scene built without it (benchmark M2)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Hinge, SceneBuilder, Sphere
from tests.marks import QUICK_AND_SLOW_PRECISION, QUICK_IN_FLOAT64
from tests.scenes import advance, body_on_plane, motion, record_worlds, repeat, sphere_on_plane, undamped


def trajectory(model, state, count=60):
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), count, motion)
    return np.concatenate([np.asarray(leaf, dtype=float).ravel() for leaf in jax.tree.leaves(record)])


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_zero_friction_equals_no_friction(precision, gate):
    for scene in (sphere_on_plane, lambda **k: body_on_plane(Box((0.1, 0.1, 0.2)), position=(0, 0.15, 0), **k)):
        start = {"velocity": (1.0, 0.0, 0.5), "angular_velocity": (0.0, 2.0, 0.0), "options": undamped(dt=1 / 240)}
        with_rows, state = scene(friction=0.5, **start)
        neutral = dataclasses.replace(with_rows, friction=jnp.zeros_like(with_rows.friction))
        without, other = scene(friction=0.0, **start)
        difference = trajectory(neutral, state) - trajectory(without, other)
        gate("trajectory", difference, {"float32": 60e-6, "float64": 60e-12}[str(precision)])


def test_zero_restitution_equals_no_restitution(precision, gate):
    """Sliding and resting; an impact is met at its own instant only where restitution asks for it."""
    start = {"velocity": (1.0, 0.0, 0.5), "options": undamped(dt=1 / 240)}
    with_events, state = sphere_on_plane(restitution=0.5, **start)
    neutral = dataclasses.replace(with_events, restitution=jnp.zeros_like(with_events.restitution))
    without, other = sphere_on_plane(restitution=0.0, **start)
    difference = trajectory(neutral, state) - trajectory(without, other)
    gate("trajectory", difference, {"float32": 60e-6, "float64": 60e-12}[str(precision)])


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_zero_gravity_and_distant_company_change_nothing(precision, gate):
    """A body far away and a joint elsewhere leave a sliding sphere alone."""

    def scene(company):
        builder = SceneBuilder()
        ground = builder.add_body(Box((50.0, 0.5, 50.0)), static=True, position=(0, -0.5, 0))
        builder.add_body(Sphere(0.1), mass=1.0, position=(0.0, 0.1, 0.0), velocity=(1.0, 0.0, 0.0))
        if company:
            child = builder.add_body(Sphere(0.1), mass=1.0, position=(10.0, 5.0, 0.0))
            builder.add_joint(Hinge(parent=ground, child=child, anchor=(10.0, 6.0, 0.0), axis=(0, 0, 1)))
        return builder.build(undamped(dt=1 / 240))

    alone, crowded = (advance(*scene(company), 60) for company in (False, True))
    for leaf in ("position", "orientation", "velocity", "angular_velocity"):
        difference = getattr(crowded, leaf)[1] - getattr(alone, leaf)[1]
        gate(leaf, difference, {"float32": 1e-5, "float64": 1e-12}[str(precision)])
