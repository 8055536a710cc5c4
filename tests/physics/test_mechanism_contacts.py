"""Trees of joints that stand, slide and walk on feet far lighter than what they carry. Closed forms: statics, friction."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import (
    Box,
    Fixed,
    Hinge,
    Plane,
    SceneBuilder,
    Sphere,
    contact_forces,
    is_asleep,
    joint_gaps,
    rollout,
    step,
)
from mathota_jax.constraints import mechanism_layout
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.scenes import DOWN, GRAVITY, undamped

UP = (0.0, 1.0, 0.0)
LIGHT = (0.2, 2.0, 5.0, 50.0)
"""Masses of a foot and of what stands on it."""


def leg(builder, masses, foot=(0.1, 0.02, 0.1), speed=0.0, friction=0.5, shape=None):
    """Blocks welded on top of each other, the first a foot on the ground, of another `shape` if asked for; handles."""
    bodies, level = [], 0.0
    for mass in masses:
        half = (0.05, 0.1, 0.05) if bodies else foot
        body = builder.add_body(
            shape if shape and not bodies else Box(half),
            mass=mass,
            position=(0, level + half[1], 0),
            velocity=(speed, 0, 0),
            friction=friction,
            collides=not bodies,
        )
        if bodies:
            builder.add_joint(Fixed(bodies[-1], body, (0, level, 0)))
        bodies.append(body)
        level += 2 * half[1]
    return bodies


def on_ground(friction=0.5):
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane(UP), static=True, friction=friction)
    return builder


@jax.jit
def stand(model, state):
    """120 steps; one program for all masses and time steps."""
    return rollout(model, state, 120)[0]


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
@pytest.mark.parametrize(
    "masses",
    [LIGHT, (0.002, *LIGHT[1:]), (20.0, 2.0, 1.0, 0.5), pytest.param((0.2, 50.0), marks=pytest.mark.slow)],
    ids=["light", "tiny", "heavy", "of one joint"],
)
def test_a_leg_stands_on_its_foot(precision, masses, dt, gate):
    """A tower of 57 kg on 0.2 kg fell through the ground; where it is slender, rows that pushed at once made it rock."""
    builder = on_ground()
    leg(builder, masses)
    model, state = builder.build(undamped(dt=dt))
    assert mechanism_layout.takes_contacts(model.scene)
    final = stand(model, state)
    gate("moved [m]", np.asarray(final.position - state.position, float), 1e-5)
    gate("speed at the end [m/s]", np.asarray(final.velocity), 1e-5)
    borne = np.asarray(contact_forces(model, final), float)[:, 1].sum()
    gate("borne by the ground / weight - 1", abs(borne) / (GRAVITY * sum(masses)) - 1, 1e-5)


@pytest.mark.slow
def test_a_frictionless_leg_stands(gate):
    builder = on_ground(0.0)
    leg(builder, (0.2, 10.0, 10.0), friction=0.0)
    model, state = builder.build(undamped(dt=1 / 60))
    assert mechanism_layout.takes_contacts(model.scene) and not model.scene.friction
    gate("moved [m]", np.asarray(stand(model, state).position - state.position, float), 1e-5)


@pytest.mark.slow
def test_a_leg_sleeps_and_wakes_as_a_whole(gate):
    builder = on_ground()
    bodies = leg(builder, (0.2, 10.0, 10.0))
    model, state = builder.build(undamped(dt=1 / 60, sleep=True))
    assert mechanism_layout.takes_contacts(model.scene)
    final = stand(model, state)
    assert np.asarray(is_asleep(model, final))[bodies].all()
    gate("moved [m]", np.asarray(final.position - state.position, float), 1e-5)
    pushed = step(model, dataclasses.replace(final, velocity=final.velocity.at[bodies[-1], 0].set(0.5)))
    assert not np.asarray(is_asleep(model, pushed))[bodies].any()


def carry_a_ball(builder, options, gate):
    """Model and final state of a leg that stands and carries a free ball on a plate."""
    last = leg(builder, LIGHT)[-1]
    plate = builder.add_body(Box((0.1, 0.02, 0.1)), mass=0.5, position=(0, 0.66, 0))
    builder.add_joint(Fixed(last, plate, (0, 0.64, 0)))
    builder.add_body(Sphere(0.1), mass=20.0, position=(0, 0.78, 0))
    model, state = builder.build(options)
    assert mechanism_layout.takes_contacts(model.scene)
    final = stand(model, state)
    gate("moved [m]", np.asarray(final.position - state.position, float), 2e-5)
    borne = np.abs(np.asarray(contact_forces(model, final), float)[:, 1]).sum()
    gate("borne by ground and plate / truth - 1", borne / (GRAVITY * (sum(LIGHT) + 0.5 + 2 * 20.0)) - 1, 1e-4)
    return model, final


@pytest.mark.slow
def test_a_leg_carries_a_free_ball(precision, gate):
    """Rows of bodies that are no links are part of the same system."""
    carry_a_ball(on_ground(), undamped(dt=1 / 60), gate)


@pytest.mark.parametrize("ball", slow_but((True,), (True, False)))
def test_a_shelf_on_a_wall(ball, gate):
    """Welded to what never moves, so that the mechanism has no way to move: a ball lies on it, or nothing does."""
    builder = on_ground()
    wall = builder.add_body(Box((0.1, 1.0, 1.0)), static=True, position=(-0.1, 1, 0), collides=False)
    shelf = builder.add_body(Box((0.2, 0.02, 0.2)), mass=0.5, position=(0.2, 0.02, 0), friction=0.5)
    builder.add_joint(Fixed(wall, shelf, (0, 0.02, 0)))
    if ball:
        builder.add_body(Sphere(0.1), mass=2.0, position=(0.2, 0.14, 0), friction=0.5)
    model, state = builder.build(undamped(dt=1 / 60))
    assert mechanism_layout.takes_contacts(model.scene)
    final = stand(model, state)
    gate("moved [m]", np.asarray(final.position - state.position, float), 1e-5)
    if ball:
        on_shelf = np.asarray(contact_forces(model, final), float)[:, 1][-1]
        gate("borne by the shelf / weight - 1", abs(on_shelf) / (2.0 * GRAVITY) - 1, 1e-4)


def slide(speed=2.0, friction=0.25, dt=1 / 60, steps=24):
    """A welded sled whose foot is wide enough not to tip; all the way it slides. The usual sweeps leave 6.5e-4 of it."""
    builder = on_ground(friction)
    bodies = leg(builder, (0.2, 2.0, 5.0, 10.0), (0.6, 0.02, 0.3), speed, friction)
    model, state = builder.build(undamped(dt=dt, velocity_iterations=40))
    assert mechanism_layout.takes_contacts(model.scene)
    return model, state, bodies, steps * dt, steps


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_sled_slides_as_one_body(precision, gate):
    """``v t - mu g t^2 / 2``: exact for one body, whose friction is that of the load."""
    model, state, bodies, time, steps = slide()
    final = jax.jit(lambda state: rollout(model, state, steps)[0])(state)
    way = np.asarray(final.position - state.position, float)[bodies, 0]
    truth = 2.0 * time - 0.25 * GRAVITY * time**2 / 2
    gate("way / truth - 1", way / truth - 1, 1e-4)
    gate("joint gaps [m]", np.asarray(joint_gaps(model, final).translation, float), 1e-6)


def derivatives_of_way(model, state, bodies, time, steps, mode):
    """Of a sled's way by its speed, the coefficients of friction and gravity, over those of ``v t - mu g t^2 / 2``."""

    def way(speed, friction, gravity):
        moving = state.velocity.at[jnp.asarray(bodies), 0].set(speed)
        changed = dataclasses.replace(
            model,
            friction=jnp.full_like(model.friction, friction),
            gravity=jnp.asarray([0.0, -1.0, 0.0]) * gravity,
        )
        return rollout(changed, dataclasses.replace(state, velocity=moving), steps)[0].position[bodies[-1], 0]

    at = (2.0, 0.25, GRAVITY)
    truth = np.array([time, -GRAVITY * time**2 / 2, -0.25 * time**2 / 2])
    return np.asarray(jax.jit(mode(way, (0, 1, 2)))(*at)) / truth


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
def test_derivatives_of_a_sled(float64, gate, mode):
    gate("derivatives / truth - 1", derivatives_of_way(*slide(), mode) - 1, 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
def test_derivatives_on_fewer_rows_than_coordinates(float64, gate, mode):
    """A block welded on a ball: where it rests, all is lifted by what the ball grows; without friction it goes on.

    Of few rows the whole matrix is kept: derivatives of the correction of positions raised an error.
    """
    builder = on_ground(friction=0.0)
    bodies = leg(builder, LIGHT[:2], speed=2.0, friction=0.0, shape=Sphere(0.02))
    model, state = builder.build(undamped(dt=1 / 240))
    assert mechanism_layout.takes_contacts(model.scene)

    def place(speed, radius):
        moving = state.velocity.at[jnp.asarray(bodies), 0].set(speed)
        shapes = {**model.shapes, "sphere": {**model.shapes["sphere"], "radius": jnp.full((1,), radius)}}
        changed = dataclasses.replace(model, shapes=shapes)
        final = rollout(changed, dataclasses.replace(state, velocity=moving), 60)[0]
        return final.position[bodies[-1], :2]

    by_speed, by_radius = jax.jit(mode(place, (0, 1)))(2.0, 0.02)
    gate("way, height by speed [s]", np.asarray(by_speed) - [60 / 240, 0.0], 1e-6)
    gate("way, height by radius", np.asarray(by_radius) - [0.0, 1.0], 1e-6)


@pytest.mark.slow
def test_a_table_on_driven_legs(precision, gate):
    """Legs that motors hold still bear the weight; they may share it as they like. The usual sweeps move it by 0.3 mm."""
    builder = on_ground()
    top = builder.add_body(Box((0.3, 0.05, 0.2)), mass=40.0, position=(0, 0.45, 0), collides=False)
    for x in (-0.25, 0.25):
        for z in (-0.15, 0.15):
            foot = builder.add_body(Sphere(0.05), mass=0.3, position=(x, 0.05, z), friction=0.8)
            builder.add_motor(builder.add_joint(Hinge(top, foot, (x, 0.4, z), (0, 0, 1))), kind="velocity", cap=100.0)
    model, state = builder.build(undamped(dt=1 / 60, velocity_iterations=40))
    assert mechanism_layout.takes_contacts(model.scene)
    actions = jnp.zeros((60, 4), state.position.dtype)
    final = jax.jit(lambda state: rollout(model, state, actions)[0])(state)
    gate("moved [m]", np.asarray(final.position - state.position, float), 1e-4)
    gate("speed at the end [m/s]", np.asarray(final.velocity), 1e-4)
    borne = np.abs(np.asarray(contact_forces(model, final), float)[:, 1]).sum()
    gate("borne by the ground / weight - 1", borne / (GRAVITY * (40.0 + 4 * 0.3)) - 1, 1e-4)
