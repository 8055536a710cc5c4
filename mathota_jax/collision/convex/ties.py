"""Piece pairs that are extreme at once along a normal: which join them and which leave."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.convex.difference import Weights
from mathota_jax.spatial.settle import settle_code


class Ties(NamedTuple):
    """Distinct piece pairs that are extreme at once: the first always, the others where `two`, `three`."""

    pieces: tuple[Array, ...]
    two: Array
    three: Array


def single(pieces: Array) -> Ties:
    """One piece pair alone."""
    none = jnp.zeros_like(pieces, dtype=bool)
    return Ties((pieces, pieces, pieces), none, none)


def distinct(pieces: tuple[Array, ...]) -> Ties:
    """Sorts out repeated piece pairs (different points of one rim)."""
    first, second, third = pieces
    repeated = second == first
    second, third = jnp.where(repeated, third, second), jnp.where(repeated, first, third)
    two = second != first
    return Ties((first, second, third), two, two & (third != first) & (third != second))


def join(ties: Ties, pieces: Array, weights: Weights, shares: Weights, wanted: Array) -> Ties:
    """Adds a piece pair; of three tied ones it replaces the first to lose all its weight to the new one.

    This is the exchange of the simplex method. Where the least weight decides alone, and the one that has it lies across
    from the new one, the two replace each other for ever.

    Args:
        ties: The tied pieces.
        pieces: The new one.
        weights: Of the tied points in the point closest to the origin.
        shares: Of the tied points in the new point.
        wanted: bool, False where nothing is added.
    """
    first, second, third = ties.pieces
    wanted = wanted & (pieces != first) & ~(ties.two & (pieces == second)) & ~(ties.three & (pieces == third))
    lasting = [
        jnp.where(share > 0, jnp.maximum(weight, 0.0) / jnp.where(share > 0, share, 1.0), jnp.inf)
        for weight, share in zip(weights, shares, strict=True)
    ]
    slot = jnp.where(ties.three, _lightest((lasting[0], lasting[1], lasting[2])), jnp.where(ties.two, 2, 1))
    slot = settle_code(jnp.where(wanted, slot, -1).astype(weights[0].dtype))
    first, second, third = (jnp.where(slot == k, pieces, old) for k, old in enumerate((first, second, third)))
    return Ties((first, second, third), ties.two | (slot == 1), ties.three | (slot == 2))


def leave(ties: Ties, weights: Weights, rounding: float, wanted: Array) -> tuple[Ties, Array]:
    """Takes out the tied piece pair beyond which the closest point lies, and tells whether there was one.

    It has a negative weight: it does not hold the others back from the solution.
    """
    third = jnp.where(ties.three, weights[2], jnp.inf)
    weights = weights[0], jnp.where(ties.two, weights[1], jnp.inf), third
    slot = _lightest(weights)
    beyond = wanted & (jnp.minimum(weights[0], jnp.minimum(weights[1], third)) < -rounding)
    slot = settle_code(jnp.where(beyond, slot, -1).astype(third.dtype))
    first, second, third = ties.pieces
    pieces = jnp.where(slot == 0, second, first), jnp.where((slot == 0) | (slot == 1), third, second), third
    leaves = slot >= 0
    return Ties(pieces, jnp.where(leaves, ties.three, ties.two), ties.three & ~leaves), leaves


def _lightest(weights: Weights) -> Array:
    return jnp.where(weights[0] <= jnp.minimum(weights[1], weights[2]), 0, jnp.where(weights[1] <= weights[2], 1, 2))
