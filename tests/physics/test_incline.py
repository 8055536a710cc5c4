"""A box on a slope sticks, slides or tips as statics says (benchmark A10). Gravity is tilted, not the plane."""

import dataclasses
import functools
import itertools

import jax.numpy as jnp
import numpy as np

from mathota_jax import Box
from tests.scenes import (
    GRAVITY,
    advance_worlds,
    angle_between,
    body_on_plane,
    per_body,
    repeat,
    slab_on_plane,
    tilted_gravity,
    undamped,
    with_dt,
)

FRICTIONS = (0.1, 0.3, 0.5, 0.7, 1.0)
ANGLES = (3.0, 10.0, 20.0, 30.0, 40.0)
GRID = [
    (friction, angle)
    for friction, angle in itertools.product(FRICTIONS, ANGLES)
    if abs(angle - np.degrees(np.arctan(friction))) >= 2
]


def on_slopes(scene, friction, angle, dt):
    model, state = scene()
    models = with_dt(repeat(model, len(angle)), dt)
    models = dataclasses.replace(
        models,
        friction=per_body(friction, models.friction),
        gravity=jnp.asarray(tilted_gravity(angle), dtype=models.gravity.dtype),
    )
    return models, repeat(state, len(angle))


def test_slab_sticks_or_slides(precision, gate):
    friction, angle = (np.array(column) for column in zip(*GRID, strict=True))
    slope = np.radians(angle)
    models, states = on_slopes(slab_on_plane, friction, angle, 1 / 60)
    final = advance_worlds(models, states, 180)
    path = np.asarray(final.position[:, 1] - states.position[:, 1], dtype=float)

    sticks = np.tan(slope) < friction
    gate("creep in 3 s [m]", path[sticks][:, ::2], 1e-4)
    gate("sinking in 3 s [m]", path[sticks, 1], 1e-3)
    truth = 0.5 * GRAVITY * (np.sin(slope) - friction * np.cos(slope)) * 3.0**2
    gate("sliding distance / truth - 1", path[~sticks, 0] / truth[~sticks] - 1, 0.01)
    gate("sideways / distance", path[~sticks, 2] / truth[~sticks], 2e-3)
    gate("lift off the plane / distance", path[~sticks, 1] / truth[~sticks], 2e-3)


def test_tall_box_tips_at_the_angle_of_its_footprint(precision, gate):
    angle = np.arange(13.0, 15.01, 0.05)
    # Near the balance the whole load moves to one edge, which ten sweeps do not follow: they tip it 0.54 degrees early.
    options = undamped(velocity_iterations=40)
    tall = functools.partial(body_on_plane, Box((0.1, 0.4, 0.1)), position=(0.0, 0.4, 0.0), options=options)
    models, states = on_slopes(tall, np.full_like(angle, 1.5), angle, 1 / 60)
    final = advance_worlds(models, states, 180)
    tilt = angle_between(final.orientation[:, 1], states.orientation[:, 1])
    tipped = tilt > 0.2
    assert tipped.any(), "nothing tips"
    first = angle[np.argmax(tipped)]
    assert tipped[np.argmax(tipped) :].all(), "a steeper slope stands where a flatter one tips"
    gate("tipping angle error [deg]", first - np.degrees(np.arctan(0.25)), 0.25)
    gate("tilt of those that stand [deg]", np.degrees(tilt[~tipped]), 0.5)
