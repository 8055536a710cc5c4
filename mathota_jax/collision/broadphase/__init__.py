"""Which pairs of shapes may touch (guide 5). One file a method; `BROADPHASES` is the registry.

All methods give the same pairs in the same order; they differ in cost.
"""

from collections.abc import Callable

from mathota_jax.collision.broadphase.all_pairs import all_pairs
from mathota_jax.collision.broadphase.bvh import bvh
from mathota_jax.collision.broadphase.grid import grid
from mathota_jax.collision.broadphase.pair_list import Admissible, PairList
from mathota_jax.collision.broadphase.sort_and_sweep import sort_and_sweep
from mathota_jax.collision.broadphase.volumes import Bounds, Planes

BROADPHASES: dict[str, Callable[[Bounds, Admissible, int], PairList]] = {
    "all_pairs": all_pairs,
    "sort_and_sweep": sort_and_sweep,
    "grid": grid,
    "bvh": bvh,
}


def candidate_pairs(method: str, bounds: Bounds, admissible: Admissible, capacity: int) -> PairList:
    """Pairs of shapes whose bounding boxes and bounding spheres overlap, and of planes and shapes that reach below them.

    Args:
      method: key of `BROADPHASES`.
      bounds: bounding volumes, components ``(shape, world)``. Shapes whose bounds are not finite are in no pair.
      admissible: which pairs may collide at all.
      capacity: places of the list. If more pairs overlap, those whose boxes overlap deepest are kept (ties: the earlier
        pair), which takes several passes.

    Returns:
      The pairs, without derivatives: a selection is discrete.
    """
    return BROADPHASES[method](bounds, admissible, capacity)


__all__ = ["BROADPHASES", "Admissible", "Bounds", "PairList", "Planes", "candidate_pairs"]
