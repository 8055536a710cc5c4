"""Sort and sweep (guide 5.4): shapes sorted along one axis meet only those whose intervals overlap their own.

Source: D. Baraff, "Dynamic Simulation of Non-Penetrating Rigid Bodies" (1992); C. Ericson, "Real-Time Collision
Detection" (2005), 7.5, also for the choice of the axis of greatest variance.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.collision.broadphase.pair_list import (
    Admissible,
    Enumerate,
    PairList,
    collect,
)
from mathota_jax.collision.broadphase.ranges import range_pairs, sort_shapes, upper_bound
from mathota_jax.collision.broadphase.volumes import Bounds, finite_bounds
from mathota_jax.spatial.indexing import gather, take
from mathota_jax.spatial.settle import settle_code


def sort_and_sweep(bounds: Bounds, admissible: Admissible, capacity: int) -> PairList:
    """Candidate pairs by sorting along the axis of the greatest variance; see `candidate_pairs`."""
    bounds, bad = finite_bounds(bounds)
    return collect(
        [sweep(bounds, bad, np.arange(admissible.shape_count))], bounds, bad, admissible, capacity, ordered=False
    )


def sweep(bounds: Bounds, bad: Array, members: np.ndarray) -> Enumerate:
    """Enumerates the pairs of shapes whose intervals overlap along the best axis of each world.

    Args:
      bounds, bad: from `finite_bounds`.
      members: shapes that take part, ascending.
    """
    bounds, excluded = take((bounds._replace(planes=None), bad), members)
    axis = _widest_axis(bounds, ~excluded)
    largest = jnp.finfo(bounds.radius.dtype).max
    low = jnp.where(excluded, largest, jnp.where(axis == 0, bounds.low.x, jnp.where(axis == 1, *bounds.low[1:])))
    high = jnp.where(excluded, -largest, jnp.where(axis == 0, bounds.high.x, jnp.where(axis == 1, *bounds.high[1:])))
    ascending, order = sort_shapes(low)
    place = jnp.arange(low.shape[0], dtype=jnp.int32)[:, None]
    start = jnp.broadcast_to(place + 1, low.shape)
    shapes = order if len(members) == members[-1] + 1 else jnp.asarray(members, jnp.int32)[order]
    return range_pairs(shapes, shapes, start, upper_bound(ascending, gather(high, order)) - start)


def _widest_axis(bounds: Bounds, counted: Array) -> Array:
    """(world,) axis along which the centers vary most; measured from one of them, so that a far origin does no harm."""
    number = jnp.maximum(counted.sum(0), 1)
    variances = []
    for center in bounds.center:
        offset = jnp.where(counted, center - center[:1], 0.0)
        mean = offset.sum(0) / number
        variances.append(jnp.where(counted, (offset - mean) ** 2, 0.0).sum(0))
    best = jnp.argmax(jnp.stack(variances), axis=0)
    return settle_code(best.astype(bounds.radius.dtype))
