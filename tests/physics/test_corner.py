"""A body that meets several others within one step: each impulse moves it from its own time of impact on."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Plane, SceneBuilder, Sphere
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import advance_worlds, motion, record_worlds, repeat, undamped

WORLDS, DT, RADIUS = 64, 1 / 60, 0.5
AXES = {2: np.eye(3)[:2], 3: np.eye(3)}


def corner(normals, restitution, gravity=0.0):
    """Planes through the origin, and a ball."""
    builder = SceneBuilder(gravity=(0, -gravity, 0))
    surface = {"friction": 0.0, "restitution": restitution}
    for normal in normals:
        builder.add_body(Plane(normal=normal, offset=0.0), static=True, **surface)
    builder.add_body(Sphere(RADIUS), mass=2.0, position=(5, 5, 5), **surface)
    return builder.build(undamped(dt=DT))


def flights(state, place, velocity):
    """One world for each row of centres and velocities (world, 3) of the ball."""
    states = repeat(state, len(place))
    return dataclasses.replace(
        states,
        position=states.position.at[:, -1].set(jnp.asarray(place, states.position.dtype)),
        velocity=states.velocity.at[:, -1].set(jnp.asarray(velocity, states.velocity.dtype)),
    )


def into_the_corner(seed):
    """Gaps and speeds towards the walls (world, 3) that all close in the second step, each at its own time."""
    rng = np.random.default_rng(seed)
    speed = rng.uniform(1.0, 200.0, (WORLDS, 3))
    return speed * DT * (1.0 + rng.uniform(0.05, 0.95, (WORLDS, 3))), speed


@pytest.mark.parametrize("restitution", [0.0, 0.6, 1.0])
@pytest.mark.parametrize("walls", [2, 3])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_ball_flies_into_a_corner(precision, walls, restitution, gate):
    """Without friction each axis is alone: the gap closes at speed u and opens at e u, whatever the others do."""
    gap, speed = into_the_corner(walls)
    model, state = corner(AXES[walls], restitution)
    states = flights(state, RADIUS + gap, -speed)
    final = advance_worlds(repeat(model, WORLDS), states, 3)
    time = 3 * DT - gap / speed
    walled = np.arange(3) < walls
    truth = np.where(walled, restitution * speed * time, gap - 3 * DT * speed)
    velocity = np.where(walled, restitution * speed, -speed)
    limit = 50 * np.finfo(precision).eps * (RADIUS + np.abs(gap).max())
    gate("gaps [m]", np.asarray(final.position)[:, -1] - RADIUS - truth, limit)
    gate("velocity [m/s]", np.asarray(final.velocity)[:, -1] - velocity, 50 * np.finfo(precision).eps * 200)


def test_ball_bounces_off_ground_and_wall_under_gravity(float64, gate):
    """The floor's impact is that of a parabola, the wall's that of a uniform motion."""
    gravity, e = 9.81, 0.8
    gap, speed = into_the_corner(0)
    gap[:, 1] += 0.5 * gravity * DT**2
    model, state = corner(AXES[2], e, gravity)
    final = advance_worlds(repeat(model, WORLDS), flights(state, RADIUS + gap, -speed), 3)
    hit = (np.sqrt(speed[:, 1] ** 2 + 2 * gravity * gap[:, 1]) - speed[:, 1]) / gravity
    rise, left = e * (speed[:, 1] + gravity * hit), 3 * DT - hit
    gate("height [m]", np.asarray(final.position)[:, -1, 1] - RADIUS - rise * left + gravity * left**2 / 2, 1e-9)
    across = e * speed[:, 0] * (3 * DT - gap[:, 0] / speed[:, 0])
    gate("distance of the wall [m]", np.asarray(final.position)[:, -1, 0] - RADIUS - across, 1e-9)


def test_derivatives_are_those_of_each_impact(float64, gate):
    """The gap behind a wall is ``e (u t - gap)``, of which each derivative is known."""
    e = 0.7
    gap, speed = into_the_corner(1)
    gap[0], speed[0] = gap[0, 0], speed[0, 0]  # a diagonal flight: both walls at the same time
    model, state = corner(AXES[2], e)

    def place(gap, speed):
        final = advance_worlds(repeat(model, WORLDS), flights(state, RADIUS + gap, -speed), 3)
        return final.position[:, -1, :2].sum()

    by_gap, by_speed = jax.jit(jax.jacfwd(place, (0, 1)))(jnp.asarray(gap), jnp.asarray(speed))
    gate("by the gap", np.asarray(by_gap)[:, :2] + e, 1e-9)
    gate("by the speed [s]", np.asarray(by_speed)[:, :2] - e * 3 * DT, 1e-9)


@pytest.mark.parametrize("restitution", [0.0, 1.0])
def test_ball_in_an_oblique_corner_stays_out_of_the_walls(float64, restitution, gate):
    """Walls that meet at 60 to 150 degrees: not exact, but the ball enters them by a fraction of its way in a step only.

    An elastic one, which the first wall sends at the second within a step, is let in by a fifth of its radius to rebound in
    the next step: stopped, it lost up to two thirds of its energy (the walls take none).
    """
    for degrees in (60.0, 75.0, 105.0, 120.0, 150.0):
        angle = np.radians(degrees)
        normals = np.array([[0.0, 1.0, 0.0], [np.sin(angle), -np.cos(angle), 0.0]])
        rng = np.random.default_rng(3)
        gap, speed = rng.uniform(0.0, 0.1, (WORLDS, 2)), rng.uniform(1.0, 10.0, (WORLDS, 2))
        place, velocity = np.zeros((2, WORLDS, 3))
        place[:, :2] = np.linalg.solve(normals[:, :2], (RADIUS + gap).T).T
        velocity[:, :2] = np.linalg.solve(normals[:, :2], -speed.T).T
        model, state = corner(normals, restitution)
        _, record = record_worlds(repeat(model, WORLDS), flights(state, place, velocity), 60, motion)
        distance = np.asarray(record["position"])[:, :, -1] @ normals.T - RADIUS
        overlap = np.maximum(0.0, -distance.min())
        if restitution:
            gate(f"overlap at {degrees} degrees / radius", overlap / RADIUS, 0.22)
            speeds = np.linalg.norm(np.asarray(record["velocity"])[-1, :, -1], axis=-1)
            gate(f"speed at {degrees} degrees / start - 1", speeds / np.linalg.norm(velocity, axis=1) - 1.0, 1e-5)
        else:
            gate(f"overlap at {degrees} degrees / way of a step", overlap / (10.0 * DT), 0.125)
