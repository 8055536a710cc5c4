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

from mathota_jax.collision.candidates import LEAN, LEAN_SHARE, best_candidate, deepest_candidate, depth_tolerance, pick
from mathota_jax.collision.closest import clamp
from mathota_jax.collision.convex import ConvexContact
from mathota_jax.collision.faces import FACES
from mathota_jax.collision.manifold import ContactPoint, Manifold
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.spread import greatest, least
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


class _Face(NamedTuple):
    """A face in the world, from the witness point on; components (corner, pair, world) and (pair, world).

    `left` leads from a segment p, q, q, p, ... to the left side of the rectangle that stands for it; None for kinds
    that have polygons only.
    """

    corners: Vec3
    center: Vec3
    normal: Vec3
    left: Vec3 | None
    breadth: Array
    corner_ids: Array


class _Outline(NamedTuple):
    """A face seen along the normal: its corners and, of the polygon to be clipped, corners, edges and inner normals."""

    u: Array
    v: Array
    outer_u: Array
    outer_v: Array
    along_u: Array
    along_v: Array
    inward_u: Array
    inward_v: Array


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
    contact: ConvexContact,
) -> Manifold:
    """Up to four contacts (see `point_count`): the deepest first, then those that span the largest area.

    One point, that of the witnesses, remains where no face lies against the other shape. No separation is less than
    the exact one, since the normal supports both shapes; all are measured along it, without bias.

    Features: corners of A (see `faces`), from ``count_a`` corners of B, then ``edge of A, edge of B`` for crossings
    (an edge is its two corners), last the witness point.

    Args:
        kind_a, kind_b: Kinds in `FACES`.
        a, b: Their parameters.
        pose_a, pose_b: Their poses.
        contact: The exact deepest contact.

    Source: guide 7.2; as in Bullet and Parry one routine clips, for all shapes, the features that a direction supports.
    """
    swap = FACES[kind_a].flatness < FACES[kind_b].flatness
    normal = contact.normal
    origin = lax.stop_gradient((contact.point_a + contact.point_b) * 0.5)
    face_a = _world_face(kind_a, a, pose_a, normal, origin)
    face_b = _world_face(kind_b, b, pose_b, -normal, origin)
    reference, incident, facing = (face_b, face_a, -1.0) if swap else (face_a, face_b, 1.0)

    frozen = lax.stop_gradient((reference, incident, normal))
    outlines = _outline(frozen[0], normal, facing), _outline(frozen[1], normal, -facing)
    size = jnp.minimum(_extent(frozen[0]), _extent(frozen[1]))
    slots = point_count(kind_a, kind_b)
    code, use_witness = _search(*frozen, *outlines, lax.stop_gradient(contact.separation), size, facing, slots)
    least = lax.stop_gradient(contact.separation)
    middle, gap, meeting = _points(reference, incident, normal, *outlines, code, least, size, facing)
    feature = _feature_ids(meeting, corner_count(kind_a, a), corner_count(kind_b, b), swap)

    witness = (contact.point_a + contact.point_b) * 0.5 - origin
    positions = [Vec3(*components) for components in zip(*(unstack(c, 0) for c in middle), strict=True)]
    points = []
    fields = positions, unstack(gap, 0), unstack(feature, 0), unstack(code >= 0, 0)
    for index, (position, separation, number, active) in enumerate(zip(*fields, strict=True)):
        if index == 0:
            position = where(use_witness, witness, position)
            separation = jnp.where(use_witness, contact.separation, separation)
            number = jnp.where(use_witness, witness_feature(kind_a, a, kind_b, b), number)
            active = active | use_witness
        points.append(ContactPoint(origin + position, separation, number, active))
    return Manifold(normal, tuple(points))


def point_count(kind_a: str, kind_b: str) -> int:
    """Slots of the manifold of two kinds: two where one of them has no flat face."""
    return 2 if min(FACES[kind_a].flatness, FACES[kind_b].flatness) == 0 else 4


def corner_count(kind: str, shape: dict[str, Any]) -> int:
    """How many corner ids the faces of a shape use."""
    count = FACES[kind].corner_count
    return shape["vertices"].x.shape[0] if count is None else count


def witness_feature(kind_a: str, a: dict[str, Any], kind_b: str, b: dict[str, Any]) -> int:
    """Feature id of the single deepest point."""
    count_a, count_b = corner_count(kind_a, a), corner_count(kind_b, b)
    return count_a + count_b + count_a**2 * count_b**2


