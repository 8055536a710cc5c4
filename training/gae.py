"""Generalized advantage estimation (Schulman et al. 2016, https://arxiv.org/abs/1506.02438)."""

import jax
from jax import Array, lax


def generalized_advantages(
    rewards: Array,
    values: Array,
    next_values: Array,
    terminated: Array,
    truncated: Array,
    discount: float,
    trace_decay: float,
) -> tuple[Array, Array]:
    """Advantages and value targets of a batch of trajectories that may hold several episodes.

    A *terminated* episode has no future, so nothing is bootstrapped after it. A *truncated* one was only cut off by the
    time limit: its last reward is followed by the value of the observation at which it was cut. Neither passes
    anything back across the episode boundary.

    Args:
        rewards: ``(time, *batch)`` reward of each step.
        values: ``(time, *batch)`` value of the observation before each step.
        next_values: ``(time, *batch)`` value of the observation *after* each step and before any reset.
        terminated: ``(time, *batch)`` bool.
        truncated: ``(time, *batch)`` bool.
        discount: Discount per step, in [0, 1].
        trace_decay: The lambda of the estimator, in [0, 1].

    Returns:
        ``(advantages, value_targets)``, each ``(time, *batch)``.
    """
    errors = rewards + discount * next_values * (1.0 - terminated) - values
    continuation = discount * trace_decay * (1.0 - (terminated | truncated))

    def accumulate(advantage: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        error, decay = step
        advantage = error + decay * advantage
        return advantage, advantage

    _, advantages = lax.scan(accumulate, jax.numpy.zeros_like(errors[0]), (errors, continuation), reverse=True)
    return advantages, advantages + values
