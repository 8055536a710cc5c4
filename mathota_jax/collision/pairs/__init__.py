"""Analytic contact of pairs of shapes; `PAIRS` is the registry. One file a pair, body A is the earlier kind."""

from typing import Any, NamedTuple, Protocol

from mathota_jax.collision.manifold import Manifold
from mathota_jax.collision.pairs.box_box import box_box
from mathota_jax.collision.pairs.capsule_box import capsule_box
from mathota_jax.collision.pairs.capsule_capsule import capsule_capsule
from mathota_jax.collision.pairs.convex_heightfield import (
    HEIGHTFIELD_POINTS,
    box_heightfield,
    capsule_heightfield,
    cone_heightfield,
    cylinder_heightfield,
    polyhedron_heightfield,
    sphere_heightfield,
)
from mathota_jax.collision.pairs.plane_box import plane_box
from mathota_jax.collision.pairs.plane_capsule import plane_capsule
from mathota_jax.collision.pairs.plane_sphere import plane_sphere
from mathota_jax.collision.pairs.sphere_box import sphere_box
from mathota_jax.collision.pairs.sphere_capsule import sphere_capsule
from mathota_jax.collision.pairs.sphere_sphere import sphere_sphere
from mathota_jax.spatial.pose import Pose


class PairFunction(Protocol):
    """Contacts of shape A (parameters, pose) with shape B; components of shape ``(pair, world)``."""

    def __call__(self, a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose, /) -> Manifold:
        """Returns the closest features, also of shapes that are apart."""
        ...


class Pair(NamedTuple):
    """How to test a pair of kinds, and how many contact points the answer has."""

    function: PairFunction
    point_count: int


PAIRS: dict[tuple[str, str], Pair] = {
    ("plane", "sphere"): Pair(plane_sphere, 1),
    ("plane", "capsule"): Pair(plane_capsule, 2),
    ("plane", "box"): Pair(plane_box, 4),
    ("sphere", "sphere"): Pair(sphere_sphere, 1),
    ("sphere", "capsule"): Pair(sphere_capsule, 1),
    ("sphere", "box"): Pair(sphere_box, 1),
    ("capsule", "capsule"): Pair(capsule_capsule, 2),
    ("capsule", "box"): Pair(capsule_box, 2),
    ("box", "box"): Pair(box_box, 4),
    ("sphere", "heightfield"): Pair(sphere_heightfield, HEIGHTFIELD_POINTS),
    ("capsule", "heightfield"): Pair(capsule_heightfield, HEIGHTFIELD_POINTS),
    ("box", "heightfield"): Pair(box_heightfield, HEIGHTFIELD_POINTS),
    ("cylinder", "heightfield"): Pair(cylinder_heightfield, HEIGHTFIELD_POINTS),
    ("cone", "heightfield"): Pair(cone_heightfield, HEIGHTFIELD_POINTS),
    ("polyhedron", "heightfield"): Pair(polyhedron_heightfield, HEIGHTFIELD_POINTS),
}

__all__ = ["PAIRS", "Pair", "PairFunction"]
