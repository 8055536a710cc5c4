"""Choosing one of many candidates that are stacked on the leading axis, for every pair and world at once."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.spatial.settle import settle_code, store
from mathota_jax.spatial.spread import add_slices, greatest, least
from mathota_jax.spatial.vector import Vec3

FEW_ROWS = 8
"""Up to so many, a row is picked within the expression that needs it; of more, before it."""
LEAN = Vec3(0.48, 0.36, 0.8)
"""Unit vector toward which scores lean, so that equally good candidates do not take turns in a tremor."""
LEAN_SHARE = 1e-3
"""By this share of the distance along `LEAN`, where the score measures the spread of contacts."""


def depth_tolerance(number: Any) -> float:
    """Candidates within this share of the size of the deepest one are equally deep: the farthest along `LEAN` counts.

    More than the tremor of a body at rest, less than the error that matters (2e-7 in float64, 8e-6 in float32).
    """
    return max(2e-7, 64.0 * float(jnp.finfo(number).eps))


def deepest_candidate(depth: Array, lean: Array, tolerance: Array) -> tuple[Array, Array]:
    """`best_candidate` of `depth`, ties within `tolerance` being broken by `lean`; the depth returned is the largest."""
    lowest = jnp.finfo(depth.dtype).min
    depth = store(depth, depth)
    best, _ = best_candidate(depth)
    _, code = best_candidate(jnp.where(depth >= best - tolerance, lean, lowest))
    return best, code


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
    best = greatest(score)
    best = store(best, best)
    number = numbers(score.shape[0], score)
    return best, settle_code(least(jnp.where(score >= best, number, float(score.shape[0] - 1))))


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
        chosen = jnp.where(row == index, value, jnp.zeros((), value.dtype))
        return add_slices(chosen, 0) if len(value) <= FEW_ROWS else jnp.sum(chosen, axis=0, dtype=value.dtype)

    return jax.tree.map(one, values)
