"""Bodies that spin fast: nothing acts on them before something is within their reach."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Capsule, Plane, SceneBuilder, rollout
from tests.marks import slow_but
from tests.scenes import motion, record_worlds, repeat, undamped

WORLDS, DT, STEPS = 256, 1 / 60, 100
SPEED, SPIN = 0.5, 60.0
REACH = 0.6
SHAPES = {"box": Box((REACH / 3**0.5,) * 3), "rod": Capsule(0.1, REACH - 0.1)}
WAYS = {
    "pgs": {},
    "soft_step": {"solver": "soft_step"},
    "converged": {"solver": "converged"},
    "split": {"impact_events": 2},
}
CASES = [f"{shape}-{way}" for shape in SHAPES for way in WAYS]


def falling(shape, way):
    """Two bodies over a plane, one above the other, out of each other's reach, without gravity."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"friction": 0.5, "restitution": 0.5}
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, **surface)
    for height in (2.0, 4.2):
        builder.add_body(SHAPES[shape], mass=1.0, position=(0, height * REACH, 0), velocity=(0, -SPEED, 0), **surface)
    return builder.build(undamped(dt=DT, **WAYS[way]))


def spinning(state):
    """A batch in all orientations, about all axes."""
    generator = np.random.default_rng(0)
    turn, axis = generator.normal(size=(WORLDS, 2, 4)), generator.normal(size=(WORLDS, 2, 3))
    states = repeat(state, WORLDS)
    return dataclasses.replace(
        states,
        orientation=states.orientation.at[:, 1:].set(turn / np.linalg.norm(turn, axis=-1, keepdims=True)),
        angular_velocity=states.angular_velocity.at[:, 1:].set(
            SPIN * axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        ),
    )


@pytest.mark.parametrize("case", slow_but(("box-pgs",), CASES))
def test_nothing_acts_on_what_is_out_of_reach(case, gate):
    """A corner that turns by a radian a step was taken to go straight on: bodies left the ground unseen at 7 m/s."""
    model, state = falling(*case.split("-"))
    _, record = record_worlds(repeat(model, WORLDS), spinning(state), STEPS, motion)
    free = np.arange(1, STEPS + 1) * DT * SPEED < REACH - SPEED * DT
    change = np.abs(np.asarray(record["velocity"])[free][:, :, 1:] - np.asarray([0, -SPEED, 0]))
    gate("change of velocity [m/s]", change, 1e-5)
    change = np.abs(np.asarray(record["velocity"])[-1, :, 1, 1] + SPEED)
    assert (change > 0.1).mean() > 0.7, "and then most have met the ground"


@pytest.mark.parametrize("case", slow_but((), ("box-pgs", "box-soft_step")))
def test_derivative_is_that_of_free_flight(case, float64, gate):
    """By the velocity at the start it is the time, by the place 1, by the spin 0."""
    model, state = falling(*case.split("-"))
    states, steps = jax.tree.map(lambda leaf: leaf[:16], spinning(state)), 20

    def place(position, velocity, spin, start):
        start = dataclasses.replace(start, position=position, velocity=velocity, angular_velocity=spin)
        return rollout(model, start, jnp.zeros((steps, 0)))[0].position[1, 1]

    by = jax.jit(jax.vmap(jax.grad(place, argnums=(0, 1, 2))))
    position, velocity, spin = by(states.position, states.velocity, states.angular_velocity, states)
    one = jnp.zeros_like(position).at[:, 1, 1].set(1.0)
    gate("by the place - 1", position - one, 1e-9)
    gate("by the velocity - time [s]", velocity - steps * DT * one, 1e-9)
    gate("by the spin", spin, 1e-9)
