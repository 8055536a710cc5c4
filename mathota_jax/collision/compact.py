"""Narrow phase of the pairs that the broadphase found: one vectorised test for each compact group."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.bounds import Shapes, kind_ranges, placed_shapes
from mathota_jax.collision.narrowphase import ContactSet, flatten
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.collision.polyhedron import polyhedra_of_places
from mathota_jax.geometry.bounds import bounding_radius
from mathota_jax.scene import CompactGroup, Scene
from mathota_jax.spatial.indexing import gather_together
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion
from mathota_jax.spatial.vector import Vec3

OFFSET = 1e-5
"""Largest distance, as a share of the reach of a shape, at which shapes with one centre are taken to lie from each other."""

SEQUENCES = (0.8191725134, 0.6710436067, 0.5497004779)
"""Multiples of these are spread evenly over the unit cube (additive recurrence with the inverse powers of 1.2207...)."""


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
    (a, pose_a), (b, pose_b) = shapes_of_places(scene, group, shapes, position, orientation, pair)
    if "plane" not in (group.kind_a, group.kind_b):
        pose_b = _off_centre(pair, pose_a, pose_b, bounding_radius(group.kind_a, a))
    manifold = PAIRS[group.kind_a, group.kind_b].function(a, pose_a, b, pose_b)
    found = flatten(manifold, active.shape[0])
    return found._replace(active=found.active & jnp.repeat(active, group.point_count, axis=0))


def shapes_of_places(
    scene: Scene,
    group: CompactGroup,
    shapes: Shapes,
    position: Vec3,
    orientation: Quaternion,
    pair: tuple[Array, Array],
) -> tuple[tuple[dict[str, Any], Pose], tuple[dict[str, Any], Pose]]:
    """Sizes and poses of shapes A and B of the pairs in the places of a group; arguments as for `compact_contacts`."""
    ranges = dict(kind_ranges(scene))

    def placed(kind: str, index: Array) -> tuple[dict[str, Any], Pose]:
        parameters, pose = placed_shapes(scene, shapes, kind, ranges[kind], position, orientation)
        row = index - ranges[kind].start
        if kind == "polyhedron":
            return polyhedra_of_places(parameters, row), gather_together(pose, row)
        return gather_together((parameters, pose), row)

    return placed(group.kind_a, pair[0]), placed(group.kind_b, pair[1])


def _off_centre(pair: tuple[Array, Array], pose_a: Pose, pose_b: Pose, reach: Array) -> Pose:
    """Pose of B, moved a little where its centre is that of A, in another direction for each pair.

    Bodies put on one point would all leave in the direction in which the pair test decides ties: as one line, each pushed by
    the next.
    """
    centre_a, centre_b = pose_a.position, pose_b.position
    same = (centre_a.x == centre_b.x) & (centre_a.y == centre_b.y) & (centre_a.z == centre_b.z)
    parts = []
    for ratio in SEQUENCES:
        of_a, of_b = ((index.astype(reach.dtype) * ratio) % 1.0 for index in pair)
        parts.append(of_b - of_a)
    return pose_b._replace(position=centre_b + Vec3(*parts) * (jnp.where(same, OFFSET, 0.0) * reach))
