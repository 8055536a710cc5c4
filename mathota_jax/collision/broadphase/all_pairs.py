"""Every admissible pair is tested (guide 5.4): the least overhead, for scenes of few shapes."""

from __future__ import annotations

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
from mathota_jax.collision.broadphase.volumes import Bounds, stored_bounds

CHUNK = 8192
"""Pairs tested at a time, so that the memory does not grow with the square of the number of shapes."""


def all_pairs(bounds: Bounds, admissible: Admissible, capacity: int) -> PairList:
    """Candidate pairs by testing all; see `candidate_pairs`."""
    bounds, bad = stored_bounds(bounds)
    first, second = (side[admissible.pairs[0] >= bounds.plane_count] for side in admissible.pairs)
    return collect([_listed(first, second, bounds.radius)], bounds, bad, admissible, capacity, ordered=True)


def _listed(first: np.ndarray, second: np.ndarray, like: Array) -> Enumerate:
    chunk = min(CHUNK, max(len(first), 1))
    chunk_count = -(-len(first) // chunk)
    padding = chunk_count * chunk - len(first)
    kept = np.arange(chunk_count * chunk) < len(first)
    columns = tuple(jnp.asarray(np.pad(side, (0, padding)).reshape(-1, chunk, 1)) for side in (first, second))

    def enumerate_pairs(visit: Visit, carry: tuple) -> tuple:
        def body(carry: tuple, at: tuple) -> tuple[tuple, None]:
            one, two, kept = (jnp.broadcast_to(x, (chunk, like.shape[-1])) for x in at)
            return visit(carry, one, two, kept), None

        return lax.scan(body, carry, (*columns, jnp.asarray(kept.reshape(-1, chunk, 1))))[0]

    return enumerate_pairs
