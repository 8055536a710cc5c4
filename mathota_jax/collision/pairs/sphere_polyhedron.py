"""Sphere against polyhedron: closest point of the polyhedron to the centre."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.candidates import best_candidate, pick
from mathota_jax.collision.closest import clamp, direction, round_point
from mathota_jax.collision.manifold import Manifold
from mathota_jax.collision.polyhedron import PolyhedronFaces, polyhedron_surface
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import settle_code
from mathota_jax.spatial.vector import Vec3, cross, dot, where


def sphere_polyhedron(sphere: dict[str, Any], pose_a: Pose, polyhedron: dict[str, Any], pose_b: Pose) -> Manifold:
    """One contact; exact outside and inside: a centre inside leaves through the nearest face.

    All faces and edges are compared; the winner alone is differentiated.
    """
    assert pose_b.rotation is not None
    center = pose_b.point_to_local(pose_a.position)
    faces, start, end = polyhedron_surface(polyhedron)
    face, edge = _closest_feature(*lax.stop_gradient((center, faces, start, end)))
    on_edge = edge >= 0

    normal, anchor = pick((faces.normal, faces.center), face)
    on_face = center - normal * dot(normal, center - anchor)
    corner = pick((start, end), edge)
    along = _on_segment(center, *corner)
    surface = where(on_edge, along, on_face)
    # An edge wins only from a distance at which its direction is well defined.
    outward = where(on_edge, direction(where(on_edge, center - along, normal), normal, 0.0), normal)
    normal_w = -pose_b.rotation.apply(outward)
    point = round_point(pose_a.position, pose_b.point_to_world(surface), normal_w, sphere["radius"], 0.0)
    return Manifold(normal_w, (point,))


def _on_segment(point: Vec3, start: Vec3, end: Vec3) -> Vec3:
    span = end - start
    share = clamp(safe_divide(dot(point - start, span), dot(span, span)), 0.0, 1.0)
    return start + span * share


def _closest_feature(center: Vec3, faces: PolyhedronFaces, start: Vec3, end: Vec3) -> tuple[Array, Array]:
    """Settled numbers of the closest face, and of the closest edge where that is nearer (else -1)."""
    number = center.x.dtype
    gap = center - _on_segment(center, start, end)
    edge_score, edge = best_candidate(-dot(gap, gap))
    height = dot(faces.normal, center - faces.center)
    # The centre is over a face when it is inside of the walls on all its edges.
    following = faces.corners.map(lambda c: jnp.roll(c, -1, axis=0))
    walls = cross(faces.normal, following - faces.corners)
    over = jnp.min(dot(walls, center - faces.corners), axis=0) >= 0
    size = jnp.max(jnp.abs(start.x) + jnp.abs(start.y) + jnp.abs(start.z), axis=0)
    tiny = (16.0 * jnp.finfo(number).eps * size) ** 2
    highest, nearest = best_candidate(height)
    outside = settle_code(((highest > 0) & (edge_score < -tiny)).astype(number)) == 1
    lowest = jnp.finfo(number).min
    face_score, face = best_candidate(jnp.where(over & (height > 0), -height, lowest))
    over_none = face_score <= lowest
    use_edge = settle_code((outside & over_none).astype(number)) == 1
    face = jnp.where(outside & ~use_edge, face, nearest)
    return face, jnp.where(use_edge, edge, -1)
