"""Estimators of the gradient of an expected loss against closed forms: where the loss jumps, and where it only bends."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from mathota_jax import Plane, SceneBuilder, Sphere, rollout
from mathota_jax.gradients import first_order, mixed_order, zeroth_order
from tests.scenes import undamped

SIGMA = 0.1


def jump(x):
    """1 beyond 0 and a slope of 0.3 everywhere: E = 0.3 x + Phi(x / sigma), slope 0.3 + phi(x / sigma) / sigma."""
    return 0.3 * x[0] + jnp.where(x[0] > 0, 1.0, 0.0)


def bend(x):
    """max(x, 0): slope of the mean Phi(x / sigma)."""
    return jnp.maximum(x[0], 0.0)


@functools.partial(jax.jit, static_argnames=("estimator", "loss", "pairs"))
def estimates(places, estimator, loss, pairs, seeds):
    """Gradients (place, seed) and their standard errors."""

    def one(place, seed):
        found = estimator(loss, place[None], jax.random.key(seed), deviation=SIGMA, pairs=pairs)
        return found.gradient[0], found.standard_error, found.first_order_share

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(places, seeds)


PLACES = np.array([-0.3, -0.1, -0.05, 0.02, 0.08, 0.15, 0.3])
SEEDS = np.arange(200)


def test_a_jump_misleads_the_first_order_alone(float64, gate):
    truth = 0.3 + norm.pdf(PLACES / SIGMA) / SIGMA
    first, *_ = estimates(PLACES, first_order, jump, 64, SEEDS)
    np.testing.assert_allclose(first, 0.3, atol=1e-12)  # sure of itself, and wrong by up to a factor of 14
    scatter = np.ones(len(PLACES))
    for estimator in (zeroth_order, mixed_order):
        few, *_ = estimates(PLACES, estimator, jump, 64, SEEDS)
        many, _, share = estimates(PLACES, estimator, jump, 4096, SEEDS[:20])
        gate(f"{estimator.__name__}: mean of many samples / truth - 1", many.mean(1) / truth - 1, 0.1)
        # The bias that the mixed one allows is a standard error of the zeroth order; the mean of 200 scatters by 0.07 of it.
        scatter = scatter if estimator is mixed_order else few.std(1)
        gate(f"{estimator.__name__}: bias of few samples [scatter]", (few.mean(1) - truth) / scatter, 1.2)
        assert (share[2:5] < 0.2).all()


def test_a_bend_is_no_obstacle_and_the_mixed_one_scatters_least(float64, gate):
    truth = norm.cdf(PLACES / SIGMA)
    spread = {}
    for estimator in (first_order, zeroth_order, mixed_order):
        found, error, _ = estimates(PLACES, estimator, bend, 64, SEEDS)
        gate(f"{estimator.__name__}: mean - truth", found.mean(1) - truth, 0.05)
        spread[estimator] = found.std(1)
        # The stated standard error is the scatter that is seen, where anything scatters.
        inner = slice(1, -1)
        if estimator is not mixed_order:  # whose share depends on the samples
            gate("standard error / scatter - 1", error.mean(1)[inner] / found.std(1)[inner] - 1, 0.25)
    assert (spread[mixed_order] <= spread[zeroth_order] + 1e-12).all()
    assert spread[mixed_order][3] < 0.8 * spread[zeroth_order][3]


def ball_and_wall():
    """A ball of radius 0.1 flies along x with 2 m/s at a wall at 1.15 m."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"restitution": 1.0, "friction": 0.0}
    builder.add_body(Sphere(0.1), mass=1.0, position=(-1.0, 0.0, 0.0), velocity=(2.0, 0.0, 0.0), **surface)
    builder.add_body(Plane((-1, 0, 0), -1.15), static=True, **surface)
    return builder.build(undamped(dt=1 / 60))


def test_an_engine_rollout(float64, gate):
    """Probability that a ball has bounced off a wall within 1 s: Phi((x0 + 0.95) / sigma) for a start spread by sigma."""
    model, state = ball_and_wall()

    def touched(start):
        begin = dataclasses.replace(state, position=state.position.at[0, 0].set(start["x"]))
        final, _ = rollout(model, begin, 60)
        return jnp.where(final.velocity[0, 0] < 0, 1.0, 0.0)

    sigma, place = 0.2, -0.85  # it touches within 1 s if it starts beyond 1.15 - 0.1 - 2 = -0.95
    estimate = jax.jit(
        lambda key: mixed_order(touched, {"x": jnp.asarray(place)}, key, deviation={"x": sigma}, pairs=4000)
    )(jax.random.key(0))
    truth = norm.pdf((place + 0.95) / sigma) / sigma
    gate("slope / truth - 1", estimate.gradient["x"] / truth - 1, 0.1)
    gate("probability", estimate.value - norm.cdf((place + 0.95) / sigma), 0.02)
    first = jax.jit(lambda key: first_order(touched, {"x": jnp.asarray(place)}, key, deviation={"x": sigma}))
    assert first(jax.random.key(0)).gradient["x"] == 0.0


def test_deviations_of_each_entry(float64):
    """A quadratic: all three are exact in the mean, whatever the units of its parameters."""

    def loss(x):
        return jnp.sum(x["a"] ** 2) + 1e4 * x["b"] ** 2

    parameters = {"a": jnp.array([1.0, -2.0]), "b": jnp.asarray(0.03)}
    deviation = {"a": 0.1, "b": 1e-3}
    for estimator in (first_order, zeroth_order, mixed_order):
        found = estimator(loss, parameters, jax.random.key(1), deviation=deviation, pairs=20_000)
        np.testing.assert_allclose(found.gradient["a"], [2.0, -4.0], atol=0.1)
        np.testing.assert_allclose(found.gradient["b"], 600.0, rtol=0.03)
        expected = 5.0 + 9.0 + 2 * 0.1**2 + 1e4 * 1e-6
        np.testing.assert_allclose(found.value, expected, rtol=2e-3)
    assert math.isfinite(float(found.standard_error))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"pairs": 1}, "pairs must be an integer of at least 2, got 1"),
        ({"deviation": 0.0}, "every deviation must be positive"),
        ({"parameters": jnp.array([1])}, "the parameters must be floats"),
        ({"parameters": {"count": jnp.array([1]), "speed": 1.0}}, "the parameters must be floats, got int"),
        ({"tolerance": -1.0}, "tolerance must be at least 0"),
    ],
)
def test_bad_arguments(arguments, message):
    given = {"parameters": jnp.zeros(1), "deviation": 1.0, **arguments}
    parameters = given.pop("parameters")
    with pytest.raises(ValueError, match=message):
        mixed_order(bend, parameters, jax.random.key(0), **given)
