"""Rollouts keep the last observation of an episode apart from the first of the next."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.training.toy_environments import ConstantReward, MatchTarget
from training.rollouts import collect, start_episodes


def act(observations, key):
    action = jax.random.normal(key, (observations.shape[0], 1))
    return action, action, jnp.zeros(observations.shape[0])


def test_next_observation_belongs_to_the_old_episode():
    environment = MatchTarget(max_episode_steps=3)
    episodes = start_episodes(environment, jax.random.key(0), 5)
    _, steps = collect(environment, act, episodes, jax.random.key(1), 9)
    # The observation of this environment never changes within an episode.
    np.testing.assert_array_equal(steps.next_observation, steps.observation)
    targets = np.asarray(steps.observation)[..., 0].reshape(3, 3, 5)
    assert (targets == targets[:, :1]).all()
    assert len(np.unique(targets[:, 0])) == 15, "every episode of every world has a new random start"
    np.testing.assert_array_equal(np.asarray(steps.truncated)[:, 0], [False, False, True] * 3)


def test_episode_return_restarts_and_continues_over_rollouts():
    environment = ConstantReward(max_episode_steps=4)
    episodes = start_episodes(environment, jax.random.key(0), 2)
    episodes, first = collect(environment, act, episodes, jax.random.key(1), 6)
    _, second = collect(environment, act, episodes, jax.random.key(2), 3)
    np.testing.assert_array_equal(first.episode_return[:, 0], [1, 2, 3, 4, 1, 2])
    np.testing.assert_array_equal(second.episode_return[:, 0], [3, 4, 1])
