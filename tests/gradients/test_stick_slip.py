"""A pushed block sticks or slips; the derivative jumps with it (benchmark C11)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import apply_force, step
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import GRAVITY, slab_on_plane, undamped

FRICTION = 0.4
THRESHOLD = FRICTION * GRAVITY
COUNT = 240


@jax.jit
def push(force, friction, model, state):
    """Velocity along a push of constant `force` [N] on the 1 kg block for 1 s from rest."""
    model = dataclasses.replace(model, friction=jnp.full_like(model.friction, friction))

    def body(current, _):
        pushed = apply_force(current, 1, jnp.array([1.0, 0.0, 0.0]) * force, current.position[1])
        return step(model, pushed), None

    final, _ = jax.lax.scan(body, state, None, length=COUNT)
    return final.velocity[1, 0]


@jax.jit
def push_with_slopes(force, friction, model, state):
    both = jax.value_and_grad(push, argnums=(0, 1))
    return jax.vmap(both, in_axes=(0, None, None, None))(force, friction, model, state)


def pushed(factors):
    model, state = slab_on_plane(friction=FRICTION, options=undamped(dt=1 / COUNT))
    force = jnp.asarray(factors) * THRESHOLD
    velocity, (by_force, by_friction) = push_with_slopes(force, jnp.asarray(FRICTION), model, state)
    return np.asarray(force, dtype=float), *(np.asarray(x, dtype=float) for x in (velocity, by_force, by_friction))


FACTORS = (0.0, 0.5, 0.9, 0.99, 1.0, 1.01, 1.1, 6.0 / THRESHOLD, 3.0)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_both_sides_of_the_threshold(precision, gate):
    factors = np.array(FACTORS)
    force, velocity, by_force, by_friction = pushed(factors)
    limit = {"float32": 1e-3, "float64": 1e-4}[str(precision)]
    sticks, slips = factors <= 0.99, factors >= 1.01
    gate("sticking: v [m/s]", velocity[sticks], limit)
    gate("sticking: dv/dF [1/kg s]", by_force[sticks], limit)
    gate("sticking: dv/dmu [m/s]", by_friction[sticks], limit * GRAVITY)
    gate("slipping: v - truth [m/s]", velocity[slips] - (force[slips] - THRESHOLD), limit * 10)
    gate("slipping: dv/dF - 1", by_force[slips] - 1.0, limit * 10)
    gate("slipping: dv/dmu / truth - 1", by_friction[slips] / -GRAVITY - 1, limit * 10)
    assert velocity[FACTORS.index(6.0 / THRESHOLD)] == pytest.approx(2.076, abs=limit * 10)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_at_the_threshold_the_derivative_is_a_sub_gradient(precision):
    _, velocity, by_force, by_friction = pushed(np.array(FACTORS))
    at = FACTORS.index(1.0)
    assert abs(velocity[at]) < 1e-2
    assert -1e-3 <= by_force[at] <= 1 + 1e-3
    assert -GRAVITY * (1 + 1e-3) <= by_friction[at] <= 1e-2
