"""Collect steps from many worlds on the device, starting a new episode in a world when one ends."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_envs.worlds import Worlds, start_worlds, step_then_restart


class RunningEpisodes(NamedTuple):
    """The worlds and what their unfinished episodes have gathered.

    Attributes:
        worlds: Where the worlds stand.
        episode_return: ``(world,)`` undiscounted reward so far.
    """

    worlds: Worlds
    episode_return: Array


class Steps(NamedTuple):
    """What a rollout recorded; every leaf is ``(time, world, ...)``.

    ``next_observation`` is the observation after the step and *before* a reset; ``episode_return`` includes this step's
    reward, so where the episode ended it is the return of the whole episode.
    """

    observation: Array
    action: Array
    log_probability: Array
    reward: Array
    next_observation: Array
    terminated: Array
    truncated: Array
    episode_return: Array


def start_episodes(environment: Any, key: Array, world_count: int) -> RunningEpisodes:
    """Start one episode in each world, each from its own random key."""
    worlds = start_worlds(environment, jax.random.split(key, world_count))
    return RunningEpisodes(worlds, jnp.zeros(world_count, jnp.float32))


def collect(
    environment: Any,
    act: Callable[[Array, Array], tuple[Array, Array, Array]],
    episodes: RunningEpisodes,
    key: Array,
    step_count: int,
) -> tuple[RunningEpisodes, Steps]:
    """Step all worlds ``step_count`` times.

    Args:
        environment: Functional environment.
        act: ``(observations, key) -> (raw action, environment action, log probability)`` for all worlds; the raw
            action is recorded, the environment action is applied.
        episodes: Where to begin.
        key: Random key of the actions.
        step_count: Length of the rollout.

    Returns:
        ``(episodes, steps)``.
    """

    def step(episodes: RunningEpisodes, action_key: Array) -> tuple[RunningEpisodes, Steps]:
        observation = episodes.worlds.observation.astype(jnp.float32)
        raw_action, action, log_probability = act(observation, action_key)
        worlds, transition = step_then_restart(environment, episodes.worlds, action)
        reward = transition.reward.astype(jnp.float32)
        episode_return = episodes.episode_return + reward
        steps = Steps(
            observation,
            raw_action,
            log_probability,
            reward,
            transition.observation.astype(jnp.float32),
            transition.terminated,
            transition.truncated,
            episode_return,
        )
        return RunningEpisodes(worlds, jnp.where(transition.done, 0.0, episode_return)), steps

    return lax.scan(step, episodes, jax.random.split(key, step_count))
