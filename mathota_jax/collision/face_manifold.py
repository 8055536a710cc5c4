"""Manifold of any two convex shapes from their contact normal: clips the faces that look at each other.

Both faces are projected along the normal. The contact patch is the intersection of the two convex polygons; its
vertices are corners of one face inside the other and crossings of their edges. As in `box_clip` a *code* says which
corner or crossing a point is: the search for the (at most four) codes is not differentiated, the points are computed
from their codes. A segment (a generator of a cylinder) takes part in the search as a thin rectangle.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.candidates import best_candidate, pick
from mathota_jax.collision.closest import clamp
from mathota_jax.collision.faces import FACES, Face
from mathota_jax.collision.manifold import ContactPoint, Manifold
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.vector import Vec3, cross, dot, norm, normalize, tangent_basis, where

ALIGNED_COSINE = 0.995
"""A face counts as lying against the other shape when its normal is within 0.1 rad of the contact normal."""
STEEP_COSINE = 0.1
"""Faces nearly parallel to the normal have no height over the patch to speak of."""
WIDENING = 1e-3
"""The reference face is widened by this share of the size while deciding, so that equal faces stacked exactly keep
their corners as features instead of flickering between corners and crossings."""
MERGE_DISTANCE = 1e-3
"""Points closer than this share of the size are one."""
LINE_DISTANCE = 1e-5
"""Points closer than this share of the size to the line through two others add nothing to them."""
HEIGHT_WEIGHT = 10.0
"""A point higher than the deepest one must widen the patch by this many times the height (see `plane_polyhedron`)."""
LEAN = Vec3(0.48, 0.36, 0.8)
LEAN_SHARE = 1e-3
"""Scores lean to one side by this share, so that equally good points do not take turns in a tremor. The search for the
deepest point leans by eps^(3/4) only."""
DEPTH_TOLERANCE = 5e-10
"""The witness point is kept beside the patch where it is deeper by more than this share of the reach, or 64 eps."""


class _Face(NamedTuple):
    """A face in the world, from the witness point on; components (corner, pair, world) and (pair, world).

    `outline` are the corners of the polygon that is clipped: a segment broadened to a rectangle.
    """

    corners: Vec3
    outline: Vec3
    normal: Vec3
    breadth: Array
    corner_ids: Array


class _Candidates(NamedTuple):
    """Vertices of the patch: starts, then ends of the clipped incident edges, then reference corners."""

    u: Array
    v: Array
    gap: Array
    valid: Array


class _Meeting(NamedTuple):
    """Whether a point is a corner of the reference or a crossing of edges, and the ids of the ends of both edges."""

    at_reference: Array
    crossed: Array
    incident: Array
    incident_next: Array
    reference: Array
    reference_next: Array


def face_manifold(
    kind_a: str,
    a: dict[str, Any],
    pose_a: Pose,
    kind_b: str,
    b: dict[str, Any],
    pose_b: Pose,
    contact: Any,
) -> Manifold:
    """Up to four contacts: the deepest first, then those that span the largest area.

    One point, that of the witnesses, remains where no face lies against the other shape. No separation is less than
    the exact one, since the normal supports both shapes; all are measured along it, without bias.

    Features: corners of A (see `faces`), from ``count_a`` corners of B, then ``edge of A, edge of B`` for crossings
    (an edge is its two corners), last the witness point.

    Args:
        kind_a, kind_b: Kinds in `FACES`.
        a, b: Their parameters.
        pose_a, pose_b: Their poses.
        contact: `normal` (unit, A to B), `separation`, `point_a`, `point_b` of the exact deepest contact.

    Source: guide 7.2; E. Coumans' and S. Crouzet's one routine for all shapes (Bullet, Parry): clip the features that a
    direction supports.
    """
    swap = FACES[kind_a].flatness < FACES[kind_b].flatness
    normal = contact.normal
    origin = lax.stop_gradient((contact.point_a + contact.point_b) * 0.5)
    face_a = _world_face(FACES[kind_a].function, a, pose_a, normal, normal, origin)
    face_b = _world_face(FACES[kind_b].function, b, pose_b, -normal, normal, origin)
    reference, incident, facing = (face_b, face_a, -1.0) if swap else (face_a, face_b, 1.0)

    frozen = lax.stop_gradient((reference, incident, normal, contact.separation))
    code, use_witness = _search(*frozen, facing)
    middle, gap, meeting = _points(reference, incident, normal, code, facing)
    feature = _feature_ids(meeting, corner_count(kind_a, a), corner_count(kind_b, b), swap)

    witness = (contact.point_a + contact.point_b) * 0.5 - origin
    slots = middle.map(lambda c: unstack(c, 0))
    points = []
    for index, (separation, number, active) in enumerate(
        zip(unstack(gap, 0), unstack(feature, 0), unstack(code >= 0, 0), strict=True)
    ):
        position = Vec3(slots.x[index], slots.y[index], slots.z[index])
        if index == 0:
            position = where(use_witness, witness, position)
            separation = jnp.where(use_witness, contact.separation, separation)
            number = jnp.where(use_witness, witness_feature(kind_a, a, kind_b, b), number)
            active = active | use_witness
        points.append(ContactPoint(origin + position, separation, number, active))
    return Manifold(normal, tuple(points))


def corner_count(kind: str, shape: dict[str, Any]) -> int:
    """How many corner ids the faces of a shape use."""
    if kind == "polyhedron":
        return shape["vertices"].x.shape[0]
    return {"capsule": 2, "box": 8, "cylinder": 18, "cone": 10}[kind]


def witness_feature(kind_a: str, a: dict[str, Any], kind_b: str, b: dict[str, Any]) -> int:
    """Feature id of the single deepest point."""
    count_a, count_b = corner_count(kind_a, a), corner_count(kind_b, b)
    return count_a + count_b + count_a**2 * count_b**2


def _world_face(function: Any, shape: dict[str, Any], pose: Pose, outward: Vec3, normal: Vec3, origin: Vec3) -> _Face:
    """The face that looks most along `outward` (plus or minus the contact normal)."""
    assert pose.rotation is not None
    face: Face = function(shape, pose.rotation.apply_transposed(outward))
    corners = pose.rotation.apply(face.corners) + (pose.position - origin)
    span = corners.map(lambda c: c[1:2] - c[0:1])
    # Across a segment, to its left seen from outside; corners p, q, q, p, p, ... move right, right, left, left, ...
    left = lax.stop_gradient(normalize(cross(outward, span)))
    side = jnp.where(jnp.arange(corners.x.shape[0]) < 2, -1.0, 1.0).astype(corners.x.dtype)
    side = side.reshape((-1,) + (1,) * (corners.x.ndim - 1))
    outline = corners + left * (side * lax.stop_gradient(face.breadth))
    corners, outline, world_normal = compute_once((corners, outline, pose.rotation.apply(face.normal)), corners.x)
    return _Face(corners, outline, world_normal, face.breadth, face.corner_ids)


def _search(reference: _Face, incident: _Face, normal: Vec3, separation: Array, facing: float) -> tuple[Array, Array]:
    """Settled codes (4, pair, world) of the points kept, -1 for none, and whether slot 0 is the witness point."""
    number = normal.x.dtype
    size = jnp.minimum(_extent(reference), _extent(incident))
    cosine_r, cosine_i = dot(reference.normal, normal) * facing, -dot(incident.normal, normal) * facing
    against = jnp.maximum(cosine_r, cosine_i) > ALIGNED_COSINE
    usable = settle_code((against & (jnp.minimum(cosine_r, cosine_i) > STEEP_COSINE)).astype(number)) == 1
    candidates = _candidates(reference, incident, normal, WIDENING * size, facing, usable)
    candidates = _Candidates(*compute_once(tuple(candidates), candidates.gap))
    first, second = tangent_basis(normal)
    lean = (dot(LEAN, first) * candidates.u + dot(LEAN, second) * candidates.v) * LEAN_SHARE

    both_segments = jnp.minimum(reference.breadth, incident.breadth) > 0
    breadth = reference.breadth + incident.breadth
    merge = jnp.where(both_segments, 4.0 * breadth, MERGE_DISTANCE * size)
    line = LINE_DISTANCE * size + 3.0 * breadth
    lowest = jnp.finfo(number).min

    def winner(widening: Array, least: Any, penalty: Array) -> Array:
        usable_here = (candidates.valid > 0) & (widening > least)
        score, code = best_candidate(jnp.where(usable_here, widening - penalty, lowest))
        return jnp.where(score > lowest, code, -1)

    slope = jnp.finfo(number).eps ** 0.75 / LEAN_SHARE
    deepest = winner(-candidates.gap, lowest, -slope * lean)
    u0, v0, gap0 = pick((candidates.u, candidates.v, candidates.gap), deepest)
    reach = size + norm(pick(incident.corners, jnp.zeros_like(deepest))) + jnp.abs(separation)
    tolerance = max(DEPTH_TOLERANCE, 64.0 * float(jnp.finfo(number).eps)) * reach
    misses = settle_code(((deepest < 0) | (gap0 > separation + tolerance)).astype(number)) == 1
    u0, v0, gap0 = (jnp.where(misses, value, other) for value, other in ((0.0, u0), (0.0, v0), (separation, gap0)))

    penalty = HEIGHT_WEIGHT * jnp.maximum(candidates.gap - gap0, 0.0) - lean
    du, dv = candidates.u - u0, candidates.v - v0
    second_code = winner(safe_sqrt(du * du + dv * dv), merge, penalty)
    u1, v1 = pick((du, dv), second_code)
    beyond = _beyond(du, dv, u1, v1)
    third_code = winner(jnp.abs(beyond), jnp.where(second_code < 0, jnp.inf, line), penalty)
    u2, v2 = pick((du, dv), third_code)
    turn = jnp.where(u1 * v2 - v1 * u2 > 0, -1.0, 1.0).astype(number)
    outside = jnp.maximum(
        turn * beyond,
        jnp.maximum(turn * _beyond(du - u1, dv - v1, u2 - u1, v2 - v1), -turn * _beyond(du, dv, u2, v2)),
    )
    fourth_code = winner(outside, jnp.where(third_code < 0, jnp.inf, line), penalty)
    return jnp.stack([jnp.where(misses, -1, deepest), second_code, third_code, fourth_code]), misses


def _extent(face: _Face) -> Array:
    """Largest distance of a corner from the first one."""
    offset = face.corners - face.corners.map(lambda c: c[:1])
    return safe_sqrt(jnp.max(dot(offset, offset), axis=0))


def _beyond(u: Array, v: Array, along_u: Array, along_v: Array) -> Array:
    """Distance from the line through the origin, positive to its left."""
    return safe_divide(along_u * v - along_v * u, safe_sqrt(along_u * along_u + along_v * along_v))


def _candidates(
    reference: _Face, incident: _Face, normal: Vec3, widening: Array, facing: float, usable: Array
) -> _Candidates:
    first, second = tangent_basis(normal)
    reference_u, reference_v = dot(first, reference.outline), dot(second, reference.outline)
    incident_u, incident_v = dot(first, incident.outline), dot(second, incident.outline)

    # Cyrus and Beck (1978): each incident edge (axis 1) against each side of the reference (axis 0).
    distance = _inside(reference_u[:, None], reference_v[:, None], incident_u, incident_v, facing) + widening
    rate = _next(distance, 1) - distance
    crossing = jnp.where(rate != 0, -distance / jnp.where(rate != 0, rate, 1.0), 0.0)
    missed = (rate == 0) & (distance < 0)
    enter = jnp.maximum(jnp.max(jnp.where(rate > 0, crossing, 0.0), axis=0), 0.0)
    leave = jnp.minimum(jnp.min(jnp.where(rate < 0, crossing, 1.0), axis=0), 1.0)
    kept = (enter <= leave) & ~jnp.any(missed, axis=0) & usable
    u, v = dot(first, incident.corners), dot(second, incident.corners)
    gap = _height(reference, incident.corners, normal)
    step_u, step_v, step_gap = _next(u, 0) - u, _next(v, 0) - v, _next(gap, 0) - gap
    starts = (u + enter * step_u, v + enter * step_v, gap + enter * step_gap, kept & (enter < 1.0))
    # An edge that is not cut ends where the next one starts.
    ends = (u + leave * step_u, v + leave * step_v, gap + leave * step_gap, kept & (leave < 1.0) & (leave > enter))

    within = jnp.min(_inside(incident_u[:, None], incident_v[:, None], reference_u, reference_v, -facing), axis=0)
    corners = (
        dot(first, reference.corners),
        dot(second, reference.corners),
        _height(incident, reference.corners, normal),
        (within >= 0) & usable,
    )
    fields = []
    for parts in zip(starts, ends, corners, strict=True):
        shape = jnp.broadcast_shapes(*(part.shape[1:] for part in parts))
        full = [jnp.broadcast_to(part, (part.shape[0], *shape)).astype(u.dtype) for part in parts]
        fields.append(jnp.concatenate(compute_once(full, full[0])))
    return _Candidates(*fields)


def _inside(side_u: Array, side_v: Array, u: Array, v: Array, turn: float) -> Array:
    """Distances of points from the sides (leading axis) of a polygon, positive inside; 0 for sides without length."""
    along_u, along_v = _next(side_u, 0) - side_u, _next(side_v, 0) - side_v
    return turn * _beyond(u - side_u, v - side_v, along_u, along_v)


def _next(values: Array, axis: int) -> Array:
    """The values at the following corners."""
    return jnp.roll(values, -1, axis=axis)


def _height(face: _Face, points: Vec3, normal: Vec3) -> Array:
    """Height of points over the plane of a face, measured along the contact normal."""
    base = face.corners.map(lambda c: c[0])
    return safe_divide(dot(face.normal, points - base), jnp.abs(dot(face.normal, normal)))


def _points(
    reference: _Face, incident: _Face, normal: Vec3, code: Array, facing: float
) -> tuple[Vec3, Array, _Meeting]:
    """Points midway between the faces, their gaps along the normal and what meets in each; (4, pair, world).

    Differentiable but for the codes.
    """
    count = incident.corners.x.shape[0]
    at_corner = code >= 2 * count
    at_end = (code >= count) & ~at_corner
    edge = jnp.where(at_corner, 0, jnp.where(at_end, code - count, jnp.maximum(code, 0)))
    start, end, outline_start, outline_end, id_start, id_end = _pick_edge(incident, edge)

    # Which side of the reference cuts the edge: the last one entered, the first one left.
    frozen_start, frozen_end, frozen_normal = lax.stop_gradient((outline_start, outline_end, normal))
    first, second = tangent_basis(frozen_normal)
    outline = jax.tree.map(lambda c: c[:, None], lax.stop_gradient(reference.outline))
    reference_u, reference_v = dot(first, outline), dot(second, outline)
    size = jnp.minimum(_extent(reference), _extent(incident))
    before = _inside(reference_u, reference_v, dot(first, frozen_start), dot(second, frozen_start), facing)
    after = _inside(reference_u, reference_v, dot(first, frozen_end), dot(second, frozen_end), facing)
    before, after = before + WIDENING * lax.stop_gradient(size), after + WIDENING * lax.stop_gradient(size)
    rate = after - before
    crossing = jnp.where(rate != 0, -before / jnp.where(rate != 0, rate, 1.0), 0.0)
    number = crossing.dtype
    lowest = jnp.finfo(number).min
    entered = jnp.where((rate > 0) & ~at_end, crossing, jnp.where((rate < 0) & at_end, -crossing, lowest))
    share, side = best_candidate(entered)
    crossed = settle_code((~at_corner & (at_end | (share > 0.0))).astype(number)) == 1
    side = jnp.where(at_corner, code - 2 * count, side)

    corner, _, side_start, side_end, id_side, id_next = _pick_edge(reference, side)
    # Where the edge meets the line of that side, seen along the normal.
    wall = cross(side_end - side_start, normal)
    share = clamp(safe_divide(dot(wall, corner - start), dot(wall, end - start)), 0.0, 1.0)
    on_incident = start + (end - start) * jnp.where(crossed, share, 0.0)
    point = where(at_corner, corner, on_incident)
    height = jnp.where(at_corner, _height(incident, corner, normal), _height(reference, on_incident, normal))
    # From a point on A the gap leads along the normal, from a point on B against it.
    middle = point + normal * (jnp.where(at_corner, 0.5 * facing, -0.5 * facing).astype(number) * height)
    return middle, height, _Meeting(at_corner, crossed, id_start, id_end, id_side, id_next)


def _pick_edge(face: _Face, index: Array) -> tuple[Vec3, Vec3, Vec3, Vec3, Array, Array]:
    """Ends of the edge `index` (slot, pair, world), ends of its outline, and their ids."""
    values = jax.tree.map(lambda c: c[:, None], (face.corners, face.outline, face.corner_ids))
    corners, outline, ids = pick(values, index)
    next_corners, next_outline, next_ids = pick(jax.tree.map(lambda c: _next(c, 0), values), index)
    return corners, next_corners, outline, next_outline, ids, next_ids


def _feature_ids(meeting: _Meeting, count_a: int, count_b: int, swap: bool) -> Array:
    """See `face_manifold`."""
    count_incident, count_reference = (count_a, count_b) if swap else (count_b, count_a)
    incident_offset, reference_offset = (0, count_a) if swap else (count_a, 0)
    incident_edge = _edge_id(meeting.incident, meeting.incident_next, count_incident)
    reference_edge = _edge_id(meeting.reference, meeting.reference_next, count_reference)
    edge_a, edge_b = (incident_edge, reference_edge) if swap else (reference_edge, incident_edge)
    corner = jnp.where(meeting.at_reference, reference_offset + meeting.reference, incident_offset + meeting.incident)
    return jnp.where(meeting.crossed, count_a + count_b + edge_a * count_b**2 + edge_b, corner)


def _edge_id(first: Array, second: Array, count: int) -> Array:
    """The same from either end."""
    return jnp.minimum(first, second) * count + jnp.maximum(first, second)
