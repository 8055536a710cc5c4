"""Which broadphase suits a scene, from its size alone.

Measured on one CPU core, float32, spread-out and piled spheres, microseconds a pass:

| shapes, moving + static | all pairs | sort and sweep | grid | hierarchy |
|---|---|---|---|---|
| 64 + 0     |  155 |  155 |  196 |      |
| 256 + 0    |  665 |  443 |  363 |      |
| 1024 + 0   | 9459 | 2750 | 1256 |      |
| 16 + 1024  |  617 | 1115 |  828 |  783 |
| 256 + 1024 | 5304 | 1770 |  991 | 1228 |
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

ALL_PAIRS_UP_TO = 16_384
"""Admissible pairs up to which testing all of them is cheapest."""

UNIFORM_RATIO = 4.0
"""Largest to median size up to which a uniform grid does not crowd its cells."""

STATIC_SHARE = 8
"""Static shapes for each moving one from which a hierarchy pays if sizes differ too much for a grid."""


def choose_method(moving: int, static: int, reach: Sequence[float]) -> str:
    """Key of `BROADPHASES`.

    Args:
      moving, static: number of shapes on moving and on static bodies.
      reach: bounding radius of each shape.
    """
    if moving * (moving - 1) // 2 + moving * static <= ALL_PAIRS_UP_TO:
        return "all_pairs"
    if max(reach) <= UNIFORM_RATIO * float(np.median(reach)):
        return "grid"
    return "bvh" if static >= STATIC_SHARE * moving else "sort_and_sweep"
