"""Sliding turns into rolling, and a sphere rolls or slides down a slope (benchmark A11)."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from tests.scenes import GRAVITY, advance, advance_worlds, per_body, repeat, sphere_on_plane, tilted_gravity, with_dt

RADIUS, KAPPA = 0.1, 0.4  # inertia of a solid sphere: kappa m r^2


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240, 1e-3])
def test_sliding_sphere_ends_rolling(precision, dt, gate):
    friction, speed = 0.2, 5.0
    model, state = sphere_on_plane(friction=friction, velocity=(speed, 0.0, 0.0))
    model = with_dt(model, dt)
    start_of_rolling = KAPPA * speed / ((1 + KAPPA) * friction * GRAVITY)
    assert start_of_rolling == pytest.approx(0.728120, abs=1e-6)
    rolling = advance(model, state, round(1.0 / dt))
    final = advance(model, rolling, round(2.0 / dt) - round(1.0 / dt))
    for moment in (rolling, final):  # forward rolling turns about -Z
        gate("speed / truth - 1", moment.velocity[1, 0] / (speed / (1 + KAPPA)) - 1, 1e-4)
        gate("slip [m/s]", moment.velocity[1, 0] + RADIUS * moment.angular_velocity[1, 2], 1e-4)
    truth = speed * 2.0 / (1 + KAPPA) + 0.5 * (KAPPA / (1 + KAPPA)) ** 2 * speed**2 / (friction * GRAVITY)
    assert truth == pytest.approx(7.662943, abs=1e-6)
    gate("distance / truth - 1", final.position[1, 0] / truth - 1, 2e-3)
    gate("sideways and vertical [m]", final.position[1, 1:] - jnp.array([RADIUS, 0.0]), 1e-4)


def test_sphere_on_a_slope(precision, gate):
    grid = list(itertools.product((0.1, 0.5), (10.0, 20.0, 30.0, 40.0)))
    friction, angle = (np.array(column) for column in zip(*grid, strict=True))
    slope = np.radians(angle)
    model, state = sphere_on_plane()
    models = with_dt(repeat(model, len(grid)), 1 / 240)
    models = dataclasses.replace(
        models,
        friction=per_body(friction, models.friction),
        gravity=jnp.asarray(tilted_gravity(angle), dtype=models.gravity.dtype),
    )
    final = advance_worlds(models, repeat(state, len(grid)), 240)

    rolls = np.tan(slope) <= friction * (1 + 1 / KAPPA)
    assert rolls.any() and not rolls.all()
    acceleration = GRAVITY * np.where(rolls, np.sin(slope) / (1 + KAPPA), np.sin(slope) - friction * np.cos(slope))
    spin = np.where(rolls, acceleration / RADIUS, friction * GRAVITY * np.cos(slope) / (KAPPA * RADIUS))
    gate("speed after 1 s / truth - 1", final.velocity[:, 1, 0] / acceleration - 1, 0.005)
    gate("distance after 1 s / truth - 1", final.position[:, 1, 0] / (0.5 * acceleration) - 1, 0.005)
    gate("spin after 1 s / truth - 1", -final.angular_velocity[:, 1, 2] / spin - 1, 0.005)


def test_rolling_resistance_is_off(float64, gate):
    """A rolling sphere rolls for ever when all damping is zero."""
    model, state = sphere_on_plane(velocity=(1.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, -10.0))
    final = advance(with_dt(model, 1 / 60), state, 600)
    gate("speed lost in 10 s [m/s]", final.velocity[1, 0] - 1.0, 1e-6)
