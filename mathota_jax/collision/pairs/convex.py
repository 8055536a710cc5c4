"""Any two convex shapes: exact closest points, then the faces that meet there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from mathota_jax.collision.convex import convex_distance
from mathota_jax.collision.face_manifold import face_manifold, point_count
from mathota_jax.collision.faces import FACES
from mathota_jax.collision.manifold import ContactPoint, Manifold, Nearest
from mathota_jax.spatial.pose import Pose


def convex_pair(kind_a: str, kind_b: str) -> Callable[[dict[str, Any], Pose, dict[str, Any], Pose], Manifold]:
    """Pair function of two kinds that have a support function; for a manifold both need a face (`FACES`), too."""

    def pair(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
        contact = convex_distance(kind_a, a, pose_a, kind_b, b, pose_b)
        if kind_a in FACES and kind_b in FACES:
            found = face_manifold(kind_a, a, pose_a, kind_b, b, pose_b, contact)
            return found._replace(converged=contact.converged)
        middle = (contact.point_a + contact.point_b) * 0.5
        always = jnp.ones(jnp.shape(contact.separation), bool)
        point = ContactPoint(middle, contact.separation, contact.feature, always)
        return Manifold(contact.normal, (point,), contact.converged)

    pair.__name__ = f"{kind_a}_{kind_b}"
    return pair


def convex_nearest(kind_a: str, kind_b: str) -> Callable[[dict[str, Any], Pose, dict[str, Any], Pose], Nearest]:
    """Distance function of two kinds that have a support function."""

    def nearest(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Nearest:
        found = convex_distance(kind_a, a, pose_a, kind_b, b, pose_b)
        return Nearest(found.separation, found.normal, found.point_a, found.point_b, found.converged)

    return nearest


def convex_point_count(kind_a: str, kind_b: str) -> int:
    """Contact points of `convex_pair`: one for a shape without faces, two for a capsule, else four."""
    return point_count(kind_a, kind_b) if kind_a in FACES and kind_b in FACES else 1
