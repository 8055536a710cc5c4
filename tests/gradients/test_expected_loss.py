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
        gate("standard error / scatter - 1", error.mean(1)[inner] / found.std(1)[inner] - 1, 0.25)
    assert (spread[mixed_order] <= spread[zeroth_order] + 1e-12).all()
    assert spread[mixed_order][3] < 0.8 * spread[zeroth_order][3]


SLOPE, DEVIATIONS, PLACE = np.array([1.0, -2.0, 0.5]), np.array([0.1, 0.2, 0.3]), np.array([0.3, 0.2, -0.1])


@functools.partial(jax.jit, static_argnames="pairs")
def mixed_of_a_bowl(heights, keys, pairs):
    """Mixed and zeroth gradients (height, key, entry), standard errors of the mixed; (a . x)^2, a jump at x[0] = 0.25."""

    def one(height, key):
        def loss(x):
            return (SLOPE @ x) ** 2 + jnp.where(x[0] > 0.25, height, 0.0)

        mixed, zeroth = (
            estimator(loss, jnp.asarray(PLACE), key, deviation=DEVIATIONS, pairs=pairs)
            for estimator in (mixed_order, zeroth_order)
        )
        return mixed.gradient, zeroth.gradient, mixed.standard_error

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(heights, keys)


@pytest.mark.parametrize("pairs", [64, 11])  # and of an odd number, whose halves differ
def test_the_standard_error_of_the_mixed_one_is_its_scatter(pairs, float64, gate):
    """Jumps that are not there, that hide in the scatter, and that stand out of it; the mean in closed form."""
    heights, repetitions = np.array([0.0, 0.15, 0.3, 0.6, 1.0, 2.0, 10.0]), 2000
    found, zeroth, error = mixed_of_a_bowl(heights, jax.random.split(jax.random.key(5), repetitions), pairs)
    scatter = np.sqrt(np.var(found, axis=1).sum(-1))
    gate("standard error / scatter - 1", np.mean(error, 1) / scatter - 1, 0.15 if pairs == 64 else 0.2)
    # Without a jump both orders are right, and so is their mixture: no bias beyond what 2000 repetitions tell.
    truth = 2 * (SLOPE @ PLACE) * SLOPE
    gate("bias without a jump [deviations]", (found[0].mean(0) - truth) / found[0].std(0) * repetitions**0.5, 3.5)
    # With one, the bias stays within what is documented, in standard errors of the zeroth order and units of deviations.
    bias = found.mean(1) - (truth + np.outer(heights * norm.pdf(0.5) / 0.1, [1.0, 0.0, 0.0]))
    allowed = np.sqrt(np.var(zeroth * DEVIATIONS, axis=1).sum(-1))
    gate("bias [standard errors of the zeroth order]", np.linalg.norm(bias * DEVIATIONS, axis=1) / allowed, 1.25)


@pytest.mark.parametrize("estimator", [first_order, zeroth_order, mixed_order])
@pytest.mark.parametrize("kind", [np.array, jnp.array])
def test_arrays_of_deviations_under_jit(estimator, kind):
    """As the same numbers one by one; a wrong one is refused there too, though JAX knows no values."""
    parameters = {"a": jnp.ones(2)}

    def gradient(deviation):
        return jax.jit(lambda key: estimator(lambda x: jnp.sum(x["a"] ** 3), parameters, key, deviation=deviation))(
            jax.random.key(0)
        ).gradient["a"]

    np.testing.assert_allclose(gradient({"a": kind([0.1, 0.1])}), gradient(0.1), rtol=1e-5)
    with pytest.raises(ValueError, match="every deviation must be positive"):
        gradient({"a": kind([0.1, -0.1])})


def test_a_loss_without_slope_has_an_estimate_without_error():
    found = jax.jit(lambda key: mixed_order(lambda x: 0.0 * x.sum(), jnp.ones(2), key, deviation=0.1, pairs=4))(
        jax.random.key(0)
    )
    assert not np.any(found.gradient) and found.standard_error == 0.0 and found.first_order_share == 1.0


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
        ({"pairs": 3}, "pairs must be an integer of at least 4, got 3"),
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


def test_one_pair_has_no_scatter():
    for estimator in (first_order, zeroth_order):
        with pytest.raises(ValueError, match="pairs must be an integer of at least 2, got 1"):
            estimator(bend, jnp.zeros(1), jax.random.key(0), deviation=1.0, pairs=1)
