"""Convex shapes against heightfields: local cells only, up to four contacts with normals of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mathota_jax.collision.heightfield import Kind, heightfield_contacts
from mathota_jax.collision.manifold import Manifold
from mathota_jax.collision.pairs.plane_box import plane_box
from mathota_jax.collision.pairs.plane_cone import plane_cone
from mathota_jax.collision.pairs.plane_cylinder import plane_cylinder
from mathota_jax.collision.pairs.plane_polyhedron import plane_polyhedron
from mathota_jax.collision.pairs.sphere_box import sphere_box
from mathota_jax.collision.pairs.sphere_capsule import sphere_capsule
from mathota_jax.collision.pairs.sphere_cone import sphere_cone
from mathota_jax.collision.pairs.sphere_cylinder import sphere_cylinder
from mathota_jax.collision.pairs.sphere_polyhedron import sphere_polyhedron
from mathota_jax.collision.pairs.sphere_sphere import sphere_sphere
from mathota_jax.spatial.pose import Pose

HEIGHTFIELD_POINTS = 4

KINDS = (
    Kind("sphere", sphere_sphere),
    Kind("capsule", sphere_capsule),
    Kind("box", sphere_box, plane_box),
    Kind("cylinder", sphere_cylinder, plane_cylinder),
    Kind("cone", sphere_cone, plane_cone),
    Kind("polyhedron", sphere_polyhedron, plane_polyhedron),
)
"""Convex kinds that meet heightfields."""


def heightfield_pair(kind: Kind) -> Callable[[dict[str, Any], Pose, dict[str, Any], Pose], Manifold]:
    """Pair function of a convex kind and a heightfield; see `heightfield_contacts`."""

    def pair(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
        return heightfield_contacts(kind, a, pose_a, b, pose_b)

    pair.__name__ = f"{kind.name}_heightfield"
    return pair