def _world_face(kind: str, shape: dict[str, Any], pose: Pose, outward: Vec3, origin: Vec3) -> _Face:
    """The face that looks most along `outward` (plus or minus the contact normal)."""
    assert pose.rotation is not None
    face = FACES[kind].function(shape, pose.rotation.apply_transposed(outward))
    corners = compute_once(face.corners, origin.x)
    corners = pose.rotation.apply(corners) + (pose.position - origin)
    # Plane through the middle, not a corner, which may be far away and round off.
    center = corners.map(lambda c: jnp.mean(c, axis=0))
    corners, center, world_normal = compute_once((corners, center, pose.rotation.apply(face.normal)), origin.x)
    left = None
    if FACES[kind].flatness < 2:
        span = corners.map(lambda c: c[1] - c[0])
        left = lax.stop_gradient(normalize(cross(outward, span)) * face.breadth)
    return _Face(corners, center, world_normal, left, lax.stop_gradient(face.breadth), face.corner_ids)


def _outline(face: _Face, normal: Vec3, turn: float) -> _Outline:
    """Projects a face; `turn` is 1 if it runs counter-clockwise seen against the normal, else -1."""
    first, second = tangent_basis(lax.stop_gradient(normal))
    u, v = dot(first, face.corners), dot(second, face.corners)
    outer_u, outer_v = u, v
    if face.left is not None:
        # Corners p, q, q, p, p, ... move right, right, left, left, ...
        side = jnp.where(jnp.arange(u.shape[0]) < 2, -1.0, 1.0).astype(u.dtype).reshape((-1,) + (1,) * (u.ndim - 1))
        outer_u, outer_v = u + side * dot(first, face.left), v + side * dot(second, face.left)
    u, v, outer_u, outer_v = compute_once((u, v, outer_u, outer_v), u)
    along_u, along_v = _next(outer_u) - outer_u, _next(outer_v) - outer_v
    length = safe_sqrt(along_u * along_u + along_v * along_v)
    inward = safe_divide(-turn * along_v, length), safe_divide(turn * along_u, length)
    return _Outline(u, v, outer_u, outer_v, *compute_once((along_u, along_v, *inward), u))


def _search(
    reference: _Face,
    incident: _Face,
    normal: Vec3,
    reference_outline: _Outline,
    incident_outline: _Outline,
    separation: Array,
    size: Array,
    facing: float,
    slots: int,
) -> tuple[Array, Array]:
    """Settled codes (slot, pair, world) of the points kept, -1 for none, and whether slot 0 is the witness point."""
    number = normal.x.dtype
    cosine_r, cosine_i = dot(reference.normal, normal) * facing, -dot(incident.normal, normal) * facing
    against = jnp.maximum(cosine_r, cosine_i) > ALIGNED_COSINE
    usable = settle_code((against & (jnp.minimum(cosine_r, cosine_i) > STEEP_COSINE)).astype(number)) == 1
    gaps = _height(reference, incident.corners, normal), _height(incident, reference.corners, normal)
    candidates = _candidates(reference_outline, incident_outline, *gaps, WIDENING * size, usable)
    first, second = tangent_basis(normal)
    lean = (dot(LEAN, first) * candidates.u + dot(LEAN, second) * candidates.v) * LEAN_SHARE

    both_segments = jnp.minimum(reference.breadth, incident.breadth) > 0
    breadth = reference.breadth + incident.breadth
    merge = jnp.where(both_segments, 6.0 * breadth, MERGE_DISTANCE * size)
    line = LINE_DISTANCE * size + 3.0 * breadth
    lowest = jnp.finfo(number).min

    def winner(widening: Array, least: Any, penalty: Array) -> Array:
        usable_here = (candidates.valid > 0) & (widening > least)
        score, code = best_candidate(jnp.where(usable_here, widening - penalty, lowest))
        return jnp.where(score > lowest, code, -1)

    tolerance = depth_tolerance(number) * size
    depth, deepest = deepest_candidate(jnp.where(candidates.valid > 0, -candidates.gap, lowest), lean, tolerance)
    deepest = jnp.where(depth > lowest, deepest, -1)
    u0, v0, gap0 = pick((candidates.u, candidates.v, candidates.gap), deepest)
    # Is the witness point deeper than the patch? Then it lies outside of the polygons, on the rim of a disc.
    reach = size + norm(incident.corners.map(lambda c: c[0])) + jnp.abs(separation)
    tolerance = 2.0 * tolerance + 16.0 * jnp.finfo(number).eps * reach
    misses = settle_code(((deepest < 0) | (gap0 > separation + tolerance)).astype(number)) == 1
    u0, v0, gap0 = (jnp.where(misses, value, other) for value, other in ((0.0, u0), (0.0, v0), (separation, gap0)))

    penalty = HEIGHT_WEIGHT * jnp.maximum(candidates.gap - gap0, 0.0) - lean
    du, dv = candidates.u - u0, candidates.v - v0
    second_code = winner(safe_sqrt(du * du + dv * dv), merge, penalty)
    u1, v1 = pick((du, dv), second_code)
    beyond = _beyond(du, dv, u1, v1)
    # A patch of no extent is the witness point.
    alone = misses | (second_code < 0)
    codes = [jnp.where(alone, -1, deepest), second_code]
    if slots == 2:
        return jnp.stack(codes), alone
    third_code = winner(jnp.abs(beyond), jnp.where(second_code < 0, jnp.inf, line), penalty)
    u2, v2 = pick((du, dv), third_code)
    turn = jnp.where(u1 * v2 - v1 * u2 > 0, -1.0, 1.0).astype(number)
    outside = jnp.maximum(
        turn * beyond,
        jnp.maximum(turn * _beyond(du - u1, dv - v1, u2 - u1, v2 - v1), -turn * _beyond(du, dv, u2, v2)),
    )
    fourth_code = winner(outside, jnp.where(third_code < 0, jnp.inf, line), penalty)
    return jnp.stack([*codes, third_code, fourth_code]), alone


