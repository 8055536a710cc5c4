"""`rollout`: compiled once without a `jit` around it, equal to steps in a row, and clear about what it is given."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import rollout, step
from mathota_jax.gradients import long_rollout
from mathota_jax.step import _run
from tests.scenes import sphere_on_plane


def thrown(speed):
    model, state = sphere_on_plane(height=0.2)
    return model, dataclasses.replace(state, velocity=state.velocity.at[1, 0].set(speed))


def test_called_as_it_is_it_is_compiled_once():
    model, state = thrown(1.0)
    first, _ = rollout(model, state, 7)
    compiled = _run._cache_size()
    heavier = dataclasses.replace(model, mass=2.0 * model.mass)
    second, _ = rollout(heavier, thrown(3.0)[1], np.int64(7))
    assert _run._cache_size() == compiled
    moved = second.position[1, 0] - state.position[1, 0]
    np.testing.assert_allclose(moved, 3.0 * (first.position[1, 0] - state.position[1, 0]), rtol=1e-5)


def test_the_trajectory_is_that_of_steps():
    model, state = thrown(1.0)
    final, trajectory = rollout(model, state, 3)
    one = jax.jit(step)
    for k in range(3):
        state = one(model, state)
        np.testing.assert_allclose(trajectory.position[k], state.position, rtol=1e-6, atol=1e-7)
    jax.tree.map(np.testing.assert_array_equal, final, jax.tree.map(lambda leaf: leaf[-1], trajectory))


@pytest.mark.parametrize("run", [rollout, long_rollout])
def test_what_does_not_fit_is_named(run):
    name, (model, state) = run.__name__, thrown(1.0)
    with pytest.raises(ValueError, match=rf"{name}: the number of steps must be an integer of at least 0, got -1"):
        run(model, state, -1)
    with pytest.raises(ValueError, match=rf"{name}: actions must have shape \(steps, 0\), got \(5, 1\)"):
        run(model, state, jnp.zeros((5, 1)))
    wanted = r"actions must be an array of shape \(steps, 0\) or a whole number of steps"
    for given in (None, {}, "five"):
        with pytest.raises(ValueError, match=rf"{name}: {wanted}, got a {type(given).__name__}"):
            run(model, state, given)
    with pytest.raises(
        ValueError, match=rf"{name}: the number of steps must be known at compilation: jax\.jit\({name}"
    ):
        jax.jit(run)(model, state, 5)
    with pytest.raises(ValueError, match=rf"{name}: expected a Model and a State, in this order"):
        run(state, model, 5)


def test_two_precisions_are_refused(float64):
    model, state = thrown(1.0)
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == jnp.float64 else leaf, state)
    with pytest.raises(
        ValueError, match=r"one precision, but state\.position is float32, model\.\w+ is float64; build both in it"
    ):
        step(model, single)
    # A Python number takes the precision of the others.
    assert step(dataclasses.replace(model, dt=1e-3), state).position.dtype == jnp.float64
