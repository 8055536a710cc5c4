"""Derivatives of a chain of three links against those of its equations of motion in reduced coordinates."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import rollout
from tests.physics.test_chain import chain

LINKS, DURATION, STEPS = 3, 0.05, 24
LENGTH = 1 / LINKS


def centres(angles):
    """Centres of the links (link, 2)."""
    along = LENGTH * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    return jnp.cumsum(along, axis=0) - 0.5 * along


def exact_end(parameters):
    """Angles of the links after some time, from gravity and the angular velocities at the start, when the chain is level."""

    def accelerations(angles, rates):
        def mass_matrix(angles):
            by_angle = jax.jacfwd(centres)(angles)
            inertia = LENGTH**3 / 12 * jnp.eye(LINKS)
            return LENGTH * jnp.einsum("kci,kcj->ij", by_angle, by_angle) + inertia

        def lagrangian(angles, rates):
            height = centres(angles)[:, 1].sum()
            return 0.5 * rates @ mass_matrix(angles) @ rates - parameters[0] * LENGTH * height

        force = jax.grad(lagrangian)(angles, rates)
        transport = jax.jvp(lambda a: mass_matrix(a) @ rates, (angles,), (rates,))[1]
        return jnp.linalg.solve(mass_matrix(angles), force - transport)

    def slope(state):
        return jnp.stack([state[1], accelerations(*state)])

    def runge_kutta(state, _):
        dt = DURATION / 200
        k1 = slope(state)
        k2 = slope(state + 0.5 * dt * k1)
        k3 = slope(state + 0.5 * dt * k2)
        k4 = slope(state + dt * k3)
        return state + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), None

    start = jnp.stack([jnp.zeros(LINKS), parameters[1:]])
    return jax.lax.scan(runge_kutta, start, None, length=200)[0][0]


@pytest.mark.slow
def test_derivatives_of_the_angles(float64, gate):
    model, state = chain(LINKS, dt=DURATION / STEPS)

    def end(parameters):
        spin = jnp.zeros_like(state.angular_velocity).at[1:, 2].set(parameters[1:])
        steps = LENGTH * (jnp.cumsum(parameters[1:]) - 0.5 * parameters[1:])
        moving = dataclasses.replace(
            state, angular_velocity=spin, velocity=jnp.zeros_like(state.velocity).at[1:, 1].set(steps)
        )
        falling = dataclasses.replace(model, gravity=jnp.zeros_like(model.gravity).at[1].set(-parameters[0]))
        final, _ = rollout(falling, moving, STEPS)
        return 2.0 * jnp.arctan2(final.orientation[1:, 3], final.orientation[1:, 0])

    weights = jnp.array([1.0, -2.0, 1.5])
    parameters = jnp.array([9.81, 1.0, -2.0, 3.0])
    truth = np.asarray(jax.grad(lambda p: weights @ exact_end(p))(parameters))
    value, backward = jax.jit(jax.value_and_grad(lambda p: weights @ end(p)))(parameters)
    gate("angles [rad]", float(value - weights @ exact_end(parameters)), 1e-4)
    gate("reverse mode - truth", (np.asarray(backward) - truth) / np.abs(truth).max(), 1e-3)