def _extent(face: _Face) -> Array:
    """Largest distance of a corner from the first one."""
    offset = face.corners - face.corners.map(lambda c: c[:1])
    return safe_sqrt(greatest(dot(offset, offset)))


def _beyond(u: Array, v: Array, along_u: Array, along_v: Array) -> Array:
    """Distance from the line through the origin, positive to its left."""
    return safe_divide(along_u * v - along_v * u, safe_sqrt(along_u * along_u + along_v * along_v))


def _candidates(
    reference: _Outline, incident: _Outline, gap: Array, corner_gap: Array, widening: Array, usable: Array
) -> _Candidates:
    """Vertices of the patch, from the gaps at the incident and at the reference corners."""
    distance = _distance(reference, incident.outer_u, incident.outer_v) + widening
    crossing, rate = _crossing(reference, distance, incident.along_u, incident.along_v)
    enter = greatest(jnp.where(rate > 0, crossing, jnp.where((rate == 0) & (distance < 0), 2.0, 0.0)))
    leave = least(jnp.where(rate < 0, crossing, 1.0))
    enter, leave = jnp.maximum(enter, 0.0), jnp.minimum(leave, 1.0)
    edges = incident.u, incident.v, gap
    starts = [value + enter * (_next(value) - value) for value in edges]
    ends = [value + leave * (_next(value) - value) for value in edges]
    # An edge that is not cut ends where the next one starts.
    starts.append((enter <= leave) & (enter < 1.0) & usable)
    ends.append((enter < leave) & (leave < 1.0) & usable)
    within = least(_distance(incident, reference.u, reference.v))
    corners = [reference.u, reference.v, corner_gap, (within >= 0) & usable]

    fields = []
    for parts in zip(starts, ends, corners, strict=True):
        shape = jnp.broadcast_shapes(*(part.shape[1:] for part in parts))
        full = [jnp.broadcast_to(part, (part.shape[0], *shape)).astype(gap.dtype) for part in parts]
        fields.append(jnp.concatenate(compute_once(full, full[0])))
    return _Candidates(*fields)


def _distance(outline: _Outline, u: Array, v: Array) -> Array:
    """Distances of points (corner, ...) from the sides (leading axis), positive inside; 0 for sides without length."""
    side_u, side_v, inward_u, inward_v = (
        x[:, None] for x in (outline.outer_u, outline.outer_v, outline.inward_u, outline.inward_v)
    )
    return inward_u * (u - side_u) + inward_v * (v - side_v)


