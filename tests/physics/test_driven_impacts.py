"""Impacts that other impacts of the same step bring about, and rebounds of what carries a load."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Plane, SceneBuilder, Sphere, step
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import advance_worlds, repeat, undamped

WORLDS, DT, RADIUS, MASS = 64, 1 / 60, 0.5, 2.0


def row_of_balls(count, restitution, wall=None):
    """Balls along x without gravity, to be placed; `wall` is where one stops them."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"friction": 0.0, "restitution": restitution}
    if wall is not None:
        builder.add_body(Plane(normal=(-1, 0, 0), offset=-wall), static=True, **surface)
    for number in range(count):
        builder.add_body(Sphere(RADIUS), mass=MASS, position=(2.0 * number, 0, 0), **surface)
    return builder.build(undamped(dt=DT))


def approaching(model, state, gaps, speed):
    """A world for each row of gaps between the balls; the first one flies at the others."""
    balls = ~np.asarray(model.scene.static)
    place = np.cumsum(np.concatenate([np.zeros((WORLDS, 1)), 2 * RADIUS + gaps], axis=1), axis=1)[:, : balls.sum()]
    states = repeat(state, WORLDS)
    position, velocity = np.array(states.position), np.array(states.velocity)
    position[:, balls, 0] = place
    velocity[:, np.flatnonzero(balls)[0], 0] = speed
    return dataclasses.replace(
        states,
        position=jnp.asarray(position, states.position.dtype),
        velocity=jnp.asarray(velocity, states.velocity.dtype),
    )


@pytest.mark.parametrize("restitution", [0.5, 1.0])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_row_passes_the_impact_on_within_a_step(precision, restitution, gate):
    """Impacts of equal balls one after the other: each passes on (1 + e) / 2 of its speed, and keeps the rest."""
    e, rng = restitution, np.random.default_rng(0)
    speed = rng.uniform(1.0, 2.0, WORLDS)
    gaps = rng.uniform((0.0, 0.3), (0.3, 0.5), (WORLDS, 2)) * speed[:, None] * DT
    model, state = row_of_balls(3, e)
    final = advance_worlds(repeat(model, WORLDS), approaching(model, state, gaps, speed), 2)
    keeps, passes = (1 - e) / 2, (1 + e) / 2
    truth = np.array([keeps, passes * keeps, passes * passes])
    limit = {"float32": 1e-5, "float64": 1e-12}[str(precision)]
    gate("velocities / that of the first ball", np.asarray(final.velocity)[..., 0] / speed[:, None] - truth, limit)


def test_a_ball_driven_against_a_wall_comes_back(float64, gate):
    """An elastic ball hits one that is close to a wall: the wall turns that one back, which sends the first one back."""
    rng = np.random.default_rng(1)
    speed = rng.uniform(2.0, 5.0, WORLDS)
    gaps = np.stack([rng.uniform(0.0, 0.5, WORLDS), np.full(WORLDS, 0.2)], axis=1) * speed[:, None] * DT
    wall = 3 * RADIUS + gaps.sum(1)
    model, state = row_of_balls(2, 1.0, wall=0.0)
    states = approaching(model, state, gaps, speed)
    states = dataclasses.replace(states, position=states.position - jnp.asarray(wall)[:, None, None] * jnp.eye(3)[0])
    model, depth = repeat(model, WORLDS), 0.0
    for _ in range(12):
        states = advance_worlds(model, states, 1)
        depth = np.maximum(depth, np.asarray(states.position)[:, 2, 0] + RADIUS)
    gate(
        "velocities / the first one",
        np.asarray(states.velocity)[:, 1:, 0] / speed[:, None] - np.array([-1.0, 0.0]),
        1e-12,
    )
    gate("way into the wall / radius", np.maximum(0.0, depth).max() / RADIUS, 0.2)


@pytest.mark.parametrize("restitution", [0.5, 1.0])
def test_bounces_of_less_than_a_step_end_on_the_ground(float64, restitution, gate):
    """Dropped from less than it falls in a step: what carries a load closes its gap, and does not hover."""
    builder = SceneBuilder(gravity=(0, -9.81, 0))
    surface = {"friction": 0.0, "restitution": restitution}
    builder.add_body(Plane((0, 1, 0)), static=True, **surface)
    ball = builder.add_body(Sphere(RADIUS), mass=MASS, position=(0, RADIUS, 0), **surface)
    model, state = builder.build(undamped(dt=DT))
    height = (np.linspace(0.05, 3.0, WORLDS) * 9.81 * DT) ** 2 / (2 * 9.81)
    states = repeat(state, WORLDS)
    states = dataclasses.replace(states, position=states.position.at[:, ball, 1].add(jnp.asarray(height)))
    states = advance_worlds(repeat(model, WORLDS), states, 299)
    final = advance_worlds(repeat(model, WORLDS), states, 1)
    rise, speed = np.asarray(final.position)[:, ball, 1] - RADIUS, np.asarray(final.velocity)[:, ball, 1]
    energy = (9.81 * rise + 0.5 * speed**2) / (9.81 * height)
    gate("energy beyond that of the start", np.maximum(0.0, energy - 1.0), 1e-6)
    still = np.maximum(np.abs(speed), np.abs(states.velocity)[:, ball, 1]) < 1e-9
    assert still[: WORLDS // 4].all()
    gate("height of those at rest [m]", rise[still], 1e-9)


def test_balls_in_a_bin_come_to_rest(gate):
    """27 balls of restitution 0.3: rebounds of what carries others kept them going, at what gravity gives in a step."""
    builder = SceneBuilder(gravity=(0, -9.81, 0))
    surface = {"friction": 0.5, "restitution": 0.3}
    builder.add_body(Plane((0, 1, 0)), static=True, **surface)
    for normal in ((1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1)):
        builder.add_body(Plane(normal, -0.35), static=True, **surface)
    jitter = np.random.default_rng(0).uniform(-0.01, 0.01, (27, 3))
    for number in range(27):
        place = 0.22 * np.array([number % 3 - 1, number // 9, number // 3 % 3 - 1]) + (0, 0.15, 0) + jitter[number]
        builder.add_body(Sphere(0.1), mass=1.0, position=place, **surface)
    model, state = builder.build(undamped(dt=DT))

    def advance(state, _):
        state = step(model, state)
        return state, jnp.linalg.norm(state.velocity, axis=-1).max()

    final, speeds = jax.jit(lambda state: jax.lax.scan(advance, state, length=360))(state)
    assert not int(final.flags)
    gate("fastest ball in the last second [m/s]", speeds[-60:], 0.03)
