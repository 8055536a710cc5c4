"""Generalized advantages against the definition: the sum over later errors, one by one."""

import numpy as np
import pytest

from training.gae import generalized_advantages

DISCOUNT, TRACE_DECAY = 0.93, 0.87


def direct_sum(rewards, values, next_values, terminated, truncated, discount, trace_decay):
    """Sum of (discount lambda)^k times the k-th later error, up to the end of the episode, in float64."""
    step_count = len(rewards)
    errors = [rewards[t] + (0.0 if terminated[t] else discount * next_values[t]) - values[t] for t in range(step_count)]
    advantages = np.zeros(step_count)
    for t in range(step_count):
        for later in range(t, step_count):
            advantages[t] += (discount * trace_decay) ** (later - t) * errors[later]
            if terminated[later] or truncated[later]:
                break
    return advantages


@pytest.mark.parametrize("end_probability", [0.0, 0.15, 1.0])
def test_agrees_with_direct_sum(end_probability):
    generator = np.random.default_rng(0)
    shape = (40, 6)
    rewards, values, next_values = generator.normal(size=(3, *shape))
    terminated = generator.random(shape) < end_probability
    truncated = generator.random(shape) < end_probability
    advantages, targets = generalized_advantages(
        *(array.astype(np.float32) for array in (rewards, values, next_values)),
        terminated,
        truncated,
        DISCOUNT,
        TRACE_DECAY,
    )
    for world in range(shape[1]):
        columns = (array[:, world] for array in (rewards, values, next_values, terminated, truncated))
        expected = direct_sum(*columns, DISCOUNT, TRACE_DECAY)
        np.testing.assert_allclose(advantages[:, world], expected, atol=2e-5)
        np.testing.assert_allclose(targets[:, world], expected + values[:, world], atol=2e-5)


@pytest.mark.parametrize(
    ("terminated", "truncated", "expected"),
    [(False, False, 1 + 0.5 * 8 - 3), (False, True, 1 + 0.5 * 8 - 3), (True, False, 1 - 3), (True, True, 1 - 3)],
)
def test_only_termination_drops_the_future(terminated, truncated, expected):
    one = np.ones((1, 1), np.float32)
    advantages, _ = generalized_advantages(
        one, 3 * one, 8 * one, np.full((1, 1), terminated), np.full((1, 1), truncated), 0.5, 0.9
    )
    assert advantages[0, 0] == pytest.approx(expected)


def test_nothing_passes_an_episode_boundary():
    zeros = np.zeros((3, 1), np.float32)
    rewards = np.array([[0.0], [0.0], [100.0]], np.float32)
    boundary = np.array([[False], [True], [False]])
    for terminated, truncated in ((boundary, boundary & False), (boundary & False, boundary)):
        advantages, _ = generalized_advantages(rewards, zeros, zeros, terminated, truncated, 0.99, 0.95)
        np.testing.assert_array_equal(advantages[:, 0], [0.0, 0.0, 100.0])