def _crossing(outline: _Outline, distance: Array, along_u: Array, along_v: Array) -> tuple[Array, Array]:
    """Where edges cross the sides, as shares of the edges, and how fast they come inward (M. Cyrus, J. Beck 1978)."""
    rate = outline.inward_u[:, None] * along_u + outline.inward_v[:, None] * along_v
    return jnp.where(rate != 0, -distance / jnp.where(rate != 0, rate, 1.0), 0.0), rate


def _next(values: Array) -> Array:
    """The values at the following corners."""
    return jnp.roll(values, -1, axis=0)


def _height(face: _Face, points: Vec3, normal: Vec3) -> Array:
    """Height of points over the plane of a face, measured along the contact normal."""
    return safe_divide(dot(face.normal, points - face.center), jnp.abs(dot(face.normal, normal)))


def _points(
    reference: _Face,
    incident: _Face,
    normal: Vec3,
    reference_outline: _Outline,
    incident_outline: _Outline,
    code: Array,
    least: Array,
    size: Array,
    facing: float,
) -> tuple[Vec3, Array, _Meeting]:
    """Points midway between the faces, their gaps along the normal and what meets in each; (slot, pair, world).

    Differentiable but for the codes.

    The corners of a steep face lie as far beside the widened reference as it is widened, and a multiple of that above or
    below its plane: `least`, the exact separation, bounds the gaps and is that of the first point.
    """
    number = normal.x.dtype
    count = incident.corners.x.shape[0]
    at_corner = code >= 2 * count
    at_end = (code >= count) & ~at_corner
    edge = jnp.where(at_corner, 0, jnp.where(at_end, code - count, jnp.maximum(code, 0)))
    edge = settle_code(edge.astype(number))
    start, end, id_start, id_end = _pick_edge(incident, edge)

    # Which side of the reference cuts the edge: the last one entered, the first one left.
    outer_u, outer_v, along_u, along_v = pick(jax.tree.map(lambda x: x[:, None], incident_outline[2:6]), edge)
    distance = _distance(reference_outline, outer_u, outer_v) + WIDENING * size
    crossing, rate = _crossing(reference_outline, distance, along_u, along_v)
    cuts = jnp.where(at_end, rate < 0, rate > 0)
    share, side = best_candidate(jnp.where(cuts, jnp.where(at_end, -crossing, crossing), jnp.finfo(number).min))
    crossed = settle_code((~at_corner & (at_end | (share > 0.0))).astype(number)) == 1
    side = settle_code(jnp.where(at_corner, code - 2 * count, side).astype(number))

    corner, next_corner, id_side, id_next = _pick_edge(reference, side)
    along = next_corner - corner
    if reference.left is not None:  # the short sides of the rectangle
        last = reference.corners.x.shape[0] - 1
        along = along + reference.left * jnp.where(side == 1, 2.0, jnp.where(side == last, -2.0, 0.0)).astype(number)
    # Where the edge meets the line of that side, seen along the normal.
    wall = cross(along, normal)
    share = clamp(safe_divide(dot(wall, corner - start), dot(wall, end - start)), 0.0, 1.0)
    on_incident = start + (end - start) * compute_once(jnp.where(crossed, share, 0.0), normal.x)
    point = where(at_corner, corner, on_incident)
    height = jnp.where(at_corner, _height(incident, corner, normal), _height(reference, on_incident, normal))
    first = jnp.arange(code.shape[0])[:, None, None] == 0
    excess = lax.stop_gradient(height) - least
    wrong = (excess < 0) | (first & (excess > depth_tolerance(number) * size))
    height = compute_once(height - jnp.where(wrong, excess, 0.0), normal.x)
    # From a point on A the gap leads along the normal, from a point on B against it.
    middle = point + normal * (jnp.where(at_corner, 0.5 * facing, -0.5 * facing).astype(number) * height)
    return middle, height, _Meeting(at_corner, crossed, id_start, id_end, id_side, id_next)


def _pick_edge(face: _Face, index: Array) -> tuple[Vec3, Vec3, Array, Array]:
    """Ends of the edge `index` (slot, pair, world) and their ids."""
    corners, ids = jax.tree.map(lambda c: c[:, None], (face.corners, face.corner_ids))
    start, id_start = pick((corners, ids), index)
    end, id_end = pick((corners.map(_next), _next(ids)), index)
    return start, end, id_start, id_end


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
