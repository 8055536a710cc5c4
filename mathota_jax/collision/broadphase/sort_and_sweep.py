"""Sort and sweep (guide 5.4): shapes sorted along one axis meet only those whose intervals overlap their own.

Source: D. Baraff, "Dynamic Simulation of Non-Penetrating Rigid Bodies" (1992); C. Ericson, "Real-Time Collision
Detection" (2005), 7.5, also for the choice of the axis of greatest variance.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.broadphase.pair_list import (
    Admissible,
    Bounds,
    Enumerate,
    PairList,
    collect,
    finite_bounds,
    gather,
)
from mathota_jax.collision.broadphase.ranges import range_pairs, sort_shapes, upper_bound
from mathota_jax.spatial.settle import settle_code


def sort_and_sweep(bounds: Bounds, admissible: Admissible, capacity: int) -> PairList:
    """Candidate pairs by sorting along the axis of the greatest variance; see `candidate_pairs`."""
    bounds, bad = finite_bounds(bounds)
    return collect([sweep(bounds, bad)], bounds, bad, admissible, capacity, ordered=False)


def sweep(bounds: Bounds, excluded: Array) -> Enumerate:
    """Enumerates the pairs of shapes whose intervals overlap along the best axis of each world.

    Args:
      bounds: from `finite_bounds`.
      excluded: (shape, world) shapes that are left out.
    """
    axis = _widest_axis(bounds, ~excluded)
    largest = jnp.finfo(bounds.radius.dtype).max
    low = jnp.where(excluded, largest, jnp.where(axis == 0, bounds.low.x, jnp.where(axis == 1, *bounds.low[1:])))
    high = jnp.where(excluded, -largest, jnp.where(axis == 0, bounds.high.x, jnp.where(axis == 1, *bounds.high[1:])))
    ascending, order = sort_shapes(low)
    place = jnp.arange(low.shape[0], dtype=jnp.int32)[:, None]
    start = jnp.broadcast_to(place + 1, low.shape)
    return range_pairs(order, order, start, upper_bound(ascending, gather(high, order)) - start)


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
