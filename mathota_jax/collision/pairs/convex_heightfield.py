"""Convex shapes against heightfields: local cells only, up to four contacts with normals of their own."""

from __future__ import annotations

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

SPHERE = Kind("sphere", sphere_sphere)
CAPSULE = Kind("capsule", sphere_capsule)
BOX = Kind("box", sphere_box, plane_box)
CYLINDER = Kind("cylinder", sphere_cylinder, plane_cylinder)
CONE = Kind("cone", sphere_cone, plane_cone)
POLYHEDRON = Kind("polyhedron", sphere_polyhedron, plane_polyhedron)


def sphere_heightfield(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
    """Up to four contacts; see `heightfield_contacts`."""
    return heightfield_contacts(SPHERE, a, pose_a, b, pose_b)


def capsule_heightfield(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
    """Up to four contacts; see `heightfield_contacts`."""
    return heightfield_contacts(CAPSULE, a, pose_a, b, pose_b)


def box_heightfield(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
    """Up to four contacts; see `heightfield_contacts`."""
    return heightfield_contacts(BOX, a, pose_a, b, pose_b)


def cylinder_heightfield(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
    """Up to four contacts; see `heightfield_contacts`."""
    return heightfield_contacts(CYLINDER, a, pose_a, b, pose_b)


def cone_heightfield(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
    """Up to four contacts; see `heightfield_contacts`."""
    return heightfield_contacts(CONE, a, pose_a, b, pose_b)


def polyhedron_heightfield(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
    """Up to four contacts; see `heightfield_contacts`."""
    return heightfield_contacts(POLYHEDRON, a, pose_a, b, pose_b)
