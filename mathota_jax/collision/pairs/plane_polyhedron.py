"""Plane against polyhedron: the deepest vertex and those that span the largest base."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.candidates import LEAN, LEAN_SHARE, best_candidate, depth_lean, pick
from mathota_jax.collision.closest import round_point
from mathota_jax.collision.manifold import Manifold
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.vector import Vec3, cross, dot

HEIGHT_WEIGHT = 10.0
"""A vertex that lies higher than the deepest one must widen the base by this many times the height: what a tilt of
0.1 rad brings down counts as base."""
MERGE_DISTANCE = 1e-5
"""A vertex must widen the base by this share of the size to be a point of its own."""


def plane_polyhedron(plane: dict[str, Any], _: Pose, polyhedron: dict[str, Any], pose: Pose) -> Manifold:
    """Up to four contacts, the deepest vertex (see `depth_lean`) first. The feature is the number of the vertex."""
    assert pose.rotation is not None
    normal, vertices = plane["normal"], polyhedron["vertices"]
    codes = base_vertices(lax.stop_gradient(vertices), lax.stop_gradient(pose.rotation.apply_transposed(normal)))
    points = []
    for code in codes:
        corner = pose.point_to_world(pick(vertices, code))
        foot = corner - normal * (dot(normal, corner) - plane["offset"])
        points.append(round_point(foot, corner, normal, 0.0, 0.0, jnp.maximum(code, 0), code >= 0))
    return Manifold(normal, tuple(points))


def base_vertices(vertices: Vec3, up: Vec3) -> tuple[Array, Array, Array, Array]:
    """Settled numbers of up to four vertices on which a polyhedron stands, -1 for none; the lowest along `up` first.

    The farthest from the lowest, the farthest from the line through both and the one that adds most to the triangle
    follow (guide 7.2), each less `HEIGHT_WEIGHT` times its height.
    """
    size = jnp.max(safe_sqrt(dot(vertices, vertices)), axis=0)
    lean = dot(LEAN, vertices)
    height = dot(vertices, up)
    number = height.dtype
    _, first = best_candidate(lean * depth_lean(number) - height)
    lowest = pick(vertices, first)
    offset = vertices - lowest
    rise = dot(offset, up)
    penalty = HEIGHT_WEIGHT * rise - LEAN_SHARE * lean

    def winner(widening: Array, usable: Array) -> Array:
        distinct = (widening > MERGE_DISTANCE * size) & usable
        score, code = best_candidate(jnp.where(distinct, widening - penalty, jnp.finfo(number).min))
        return jnp.where(score > jnp.finfo(number).min, code, -1)

    second = winner(safe_sqrt(jnp.maximum(dot(offset, offset) - rise * rise, 0.0)), first >= 0)
    side = pick(offset, second)
    beyond = _beyond(offset, side, up)
    third = winner(jnp.abs(beyond), second >= 0)
    other_side = pick(offset, third)
    turn = jnp.where(dot(cross(side, other_side), up) > 0, -1.0, 1.0).astype(number)
    outside = jnp.maximum(
        turn * beyond,
        jnp.maximum(turn * _beyond(offset - side, other_side - side, up), -turn * _beyond(offset, other_side, up)),
    )
    return first, second, third, winner(outside, third >= 0)


def _beyond(offset: Vec3, side: Vec3, up: Vec3) -> Array:
    """Distance from the line along `side`, seen along `up`, positive to its left."""
    rise = dot(side, up)
    length = safe_sqrt(jnp.maximum(dot(side, side) - rise * rise, 0.0))
    return safe_divide(dot(cross(side, offset), up), length)
