"""Box against box: separating axis test, then face clipping, an edge crossing, or the closest points."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.collision.box_axes import best_axis, contact_size, preference_margin, relative_rotation
from mathota_jax.collision.box_clip import CROSSING_U, VERTEX, ClipPoint, clip_incident_face, code_parts
from mathota_jax.collision.box_frame import BoxFrame, box_frame
from mathota_jax.collision.closest import clamp, clamp_to_box
from mathota_jax.collision.manifold import ContactPoint, Manifold
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import compute_once, settle, settle_code
from mathota_jax.spatial.spread import for_each
from mathota_jax.spatial.vector import Vec3, dot, where

EDGE_PAIR = 16
"""Features: 0-7 corners of A, 8-15 corners of B, from here ``12 * edge of A + edge of B``, then the closest points."""
CLOSEST_POINTS = EDGE_PAIR + 144


def box_box(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
    """Up to four contacts.

    Faces are preferred to edges and A's faces to B's (`box_axes`); the separations reported are those of the features
    chosen, without the preference. The least separation of separated boxes is their distance, to the same preference
    (1e-3 of the size, nothing beyond a gap of 1e-2 of the size). `box_distance` is exact.

    Features do not depend on which box is the reference: corners are numbered by bits (x, y, z positive), edges by
    ``4 * direction + bits`` of the sides of the next two axes in cyclic order.

    Source: guide 7.2 (clipping, area-maximising reduction to four points); S. Gottschalk et al., "OBBTree" (1996).
    """
    assert pose_a.rotation is not None
    assert pose_b.rotation is not None
    half_a, half_b = a["half_extents"], b["half_extents"]
    size = contact_size(half_a, half_b)
    between = pose_b.position - pose_a.position
    c = relative_rotation(pose_a.rotation, pose_b.rotation)
    t, t_b = pose_a.rotation.apply_transposed(between), pose_b.rotation.apply_transposed(between)
    code = best_axis(c, t, t_b, half_a, half_b, size)
    frame = box_frame(code, pose_a, half_a, pose_b, half_b)

    clipped = clip_incident_face(frame, size)
    crossing = _edge_contact(frame)
    apart = _closest_points(frame, crossing, size)

    # Separated, and the axis of the test is not the direction of the closest points: then those.
    gap_grows = apart.separation > apart.depth + preference_margin(apart.depth, size)
    face_misses = (clipped.code[0] < 0) | ((apart.depth > 0) & gap_grows)
    edge_misses = crossing.clamped & (crossing.separation > 0)
    # What slot 0 holds: 0 a clipped point, 1 an edge crossing, 2 closest points of separated boxes,
    # 3 the deepest incident corner (overlapping, but no part of the incident face lies over the reference face).
    missed = jnp.where(apart.usable, 2.0, 3.0)
    mode = settle_code(
        jnp.where(
            frame.edge,
            jnp.where(edge_misses & apart.usable, 2.0, 1.0),
            jnp.where(face_misses, missed, 0.0),
        ).astype(t.x.dtype)
    )
    on_face, on_edge, on_closest = mode == 0, mode == 1, mode == 2
    up = Vec3(jnp.zeros_like(t.x), jnp.zeros_like(t.x), jnp.ones_like(t.x))
    normal = where(on_edge, crossing.normal, where(on_closest, apart.normal, up))
    facing = jnp.where(frame.reference_b, -1.0, 1.0).astype(t.x.dtype)
    normal_w = frame.basis.apply(normal) * facing

    # All four slots at once: as four expressions they would be compiled four times.
    in_first = jnp.asarray(np.arange(4) == 0).reshape(4, 1, 1)
    from_clip = on_face | ~in_first
    closest = jnp.where(on_closest, apart.separation, apart.depth)
    other_middle = where(on_edge, crossing.middle, apart.middle)
    other_separation = jnp.where(on_edge, crossing.separation, closest)
    other_middle, other_separation = compute_once((other_middle, other_separation), other_separation)
    of_pair = (frame.basis, frame.origin, frame.half.z, other_middle, other_separation)
    basis, origin, height, other_middle, other_separation = for_each(4, of_pair)
    middle = where(from_clip, Vec3(clipped.u, clipped.v, height + 0.5 * clipped.w), other_middle)
    separation = jnp.where(from_clip, clipped.w, other_separation)
    otherwise = jnp.where(on_edge, crossing.feature, CLOSEST_POINTS)
    feature = jnp.where(from_clip, _clip_feature(frame, clipped), otherwise)
    active = in_first | ((clipped.code >= 0) & on_face)
    normal_w = compute_once(normal_w, separation)
    slots = compute_once((*(origin + basis.apply(middle)), separation), separation)
    x, y, z, separation = (unstack(values, 0) for values in slots)
    fields = zip(x, y, z, separation, strict=True)
    points = [ContactPoint(Vec3(*p), gap, feature[k], active[k]) for k, (*p, gap) in enumerate(fields)]
    return Manifold(normal_w, tuple(points))


class _EdgeContact(NamedTuple):
    normal: Vec3
    middle: Vec3
    separation: Array
    feature: Array
    point_b: Vec3
    clamped: Array


def _edge_contact(frame: BoxFrame) -> _EdgeContact:
    """Closest points of A's edge along w and B's edge along ``incident.column_x`` (edge mode; finite in others)."""
    number = frame.half.x.dtype
    along, first, second = frame.incident
    squared = along.x * along.x + along.y * along.y
    inverse_squared = jnp.where(frame.edge, 1.0 / jnp.where(frame.edge, squared, 1.0), 0.0)
    length = jnp.sqrt(inverse_squared + jnp.where(frame.edge, 0.0, 1.0))
    inverse = length * jnp.where(frame.reverse, -1.0, 1.0).astype(number)
    normal = Vec3(-along.y * inverse, along.x * inverse, jnp.zeros_like(inverse))

    # Which of the four parallel edges of each box: those farthest along the normal, and against it.
    bits = settle_code(
        (normal.x > 0).astype(number)
        + 2.0 * (normal.y > 0)
        + 4.0 * (dot(normal, first) < 0)
        + 8.0 * (dot(normal, second) < 0)
    )
    sides = [jnp.where((bits >> k) & 1 == 1, 1.0, -1.0).astype(number) for k in range(4)]
    edge_u, edge_v = sides[0] * frame.half.x, sides[1] * frame.half.y
    other = frame.center + first * (sides[2] * frame.incident_half.y) + second * (sides[3] * frame.incident_half.z)
    gap_u, gap_v = other.x - edge_u, other.y - edge_v
    parameter = -(gap_u * along.x + gap_v * along.y) * inverse_squared
    inside = clamp(parameter, -frame.incident_half.x, frame.incident_half.x)
    point_b = other + along * inside
    point_a = Vec3(edge_u, edge_v, clamp(point_b.z, -frame.half.z, frame.half.z))
    edge_a = 4 * frame.axis + (bits & 3)
    edge_b = 4 * frame.incident_axis + (bits >> 2)
    return _EdgeContact(
        normal=normal,
        middle=(point_a + point_b) * 0.5,
        separation=normal.x * gap_u + normal.y * gap_v,
        feature=EDGE_PAIR + 12 * edge_a + edge_b,
        point_b=point_b,
        clamped=(parameter != inside) | (point_a.z != point_b.z),
    )


class _ClosestPoints(NamedTuple):
    usable: Array
    normal: Vec3
    middle: Vec3
    separation: Array
    depth: Array


def _closest_points(frame: BoxFrame, crossing: _EdgeContact, size: Array) -> _ClosestPoints:
    """Closest points by projecting onto A, B and A again, and the height of the incident corner deepest along w.

    Starts from that corner, in edge mode from the end of B's edge. One round is exact where the closest features are
    corners or a corner and an edge, the only cases that use it.
    """
    corner = frame.center + frame.incident.apply(
        Vec3(*(side * half for side, half in zip(_deepest_corner_sides(frame), frame.incident_half, strict=True)))
    )
    start = lax.stop_gradient(where(frame.edge, crossing.point_b, corner))
    on_b = compute_once(_onto_incident(frame, clamp_to_box(start, frame.half)), size)
    on_a = clamp_to_box(on_b, frame.half)
    difference = on_b - on_a
    squared = dot(difference, difference)
    tiny = (16.0 * jnp.finfo(squared.dtype).eps * size) ** 2
    usable = settle((squared > tiny).astype(squared.dtype)) > 0.5
    inverse = jnp.where(usable, 1.0 / jnp.sqrt(jnp.where(usable, squared, 1.0)), 0.0)
    return _ClosestPoints(
        usable=usable,
        normal=difference * inverse,
        middle=where(usable, (on_a + on_b) * 0.5, clamp_to_box(corner, frame.half)),
        separation=squared * inverse,
        depth=corner.z - frame.half.z,
    )


def _deepest_corner_sides(frame: BoxFrame) -> list[Array]:
    bits = sum(2.0**k * (lax.stop_gradient(axis.z) < 0) for k, axis in enumerate(frame.incident))
    bits = settle_code(jnp.asarray(bits, frame.half.x.dtype))
    return [jnp.where((bits >> k) & 1 == 1, 1.0, -1.0).astype(frame.half.x.dtype) for k in range(3)]


def _onto_incident(frame: BoxFrame, point: Vec3) -> Vec3:
    local = clamp_to_box(frame.incident.apply_transposed(point - frame.center), frame.incident_half)
    return frame.center + frame.incident.apply(local)


def _clip_feature(frame: BoxFrame, point: ClipPoint) -> Array:
    """Id of a clipped point, from the lines that meet in it."""
    parts = code_parts(point.code)
    first, second = parts.first_positive.astype(jnp.int32), parts.second_positive.astype(jnp.int32)
    corner, along_alpha, vertex = parts.group == 2, parts.group == 1, parts.ending == VERTEX
    on_u = parts.ending == CROSSING_U
    axis_u, axis_v = _next(frame.axis, 1), _next(frame.axis, 2)
    axis_1, axis_2 = _next(frame.incident_axis, 1), _next(frame.incident_axis, 2)

    incident_corner = (frame.incident_outward << frame.incident_axis) + (first << axis_1) + ((1 - second) << axis_2)
    reference_corner = (frame.outward << frame.axis) + (first << axis_u) + (second << axis_v)
    corner_of_b = frame.reference_b == corner
    corner_id = jnp.where(corner, reference_corner, incident_corner) + jnp.where(corner_of_b, 8, 0)

    # Incident edge: alpha fixed and the direction axis 2, or beta fixed and axis 1. Reference edge: by its side.
    incident_edge = jnp.where(
        along_alpha, 4 * axis_1 + first + 2 * frame.incident_outward, 4 * axis_2 + frame.incident_outward + 2 * first
    )
    side = _side(frame, point)
    reference_edge = jnp.where(on_u, 4 * axis_v + frame.outward + 2 * side, 4 * axis_u + side + 2 * frame.outward)
    edge_a = jnp.where(frame.reference_b, incident_edge, reference_edge)
    edge_b = jnp.where(frame.reference_b, reference_edge, incident_edge)
    return jnp.where(corner | vertex, corner_id, EDGE_PAIR + 12 * edge_a + edge_b)


def _side(frame: BoxFrame, point: ClipPoint) -> Array:
    """1 where a crossing lies on the positive side line of the rectangle."""
    parts = code_parts(point.code)
    _, axis_1, axis_2 = frame.incident
    free = where(parts.group == 1, axis_1, axis_2)
    component = lax.stop_gradient(jnp.where(parts.ending == CROSSING_U, free.x, free.y))
    return settle_code(((component < 0) == parts.second_positive).astype(component.dtype))


def _next(axis: Array, shift: int) -> Array:
    moved = axis + shift
    return jnp.where(moved >= 3, moved - 3, moved)
