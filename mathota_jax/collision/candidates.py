"""Choosing one of many candidates that are stacked on the leading axis, for every pair and world at once."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.spatial.settle import settle_code, store
from mathota_jax.spatial.vector import Vec3

LEAN = Vec3(0.48, 0.36, 0.8)
"""Unit vector toward which scores lean, so that equally good candidates do not take turns in a tremor."""
LEAN_SHARE = 1e-3
"""By this share of the distance along `LEAN`, where the score measures the spread of contacts."""


def depth_lean(number: Any) -> float:
    """The same share where it measures depth: the deepest contact is the deepest to this share of the size.

    More than the tremor of a body at rest, less than the error that matters (a tilt of 2e-7 rad, in float32 8e-6).
    """
    return max(2e-7, 64.0 * float(jnp.finfo(number).eps))


def best_candidate(score: Array) -> tuple[Array, Array]:
    """Highest score and its index (the first of equals), settled.

    The scores are stored first: the index is found by comparing them with their maximum, which only works if nothing
    is computed twice (see `settle`). Two plain reductions compile faster than one of (score, index) and vectorise.

    Args:
        score: Shape (candidate, pair, world); finite.

    Returns:
        Score and int32 index, both of shape (pair, world).
    """
    score = lax.stop_gradient(score)
    score = store(score, score)
    best = jnp.max(score, axis=0)
    number = numbers(score.shape[0], score)
    return best, settle_code(jnp.min(jnp.where(score >= best, number, float(score.shape[0] - 1)), axis=0))


def numbers(count: int, like: Array) -> Array:
    """0 ... count-1 on the leading axis, floating point, to broadcast against `like` of shape (count, pair, world)."""
    return jnp.arange(count, dtype=like.dtype).reshape((count,) + (1,) * (like.ndim - 1))


def pick(values: Any, index: Array) -> Any:
    """Row `index` of every array of a pytree, 0 where the index is out of range.

    A sum over a mask: it vectorises over worlds and so does its derivative; a gather does neither.

    Args:
        values: Arrays of shape (candidate, pair, world); pair and world may be 1.
        index: int32 of shape (pair, world).
    """

    def one(value: Array) -> Array:
        row = jnp.arange(value.shape[0], dtype=jnp.int32).reshape((-1,) + (1,) * (value.ndim - 1))
        return jnp.sum(jnp.where(row == index, value, jnp.zeros((), value.dtype)), axis=0, dtype=value.dtype)

    return jax.tree.map(one, values)
