"""Restitution: apexes, energy, rest after the Zeno time, and the frictional bounce (benchmark A12)."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Plane, SceneBuilder, Sphere
from tests.scenes import (
    DOWN,
    GRAVITY,
    advance_worlds,
    motion,
    per_body,
    record_worlds,
    repeat,
    sphere_on_plane,
    stack,
    undamped,
    with_dt,
)

RESTITUTIONS = (0.0, 0.25, 0.5, 0.75, 0.8, 0.9, 1.0)
RADIUS, HEIGHT = 0.1, 1.0
FALL_TIME = np.sqrt(2 * HEIGHT / GRAVITY)


def height_reached(record, world, index):
    """Apex [m] of the flight through a sample: exact, unlike the largest of the samples."""
    speed = float(record["velocity"][index, world, 1, 1])
    return float(record["position"][index, world, 1, 1]) - RADIUS + speed**2 / (2 * GRAVITY)


def drop(dt, duration):
    model, state = sphere_on_plane(height=HEIGHT, restitution=0.5)
    models = with_dt(repeat(model, len(RESTITUTIONS)), dt)
    models = dataclasses.replace(models, restitution=per_body(RESTITUTIONS, models.restitution))
    _, record = record_worlds(models, repeat(state, len(RESTITUTIONS)), round(duration / dt), motion)
    return {name: np.asarray(values, dtype=float) for name, values in record.items()}


@pytest.mark.parametrize(("dt", "duration"), [(1 / 240, 10.0), (1 / 60, 5.0)])
def test_dropped_sphere(precision, dt, duration, gate):
    record = drop(dt, duration)
    height, speed = record["position"][:, :, 1, 1] - RADIUS, record["velocity"][:, :, 1, 1]
    for world, e in enumerate(RESTITUTIONS):
        for bounce in (1, 2, 3):
            rise = FALL_TIME * e**bounce
            if 2 * rise < 3 * dt:
                break  # too short a flight to contain a sample for certain
            middle = FALL_TIME * (1 + 2 * sum(e**earlier for earlier in range(1, bounce))) + rise
            apex = height_reached(record, world, round(middle / dt) - 1)
            gate(f"e={e}: apex {bounce} / truth - 1", apex / (e ** (2 * bounce) * HEIGHT) - 1, 0.01)
        gate(f"e={e}: rise above the start [m]", max(0.0, height[:, world].max() - HEIGHT), 0.005 * HEIGHT)
        gate(f"e={e}: overlap with the plane [m]", min(0.0, height[:, world].min()), 1e-3)
        if e < 0.85:  # at rest since the Zeno time, 4.06 s at the latest
            last = slice(round(4.5 / dt), None)
            gate(f"e={e}: jitter at rest [m]", height[last, world], 1e-3)
            gate(f"e={e}: speed at rest [m/s]", speed[last, world], 1e-2)
    mechanical = 0.5 * speed[:, -1] ** 2 + GRAVITY * (height[:, -1])
    ratio = mechanical / (GRAVITY * HEIGHT)
    gate("e=1: lost energy ratio", max(0.0, 1 - ratio.min()), 1e-3)
    gate("e=1: gained energy ratio", max(0.0, ratio.max() - 1), 5e-4)


def test_zeno_bounces_of_half_restitution_end_on_time(float64):
    """The flight between bounces shrinks to nothing at 3 t0 = 1.3546 s when e = 0.5."""
    dt = 1 / 240
    record = drop(dt, 10.0)
    speed = np.abs(record["velocity"][:, RESTITUTIONS.index(0.5), 1, 1])
    end = FALL_TIME * (1 + 0.5) / (1 - 0.5)
    assert end == pytest.approx(1.354571, abs=1e-6)
    moving = np.flatnonzero(speed > 0.05)[-1] * dt
    assert end - 0.05 < moving < end + 0.02


# Benchmark A12c: (friction, forward spin before) -> (v_x, v_y, forward spin after).
FRICTIONAL = [
    (0.1, 0.0, 2.28, 3.2, 18.0),
    (0.5, 0.0, 15 / 7, 3.2, 150 / 7),
    (0.5, -100.0, -0.6, 3.2, -10.0),
]


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
def test_frictional_bounce(precision, dt, gate):
    rng = np.random.default_rng(0)
    cases = [(mu, spin) for mu, spin, *_ in FRICTIONAL]
    cases += list(zip(rng.uniform(0.02, 0.6, 13), rng.uniform(-80, 80, 13), strict=True))
    friction, spin = (np.array(column) for column in zip(*cases, strict=True))
    model, state = sphere_on_plane(height=0.3, gravity=(0, 0, 0), restitution=0.8, velocity=(3.0, -4.0, 0.0))
    models, states = with_dt(repeat(model, len(cases)), dt), repeat(state, len(cases))
    models = dataclasses.replace(models, friction=per_body(friction, models.friction))
    turning = states.angular_velocity.at[:, 1, 2].set(jnp.asarray(-spin))  # forward rolling turns about -Z
    final = advance_worlds(models, dataclasses.replace(states, angular_velocity=turning), round(0.2 / dt))

    normal_impulse = 1.8 * 4.0
    slip = 3.0 - RADIUS * spin
    tangential = np.minimum(friction * normal_impulse, 2 / 7 * np.abs(slip)) * np.sign(slip)
    truth = np.stack([3.0 - tangential, np.full_like(slip, 3.2), spin + tangential / (0.4 * RADIUS)], axis=-1)
    np.testing.assert_allclose(truth[:3], [row[2:] for row in FRICTIONAL], atol=1e-6)
    measured = np.stack([final.velocity[:, 1, 0], final.velocity[:, 1, 1], -final.angular_velocity[:, 1, 2]], axis=-1)
    scale = np.array([5.0, 5.0, 50.0])
    gate(
        "velocity and spin after the bounce",
        (measured - truth) / scale,
        {"float32": 1e-5, "float64": 1e-9}[str(precision)],
    )


def test_frictional_bounce_off_axis(float64, gate):
    """The friction impulse opposes the slip in the plane, whatever its direction."""
    angle = np.radians([0.0, 17.0, 45.0, 90.0, 200.0])
    worlds = [
        sphere_on_plane(
            height=0.3,
            gravity=(0, 0, 0),
            restitution=0.8,
            friction=0.1,
            velocity=(3.0 * np.cos(a), -4.0, 3.0 * np.sin(a)),
            options=undamped(dt=1 / 240),
        )
        for a in angle
    ]
    final = advance_worlds(stack([m for m, _ in worlds]), stack([s for _, s in worlds]), 48)
    truth = np.stack([2.28 * np.cos(angle), np.full_like(angle, 3.2), 2.28 * np.sin(angle)], axis=-1)
    gate("velocity after the bounce [m/s]", final.velocity[:, 1] - truth, 1e-9)


def test_elastic_box_never_rises_above_its_start(precision, gate):
    """A box that lands flat on a smaller one meets it in four points at once (benchmark A12b)."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Box((0.375, 0.25, 0.375)), static=True, restitution=1.0, friction=0.0)
    builder.add_body(Box((0.5, 0.5, 0.5)), mass=1.0, position=(0.0, 0.75 + 10.0, 0.0), restitution=1.0, friction=0.0)
    model, state = builder.build(undamped(dt=1 / 240))
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), 1440, motion)  # the second apex is at 5.7 s
    height = np.asarray(record["position"][:, 0, 1, 1], dtype=float) - 0.75
    gate("rise above the start / drop", max(0.0, height.max() / 10 - 1), 0.005)
    gate("apex / drop - 1", height[960:].max() / 10 - 1, 0.01)
    gate("spin [rad/s]", record["angular_velocity"][:, 0, 1], 1e-2)


def test_what_rests_stays_quiet_where_something_else_bounces(gate):
    """Round-off of the velocities of a stack is no impact: in a scene with restitution it shook at 0.1 m/s for ever."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, restitution=1.0)
    for x in (0.0, 2.0):
        for level in range(2):
            builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, position=(x, 0.1 + 0.2 * level, 0.0))
    builder.add_body(Sphere(0.1), mass=1.0, restitution=1.0, position=(-2.0, 1.0, 0.0))
    model, state = builder.build(undamped(dt=1 / 60))
    final = advance_worlds(repeat(model, 1), repeat(state, 1), 120)
    gate("speed of the boxes [m/s]", final.velocity[0, 1:5], 1e-4)
    assert np.linalg.norm(final.velocity[0, 5]) > 0.1 or final.position[0, 5, 1] > 0.5
