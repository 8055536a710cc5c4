"""Derivatives of a four-bar linkage, whose hinges hold three rows too many: both modes and central differences."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import rollout
from tests.physics.test_loops import linkage

START = (1.0, 1.0, 1.0)


def end(parameters):
    """The angles of the bars after 12 steps, by gravity, speed of the crank and mass of the coupler."""
    gravity, rate, mass = parameters
    model, state = linkage(2.0, 1.0, dt=1 / 240)
    falling = dataclasses.replace(
        model,
        gravity=model.gravity * gravity,
        mass=model.mass.at[2].mul(mass),
        inertia=model.inertia.at[2].mul(mass),
    )
    moving = dataclasses.replace(state, velocity=state.velocity * rate, angular_velocity=state.angular_velocity * rate)
    final, _ = rollout(falling, moving, 12)
    return 2.0 * jnp.arctan2(final.orientation[1:, 3], final.orientation[1:, 0]) @ jnp.array([1.0, -2.0, 1.5])


@functools.cache
def forward_mode():
    return np.asarray(jax.jit(jax.jacfwd(end))(jnp.array(START)))


@pytest.mark.slow
def test_forward_mode_is_central_differences(float64, gate):
    start = jnp.array(START)
    ends = jax.jit(jax.vmap(end))(jnp.concatenate([start + 1e-5 * jnp.eye(3), start - 1e-5 * jnp.eye(3)]))
    quotient = np.asarray(ends[:3] - ends[3:]) / 2e-5
    gate("forward mode - quotient", (forward_mode() - quotient) / np.abs(quotient).max(), 1e-6)


@pytest.mark.slow
def test_reverse_mode_is_forward_mode(float64, gate):
    backward = np.asarray(jax.jit(jax.grad(end))(jnp.array(START)))
    gate("modes", (forward_mode() - backward) / np.abs(backward).max(), 1e-9)


@pytest.mark.slow
def test_no_derivative_is_nan(float64):
    """By every leaf, also by those that break what the redundant rows agree on."""
    model, state = linkage(2.0, 1.0, dt=1 / 240)

    def end(model, state):
        final, _ = rollout(model, state, 4)
        return final.position.sum() + final.joint_force.sum()

    for leaf in jax.tree.leaves(jax.jit(jax.grad(end, argnums=(0, 1), allow_int=True))(model, state)):
        assert leaf.dtype == jax.dtypes.float0 or np.isfinite(np.asarray(leaf)).all()
