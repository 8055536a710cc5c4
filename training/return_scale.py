"""Scale rewards by the spread of the discounted return, so that the critic's targets are of order one."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from training.normalization import RunningMoments, initial_moments, update_moments


class ReturnScale(NamedTuple):
    """Running statistics of the discounted sum of past rewards.

    Attributes:
        running_return: ``(world,)`` discounted sum of the rewards of the running episode.
        moments: Its mean and variance over all steps and worlds.
    """

    running_return: Array
    moments: RunningMoments


def initial_return_scale(world_count: int) -> ReturnScale:
    """Statistics before any reward."""
    return ReturnScale(jnp.zeros(world_count, jnp.float32), initial_moments(1))


def scale_rewards(scale: ReturnScale, rewards: Array, done: Array, discount: float) -> tuple[Array, ReturnScale]:
    """Divide the rewards of a rollout by the standard deviation of the discounted return, this rollout included.

    Args:
        scale: Statistics so far.
        rewards: ``(time, world)``.
        done: ``(time, world)`` bool: the episode ended at this step.
        discount: Discount per step.

    Returns:
        ``(scaled rewards, new statistics)``. The mean is kept: shifting rewards would change the task.
    """

    def accumulate(running: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        reward, done = step
        running = discount * running + reward
        return jnp.where(done, 0.0, running), running

    running_return, returns = lax.scan(accumulate, scale.running_return, (rewards, done))
    moments = update_moments(scale.moments, returns[..., None])
    return rewards / jnp.sqrt(moments.variance[0] + 1e-8), ReturnScale(running_return, moments)
