"""Running mean and variance of observations."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array


class RunningMoments(NamedTuple):
    """Mean and variance of all the samples seen so far.

    Attributes:
        mean: ``(size,)``.
        variance: ``(size,)``, population variance.
        count: ``()``, number of samples.
    """

    mean: Array
    variance: Array
    count: Array


def initial_moments(size: int) -> RunningMoments:
    """Moments before any sample: they normalize nothing."""
    return RunningMoments(jnp.zeros(size, jnp.float32), jnp.ones(size, jnp.float32), jnp.zeros((), jnp.float32))


def update_moments(moments: RunningMoments, samples: Array) -> RunningMoments:
    """Merge a batch of samples (Chan, Golub and LeVeque 1979).

    Args:
        moments: What was seen before.
        samples: ``(..., size)``.
    """
    samples = samples.reshape(-1, samples.shape[-1])
    sample_count = samples.shape[0]
    sample_mean = samples.mean(axis=0)
    sample_variance = samples.var(axis=0)
    count = moments.count + sample_count
    difference = sample_mean - moments.mean
    squares = (
        moments.variance * moments.count
        + sample_variance * sample_count
        + difference**2 * moments.count * sample_count / count
    )
    return RunningMoments(moments.mean + difference * sample_count / count, squares / count, count)


def normalize(moments: RunningMoments, samples: Array, limit: float = 10.0) -> Array:
    """Shift and scale samples to mean 0 and variance 1, clipped to ``[-limit, limit]``.

    Args:
        moments: The statistics.
        samples: ``(..., size)``.
        limit: Largest size of a result; an outlier must not blow up a network.
    """
    scaled = (samples.astype(jnp.float32) - moments.mean) / jnp.sqrt(moments.variance + 1e-8)
    return jnp.clip(scaled, -limit, limit)
