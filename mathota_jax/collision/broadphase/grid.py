"""Uniform grid (guide 5.4): shapes meet only those in their own and the neighbouring cells.

A cell is as large as the largest box, so that boxes that overlap have their low corners in the same or in neighbouring
cells. Cells are not stored: shapes are sorted by the number of their cell, and a row of three neighbouring cells is one
run of the sorted list, found by bisection. Source: S. Green, "Particle Simulation using CUDA" (NVIDIA, 2010).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.broadphase.pair_list import (
    Admissible,
    Enumerate,
    PairList,
    collect,
)
from mathota_jax.collision.broadphase.ranges import lower_bound, range_pairs, sort_shapes, upper_bound
from mathota_jax.collision.broadphase.volumes import Bounds, finite_bounds
from mathota_jax.spatial.indexing import gather
from mathota_jax.spatial.settle import settle_code

AXIS_CELLS = 1024
"""Cells along an axis, the empty ones at both ends included; three axes fill 30 bits."""

CELL_MARGIN = 1.01
"""Relative growth of the cells, well above the round-off of a cell coordinate in float32 (1000 cells x 1e-7)."""


def grid(bounds: Bounds, admissible: Admissible, capacity: int) -> PairList:
    """Candidate pairs by a uniform grid; see `candidate_pairs`."""
    bounds, bad = finite_bounds(bounds)
    return collect([neighbours(bounds, bad)], bounds, bad, admissible, capacity, ordered=False)


def neighbours(bounds: Bounds, excluded: Array) -> Enumerate:
    """Enumerates the pairs of shapes in the same or in neighbouring cells.

    Args:
      bounds: from `finite_bounds`.
      excluded: (shape, world) shapes that are left out.
    """
    cells = [_cell(low, size, excluded) for low, size in zip(bounds.low, _cell_sizes(bounds, excluded), strict=True)]
    number = (cells[2] * AXIS_CELLS + cells[1]) * AXIS_CELLS + cells[0]
    number = jnp.where(excluded, jnp.iinfo(jnp.int32).max, number)
    ascending, order = sort_shapes(number)
    place = jnp.broadcast_to(jnp.arange(number.shape[0], dtype=jnp.int32)[:, None], number.shape)
    # The rest of the own row, and half of the neighbouring rows: the others see the pair from their side.
    rows = [ascending + (dz * AXIS_CELLS + dy) * AXIS_CELLS for dy, dz in ((1, 0), (-1, 1), (0, 1), (1, 1))]
    start = jnp.concatenate([place + 1, lower_bound(ascending, jnp.concatenate(rows) - 1)])
    end = upper_bound(ascending, jnp.concatenate([ascending, *rows]) + 1)
    owner, absent = (jnp.concatenate([x] * (1 + len(rows))) for x in (order, gather(excluded, order)))
    return range_pairs(order, owner, start, jnp.where(absent, 0, end - start))


def _cell_sizes(bounds: Bounds, excluded: Array) -> list[Array]:
    """(world,) edge of the cells along each axis: that of the largest box, or more where the scene is very wide."""
    sizes = []
    for low, high in zip(bounds.low, bounds.high, strict=True):
        # Far from the origin the corners are rounded: the spacing of the numbers counts as extent.
        spacing = jnp.maximum(jnp.abs(low), jnp.abs(high)) * jnp.finfo(low.dtype).eps
        extent = jnp.where(excluded, 0.0, high - low + spacing).max(0)
        width = jnp.where(excluded, -jnp.inf, low).max(0) - jnp.where(excluded, jnp.inf, low).min(0)
        width = jnp.where(jnp.isfinite(width), width, 0.0)
        sizes.append(CELL_MARGIN * jnp.maximum(extent, width / (AXIS_CELLS - 4)))
    return sizes


def _cell(low: Array, size: Array, excluded: Array) -> Array:
    """(shape, world) cell coordinate, from 1, of the low corners."""
    origin = jnp.where(excluded, jnp.inf, low).min(0)
    offset = jnp.where(excluded, 0.0, low - jnp.where(jnp.isfinite(origin), origin, 0.0))
    coordinate = jnp.floor(offset / jnp.where(size > 0, size, 1.0))
    return 1 + settle_code(jnp.clip(coordinate, 0.0, AXIS_CELLS - 3.0))
