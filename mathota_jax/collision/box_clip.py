"""Clips the incident face of a box against the rectangle of the reference face and keeps at most four points.

The intersection of a parallelogram with a rectangle has at most eight vertices: vertices of the incident face, corners
of the rectangle, crossings of their edges. Each is the meeting of two of the eight lines ``alpha = +-1, beta = +-1,
u = +-half.u, v = +-half.v`` in the plane of the incident face, which is parametrised by (alpha, beta) in [-1, 1]^2.
So a *code* (which two lines) says all about a point: the search for the four codes is not differentiated, and the
points are computed from their codes.

Twelve candidates in three groups of four, the groups stacked on a leading axis:
0: walking inward along an edge ``alpha = +-1`` from either end, the first point inside the rectangle (a vertex or a
crossing); 1: the same along ``beta = +-1`` (crossings only); 2: corners of the rectangle.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.collision.box_frame import BoxFrame
from mathota_jax.collision.closest import clamp
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.vector import Vec3

RECTANGLE_TOLERANCE = 1e-3
"""The rectangle is widened by this share of the size while deciding, so that equal boxes stacked exactly keep their
vertices as features instead of flickering between vertices and crossings."""
MERGE_DISTANCE = 1e-4
"""Points closer than this share of the size are one."""

LEAN = 1e-5
"""Slope by which the search for the deepest point leans to one side, so that the tremor of a resting box (all depths
equal) does not choose another corner every step. The deepest point kept is the deepest to this share of the size."""

VERTEX, CROSSING_U, CROSSING_V = 0, 1, 2
"""What ends the walk along an edge: nothing (its own end), the line u = +-half.u, the line v = +-half.v."""


class ClipPoint(NamedTuple):
    """A point of the clipped incident face: frame coordinates (w = height above the reference face) and its code."""

    u: Array
    v: Array
    w: Array
    code: Array


class _Face(NamedTuple):
    """Incident face: centre and half-edge vectors; half extents of the rectangle."""

    center: Vec3
    alpha: Vec3
    beta: Vec3
    half_u: Array
    half_v: Array


def clip_incident_face(frame: BoxFrame, size: Array) -> ClipPoint:
    """Four points on a new leading axis; the deepest first, then those that span the largest area.

    Code -1 marks an empty slot. In edge mode all slots are empty, with finite coordinates.
    """
    sign = (2 * frame.incident_outward - 1).astype(frame.half.x.dtype)
    normal, along_1, along_2 = frame.incident
    center = frame.center + normal * (sign * frame.incident_half.x)
    face = _Face(
        center=Vec3(center.x, center.y, center.z - frame.half.z),
        alpha=along_1 * frame.incident_half.y,
        beta=along_2 * frame.incident_half.z,
        half_u=frame.half.x,
        half_v=frame.half.y,
    )
    size = lax.stop_gradient(size)
    face = compute_once(face, frame.incident_axis)
    candidates = _candidates(lax.stop_gradient(face), frame.edge, RECTANGLE_TOLERANCE * size)
    candidates = [_Candidates(*compute_once((c.u, c.v, c.w, c.code), frame.incident_axis)) for c in candidates]
    merge = MERGE_DISTANCE * size

    first = _winner([LEAN * (c.u + 0.5 * c.v) - c.w for c in candidates], candidates, float(jnp.finfo(size.dtype).min))
    u0, v0 = _coordinates(first, candidates)
    distances = [(c.u - u0) ** 2 + (c.v - v0) ** 2 for c in candidates]
    second = _winner(distances, candidates, merge * merge)
    u1, v1 = _coordinates(second, candidates)
    areas = [_area(u0, v0, u1, v1, c) for c in candidates]
    least_area = merge * jnp.maximum(jnp.abs(u1 - u0), jnp.abs(v1 - v0))
    # On an edge parallel to the first two all areas are equal: lean again.
    spans = [jnp.abs(area) + LEAN * distance for area, distance in zip(areas, distances, strict=True)]
    third = _winner(spans, candidates, jnp.where(second < 0, jnp.inf, least_area))
    u2, v2 = _coordinates(third, candidates)
    # The fourth adds the largest triangle outside one of the three sides.
    turn = jnp.where((u1 - u0) * (v2 - v0) - (v1 - v0) * (u2 - u0) < 0, 1.0, -1.0).astype(size.dtype)
    added = [
        jnp.maximum(turn * area, jnp.maximum(turn * _area(u1, v1, u2, v2, c), turn * _area(u2, v2, u0, v0, c)))
        for area, c in zip(areas, candidates, strict=True)
    ]
    fourth = _winner(added, candidates, jnp.where(third < 0, jnp.inf, least_area))
    return _point(face, jnp.stack([first, second, third, fourth]))


class _Candidates(NamedTuple):
    u: Array
    v: Array
    w: Array
    code: Array


def _signs(like: Array) -> tuple[Array, Array]:
    """The four sign pairs on a new leading axis."""
    shape = (4,) + (1,) * like.ndim
    return (
        jnp.asarray(np.array([1, -1, 1, -1]).reshape(shape), like.dtype),
        jnp.asarray(np.array([1, 1, -1, -1]).reshape(shape), like.dtype),
    )


def _candidates(face: _Face, edge: Array, tolerance: Array) -> list[_Candidates]:
    half_u, half_v = face.half_u + tolerance, face.half_v + tolerance
    usable = ~edge
    return [
        _walk(0, face.center, face.alpha, face.beta, half_u, half_v, usable),
        _walk(1, face.center, face.beta, face.alpha, half_u, half_v, usable),
        _corners(face, half_u, half_v, usable),
    ]


def _walk(
    group: int, center: Vec3, fixed: Vec3, free: Vec3, half_u: Array, half_v: Array, usable: Array
) -> _Candidates:
    """Slab clipping (Liang and Barsky 1984) of the two edges ``fixed = +-1``, entered from both ends."""
    side, inward = _signs(center.x)
    start = center + fixed * side
    inverse_u, inverse_v = _reciprocal(free.x, half_u), _reciprocal(free.y, half_v)
    middle_u, middle_v = -start.x * (inward * inverse_u), -start.y * (inward * inverse_v)
    reach_u, reach_v = half_u * jnp.abs(inverse_u), half_v * jnp.abs(inverse_v)
    enter_u, enter_v = middle_u - reach_u, middle_v - reach_v
    enter = jnp.maximum(enter_u, enter_v)
    leave = jnp.minimum(jnp.minimum(middle_u + reach_u, middle_v + reach_v), 1.0)
    position = jnp.maximum(enter, -1.0)
    valid = (position <= leave) & usable
    if group == 1:  # the ends of these edges are the ends of the others
        valid = valid & (enter > -1.0)
    point = start + free * (inward * position)
    ending = jnp.where(enter <= -1.0, VERTEX, jnp.where(enter_u > enter_v, CROSSING_U, CROSSING_V))
    return _Candidates(point.x, point.y, point.z, jnp.where(valid, _codes(group, center.x) + 12.0 * ending, -1.0))


def _corners(face: _Face, half_u: Array, half_v: Array, usable: Array) -> _Candidates:
    side_u, side_v = _signs(half_u)
    u, v = side_u * half_u, side_v * half_v
    alpha, beta = _solve(face, u - face.center.x, v - face.center.y, usable)
    valid = (jnp.abs(alpha) <= 1.0) & (jnp.abs(beta) <= 1.0) & usable
    w = face.center.z + alpha * face.alpha.z + beta * face.beta.z
    return _Candidates(u, v, w, jnp.where(valid, _codes(2, half_u), -1.0))


def _codes(group: int, like: Array) -> Array:
    """Number of each candidate of a group on the leading axis."""
    return jnp.asarray(4 * group + np.arange(4).reshape((4,) + (1,) * like.ndim), like.dtype)


def _solve(face: _Face, u: Array, v: Array, usable: Array) -> tuple[Array, Array]:
    """(alpha, beta) of the point of the incident plane at (u, v) from its centre; 0 where not `usable`."""
    determinant = face.alpha.x * face.beta.y - face.alpha.y * face.beta.x
    inverse = jnp.where(usable, 1.0 / jnp.where(usable, determinant, 1.0), 0.0)
    return (u * face.beta.y - v * face.beta.x) * inverse, (face.alpha.x * v - face.alpha.y * u) * inverse


def _reciprocal(value: Array, scale: Array) -> Array:
    """1 / value, held finite (and of the same sign) where the edge runs parallel to the line."""
    tiny = jnp.finfo(value.dtype).eps ** 2 * scale
    return 1.0 / jnp.where(jnp.abs(value) > tiny, value, jnp.where(value < 0, -tiny, tiny))


def _winner(scores: list[Array], candidates: list[_Candidates], threshold: Array | float) -> Array:
    """Settled code of the valid candidate of the highest score above the threshold, -1 where there is none."""
    lowest = jnp.finfo(scores[0].dtype).min
    best, code = jnp.where(candidates[0].code >= 0, scores[0], lowest), candidates[0].code
    for score, candidate in zip(scores[1:], candidates[1:], strict=True):
        better = (candidate.code >= 0) & (score > best)
        best, code = jnp.where(better, score, best), jnp.where(better, candidate.code, code)
    best, code = _better(best[:2], code[:2], best[2:], code[2:])
    best, code = _better(best[0], code[0], best[1], code[1])
    return settle_code(jnp.where(best > threshold, code, -1.0))


def _coordinates(code: Array, candidates: list[_Candidates]) -> tuple[Array, Array]:
    """(u, v) of the candidate with this code (finite and meaningless for an empty slot)."""
    wanted = code.astype(candidates[0].code.dtype)
    zero = jnp.zeros((), candidates[0].u.dtype)
    u = sum((jnp.where(c.code == wanted, c.u, 0.0) for c in candidates), zero)
    v = sum((jnp.where(c.code == wanted, c.v, 0.0) for c in candidates), zero)
    return u[0] + u[1] + u[2] + u[3], v[0] + v[1] + v[2] + v[3]


def _area(u0: Array, v0: Array, u1: Array, v1: Array, c: _Candidates) -> Array:
    """Twice the signed area of the triangle of two points and each candidate."""
    return (u1 - u0) * (c.v - v0) - (v1 - v0) * (c.u - u0)


def _better(best: Array, code: Array, other: Array, other_code: Array) -> tuple[Array, Array]:
    better = other > best
    return jnp.where(better, other, best), jnp.where(better, other_code, code)


class CodeParts(NamedTuple):
    """Meaning of a code: which candidate group, its two signs, and what ended the walk."""

    group: Array
    first_positive: Array
    second_positive: Array
    ending: Array


def code_parts(code: Array) -> CodeParts:
    """Takes a code apart; an empty slot reads as the vertex (+1, -1)."""
    code = jnp.maximum(code, 0)
    ending = (code >= 12).astype(jnp.int32) + (code >= 24)
    number = code - 12 * ending
    return CodeParts(number >> 2, (number & 1) == 0, (number & 2) == 0, ending)


def _point(face: _Face, code: Array) -> ClipPoint:
    """The points with the given codes (point, pair, world), differentiable."""
    parts = code_parts(code)
    number = face.center.x.dtype
    first = jnp.where(parts.first_positive, 1.0, -1.0).astype(number)
    second = jnp.where(parts.second_positive, 1.0, -1.0).astype(number)
    corner, along_alpha = parts.group == 2, parts.group == 1
    vertex, on_u = parts.ending == VERTEX, parts.ending == CROSSING_U

    # Walk along an edge: one parameter is fixed, the line of the rectangle gives the other.
    fixed_u, free_u = _swap(along_alpha, face.alpha.x, face.beta.x)
    fixed_v, free_v = _swap(along_alpha, face.alpha.y, face.beta.y)
    fixed, free = jnp.where(on_u, fixed_u, fixed_v), jnp.where(on_u, free_u, free_v)
    half, center = jnp.where(on_u, face.half_u, face.half_v), jnp.where(on_u, face.center.x, face.center.y)
    # Walking inward from an end one enters through the side one comes from.
    line = -jnp.sign(lax.stop_gradient(free)) * second * half
    walked = (line - center - first * fixed) / jnp.where(vertex | corner, 1.0, free)
    walked = jnp.where(vertex, -second, clamp(walked, -1.0, 1.0))

    alpha, beta = _solve(face, first * face.half_u - face.center.x, second * face.half_v - face.center.y, corner)
    alpha = jnp.where(corner, alpha, jnp.where(along_alpha, walked, first))
    beta = jnp.where(corner, beta, jnp.where(along_alpha, first, walked))
    alpha, beta = compute_once((alpha, beta), alpha)
    point = face.center + face.alpha * alpha + face.beta * beta
    return ClipPoint(point.x, point.y, point.z, code)


def _swap(condition: Array, a: Array, b: Array) -> tuple[Array, Array]:
    return jnp.where(condition, b, a), jnp.where(condition, a, b)
