"""Running moments and reward scaling against NumPy on all the data at once."""

import numpy as np

from training.normalization import initial_moments, normalize, update_moments
from training.return_scale import initial_return_scale, scale_rewards


def test_running_moments_equal_those_of_all_samples():
    generator = np.random.default_rng(1)
    batches = [generator.normal(5.0, 3.0, (size, 4, 2)).astype(np.float32) for size in (3, 50, 1)]
    moments = initial_moments(2)
    for batch in batches:
        moments = update_moments(moments, batch)
    everything = np.concatenate(batches).reshape(-1, 2).astype(float)
    np.testing.assert_allclose(moments.mean, everything.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(moments.variance, everything.var(axis=0), rtol=1e-4)
    assert moments.count == len(everything)


def test_normalized_samples_have_mean_zero_and_variance_one():
    samples = np.random.default_rng(2).normal(-2.0, 0.1, (1000, 3)).astype(np.float32)
    scaled = np.asarray(normalize(update_moments(initial_moments(3), samples), samples))
    np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=1e-3)
    np.testing.assert_allclose(scaled.std(axis=0), 1.0, rtol=1e-3)


def test_normalization_clips_outliers():
    assert normalize(initial_moments(1), np.array([1e6], np.float32))[0] == 10.0


def test_rewards_are_divided_by_the_spread_of_the_discounted_return():
    generator = np.random.default_rng(3)
    discount = 0.9
    rewards = generator.normal(size=(2, 30, 4)).astype(np.float32)
    done = generator.random((2, 30, 4)) < 0.1
    scale = initial_return_scale(4)
    returns, running = [], np.zeros(4)
    for rollout in range(2):
        scaled, scale = scale_rewards(scale, rewards[rollout], done[rollout], discount)
        for time in range(30):
            running = discount * running + rewards[rollout, time]
            returns.append(running)
            running = np.where(done[rollout, time], 0.0, running)
        np.testing.assert_allclose(scaled, rewards[rollout] / np.std(returns), rtol=1e-4)
