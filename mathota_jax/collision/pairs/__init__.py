"""Contact of pairs of shapes; `PAIRS` is the registry. One file a closed form, body A is the earlier kind."""

from typing import Any, NamedTuple, Protocol

from mathota_jax.collision.box_distance import box_distance
from mathota_jax.collision.convex.polytope import are_polytopes
from mathota_jax.collision.manifold import Manifold, Nearest
from mathota_jax.collision.pairs.box_box import box_box
from mathota_jax.collision.pairs.capsule_box import capsule_box, capsule_box_distance
from mathota_jax.collision.pairs.capsule_capsule import capsule_capsule, capsule_distance
from mathota_jax.collision.pairs.convex import convex_nearest, convex_pair, convex_point_count
from mathota_jax.collision.pairs.convex_heightfield import HEIGHTFIELD_POINTS, heightfield_pair
from mathota_jax.collision.pairs.convex_heightfield import KINDS as HEIGHTFIELD_KINDS
from mathota_jax.collision.pairs.plane_box import plane_box
from mathota_jax.collision.pairs.plane_capsule import plane_capsule
from mathota_jax.collision.pairs.plane_cone import plane_cone
from mathota_jax.collision.pairs.plane_cylinder import plane_cylinder
from mathota_jax.collision.pairs.plane_polyhedron import plane_polyhedron
from mathota_jax.collision.pairs.plane_sphere import plane_sphere
from mathota_jax.collision.pairs.sphere_box import sphere_box
from mathota_jax.collision.pairs.sphere_capsule import sphere_capsule
from mathota_jax.collision.pairs.sphere_cone import sphere_cone
from mathota_jax.collision.pairs.sphere_cylinder import sphere_cylinder
from mathota_jax.collision.pairs.sphere_polyhedron import sphere_polyhedron
from mathota_jax.collision.pairs.sphere_sphere import sphere_sphere
from mathota_jax.spatial.pose import Pose


class PairFunction(Protocol):
    """Contacts of shape A (parameters, pose) with shape B; components of shape ``(pair, world)``."""

    def __call__(self, a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose, /) -> Manifold:
        """Returns the closest features, also of shapes that are apart."""
        ...


class DistanceFunction(Protocol):
    """Exact signed distance of the same shapes."""

    def __call__(self, a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose, /) -> Nearest:
        """Returns the closest points."""
        ...


CONVEX = ("capsule", "box", "cylinder", "cone", "polyhedron")
"""Kinds that meet each other by their support functions where no closed form is registered."""

ROUND_RIMMED = {"cylinder", "cone"}
"""Kinds with a round rim."""

CLOSED_FORM = "closed form"
SEPARATING_AXES = "separating axes, clipping"
SEARCHED_AXES = "GJK or separating axes, clipping"
SEARCHED_CURVED = "GJK, EPA, clipping"
SEARCHED = (SEARCHED_AXES, SEARCHED_CURVED)
"""Methods that begin with a distance search."""
LOCAL_CELLS = "faces, ridges and peaks of the cells under the body"


class Pair(NamedTuple):
    """How to test a pair of kinds, how many contact points the answer has, and by which method it is found.

    `distance` is given where the deepest point of the manifold is not at the signed distance, or takes longer to find.
    `steady` is whether a point that stays where it is on both bodies, or rolls, keeps its feature: on round rims, the arcs
    of which are numbered, and from cell to cell of a heightfield it does not.
    """

    function: PairFunction
    point_count: int
    method: str = CLOSED_FORM
    distance: DistanceFunction | None = None
    steady: bool = True


def _convex(kind_a: str, kind_b: str) -> Pair:
    method = SEARCHED_AXES if are_polytopes((kind_a, kind_b)) else SEARCHED_CURVED
    nearest, steady = convex_nearest(kind_a, kind_b), not {kind_a, kind_b} & ROUND_RIMMED
    return Pair(convex_pair(kind_a, kind_b), convex_point_count(kind_a, kind_b), method, nearest, steady)


PAIRS: dict[tuple[str, str], Pair] = {
    ("plane", "sphere"): Pair(plane_sphere, 1),
    ("plane", "capsule"): Pair(plane_capsule, 2),
    ("plane", "box"): Pair(plane_box, 4),
    ("plane", "cylinder"): Pair(plane_cylinder, 4, steady=False),
    ("plane", "cone"): Pair(plane_cone, 4, steady=False),
    ("plane", "polyhedron"): Pair(plane_polyhedron, 4),
    ("sphere", "sphere"): Pair(sphere_sphere, 1),
    ("sphere", "capsule"): Pair(sphere_capsule, 1),
    ("sphere", "box"): Pair(sphere_box, 1),
    ("sphere", "cylinder"): Pair(sphere_cylinder, 1),
    ("sphere", "cone"): Pair(sphere_cone, 1),
    ("sphere", "polyhedron"): Pair(sphere_polyhedron, 1),
    ("capsule", "capsule"): Pair(capsule_capsule, 2, CLOSED_FORM, capsule_distance),
    ("capsule", "box"): Pair(capsule_box, 2, CLOSED_FORM, capsule_box_distance),
    ("box", "box"): Pair(box_box, 4, SEPARATING_AXES, box_distance),
}
PAIRS |= {
    (kind.name, "heightfield"): Pair(heightfield_pair(kind), HEIGHTFIELD_POINTS, LOCAL_CELLS, steady=False)
    for kind in HEIGHTFIELD_KINDS
}
PAIRS |= {(a, b): _convex(a, b) for k, a in enumerate(CONVEX) for b in CONVEX[k:] if (a, b) not in PAIRS}

__all__ = ["PAIRS", "Pair", "PairFunction"]
