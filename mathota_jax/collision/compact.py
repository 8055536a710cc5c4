"""Narrow phase of the pairs that the broadphase found: one vectorised test for each compact group."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.bounds import Shapes, kind_ranges, placed_shapes
from mathota_jax.collision.narrowphase import ContactSet, flatten
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.collision.polyhedron import polyhedra_of_places
from mathota_jax.scene import CompactGroup, Scene
from mathota_jax.spatial.indexing import gather_together
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion
from mathota_jax.spatial.vector import Vec3


def compact_contacts(
    scene: Scene,
    group: CompactGroup,
    shapes: Shapes,
    position: Vec3,
    orientation: Quaternion,
    pair: tuple[Array, Array],
    active: Array,
) -> ContactSet:
    """Contacts of the pairs in the places of a group, in slot order (place, point).

    Args:
      scene, group: static structure.
      shapes, position, orientation: as for `find_contacts`.
      pair: (place, world) shapes A and B in the numbering of the broadphase, of the kinds of the group.
      active: (place, world) whether the place holds a pair.
    """
    ranges = dict(kind_ranges(scene))

    def placed(kind: str, index: Array) -> tuple[dict[str, Any], Pose]:
        parameters, pose = placed_shapes(scene, shapes, kind, ranges[kind], position, orientation)
        row = index - ranges[kind].start
        if kind == "polyhedron":
            return polyhedra_of_places(parameters, row), gather_together(pose, row)
        return gather_together((parameters, pose), row)

    (a, pose_a), (b, pose_b) = placed(group.kind_a, pair[0]), placed(group.kind_b, pair[1])
    manifold = PAIRS[group.kind_a, group.kind_b].function(a, pose_a, b, pose_b)
    found = flatten(manifold, active.shape[0])
    return found._replace(active=found.active & jnp.repeat(active, group.point_count, axis=0))
