"""Every admissible pair is tested (guide 5.4): the least overhead, for scenes of few shapes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.collision.broadphase.pair_list import (
    Admissible,
    Enumerate,
    PairList,
    Visit,
    collect,
)
from mathota_jax.collision.broadphase.volumes import Bounds, overlap, stored_bounds
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.settle import store

CHUNK = 8192
"""Tests at a time, so that the memory does not grow with the square of the number of shapes."""


def all_pairs(bounds: Bounds, admissible: Admissible, capacity: int) -> PairList:
    """Candidate pairs by testing all; see `candidate_pairs`."""
    bounds, bad = stored_bounds(bounds)
    first, second = (side[admissible.pairs[0] >= bounds.plane_count] for side in admissible.pairs)
    if not len(first):
        return collect([], bounds, bad, admissible, capacity, ordered=True)
    enumerate_pairs, ordered = _listed(first, second, np.asarray(admissible.static), bounds)
    return collect([enumerate_pairs], bounds, bad, admissible, capacity, ordered)


def _listed(first: np.ndarray, second: np.ndarray, static: np.ndarray, bounds: Bounds) -> tuple[Enumerate, bool]:
    """Enumerates given pairs, as entries of a table of moving shapes against all others; and whether in their order.

    The table holds each pair of moving shapes twice, and yet is filled much faster than bounds are gathered for each pair.
    """
    row_of, column_of = np.where(static[first], second, first), np.where(static[first], first, second)
    rows, row = np.unique(row_of, return_inverse=True)
    columns, column = np.unique(column_of, return_inverse=True)
    height = min(max(1, CHUNK // len(columns)), len(rows))
    chunks = [np.flatnonzero(row // height == chunk) for chunk in range(-(-len(rows) // height))]
    width = max(len(chunk) for chunk in chunks)

    def padded(values: np.ndarray) -> Array:
        return jnp.asarray([np.pad(values[chunk], (0, width - len(chunk))) for chunk in chunks], jnp.int32)[..., None]

    kept = np.ones(len(row), bool)
    scanned = tuple(padded(values) for values in (first, second, row % height * len(columns) + column, kept))
    volumes = bounds._replace(planes=None)
    ones, others = take(volumes, np.resize(rows, len(chunks) * height)), take(volumes, columns)
    ones = jax.tree.map(lambda x: x.reshape(len(chunks), height, 1, -1), ones)
    worlds = bounds.radius.shape[-1]

    def enumerate_pairs(visit: Visit, carry: tuple) -> tuple:
        def body(carry: tuple, at: tuple) -> tuple[tuple, None]:
            one, (first, second, entry, kept) = at
            touch, depth = overlap(one, others)
            depth = jnp.where(touch, depth, -1.0).reshape(-1, worlds)
            depth = jnp.take(store(depth, depth), entry[:, 0], axis=0, mode="clip")
            first, second = (jnp.broadcast_to(x, depth.shape) for x in (first, second))
            return visit(carry, first, second, (kept > 0) & (depth >= 0), depth), None

        return lax.scan(body, carry, (ones, scanned))[0]

    return enumerate_pairs, bool((np.diff(np.concatenate(chunks)) > 0).all())
