"""Clips the incident face of a box against the rectangle of the reference face and keeps at most four points.

The intersection of a parallelogram with a rectangle has at most eight vertices: vertices of the incident face, corners
of the rectangle, crossings of their edges. Each is the meeting of two of the eight lines ``alpha = +-1, beta = +-1,
u = +-half.u, v = +-half.v`` in the plane of the incident face, which is parametrised by (alpha, beta) in [-1, 1]^2.
So a *code* (which two lines) says all about a point: the search for the four codes is not differentiated, and the
points are computed from their codes.

Twelve candidates in three groups of four:
0: walking inward along an edge ``alpha = +-1`` from either end, the first point inside the rectangle (a vertex or a
crossing); 1: the same along ``beta = +-1`` (crossings only); 2: corners of the rectangle.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.collision.box_frame import BoxFrame
from mathota_jax.collision.closest import clamp
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.spread import for_each
from mathota_jax.spatial.vector import Vec3

RECTANGLE_TOLERANCE = 1e-3
"""The rectangle is widened by this share of the size while deciding, so that equal boxes stacked exactly keep their
vertices as features instead of flickering between vertices and crossings."""
MERGE_DISTANCE = 1e-4
"""Points closer than this share of the size are one."""

LEAN = 1e-5
"""Slope by which the search for the deepest point leans to one side, so that the tremor of a resting box (all depths
equal) does not choose another corner every step. The deepest point kept is the deepest to this share of the size."""

SIGNS = ((1, 1), (-1, 1), (1, -1), (-1, -1))
"""The four of each group."""
CODE_BITS = 6
"""Codes are below 36."""

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
    packed = _search(lax.stop_gradient(face), frame.edge, size)
    shifts = (CODE_BITS * np.arange(4, dtype=np.int32)).reshape((4,) + (1,) * packed.ndim)
    return _point(for_each(4, face), ((packed >> shifts) & (2**CODE_BITS - 1)) - 1)


def _search(face: _Face, edge: Array, size: Array) -> Array:
    """The codes of the four points in one number, int32: ``code + 1`` in `CODE_BITS` bits each, the first lowest.

    One number is one kernel, in which no candidate is stored or computed twice; float32 holds 24 bits exactly.
    """
    number = size.dtype
    candidates = _candidates(face, edge, RECTANGLE_TOLERANCE * size)
    merge = MERGE_DISTANCE * size
    first = _winner([LEAN * (c.u + 0.5 * c.v) - c.w for c in candidates], candidates, float(jnp.finfo(number).min))
    distances = [(c.u - first.u) ** 2 + (c.v - first.v) ** 2 for c in candidates]
    second = _winner(distances, candidates, merge * merge)
    areas = [_area(first, second, c) for c in candidates]
    least_area = merge * jnp.maximum(jnp.abs(second.u - first.u), jnp.abs(second.v - first.v))
    # On an edge parallel to the first two all areas are equal: lean again.
    spans = [jnp.abs(area) + LEAN * distance for area, distance in zip(areas, distances, strict=True)]
    third = _winner(spans, candidates, jnp.where(second.code < 0, jnp.inf, least_area))
    # The fourth adds the largest triangle outside one of the three sides.
    turn = jnp.where(_area(first, second, third) < 0, 1.0, -1.0).astype(number)
    added = [
        jnp.maximum(turn * area, jnp.maximum(turn * _area(second, third, c), turn * _area(third, first, c)))
        for area, c in zip(areas, candidates, strict=True)
    ]
    fourth = _winner(added, candidates, jnp.where(third.code < 0, jnp.inf, least_area))
    winners = enumerate((first, second, third, fourth))
    return settle_code(sum((2.0 ** (CODE_BITS * k) * (w.code + 1.0) for k, w in winners), jnp.zeros((), number)))


class _Candidate(NamedTuple):
    """A point of the clipped face and its code as a float, -1 where it is none."""

    u: Array
    v: Array
    w: Array
    code: Array


def _candidates(face: _Face, edge: Array, tolerance: Array) -> list[_Candidate]:
    half_u, half_v = face.half_u + tolerance, face.half_v + tolerance
    return [
        *_walks(0, face.center, face.alpha, face.beta, half_u, half_v, ~edge),
        *_walks(1, face.center, face.beta, face.alpha, half_u, half_v, ~edge),
        *_corners(face, half_u, half_v, ~edge),
    ]


def _walks(
    group: int, center: Vec3, fixed: Vec3, free: Vec3, half_u: Array, half_v: Array, usable: Array
) -> list[_Candidate]:
    """Slab clipping (Liang and Barsky 1984) of the two edges ``fixed = +-1``, entered from both ends."""
    inverse_u, inverse_v = _reciprocal(free.x, half_u), _reciprocal(free.y, half_v)
    reach_u, reach_v = half_u * jnp.abs(inverse_u), half_v * jnp.abs(inverse_v)
    found = []
    for index, (side, inward) in enumerate(SIGNS):
        start = center + fixed * side
        middle_u, middle_v = -start.x * (inward * inverse_u), -start.y * (inward * inverse_v)
        enter_u, enter_v = middle_u - reach_u, middle_v - reach_v
        enter = jnp.maximum(enter_u, enter_v)
        leave = jnp.minimum(jnp.minimum(middle_u + reach_u, middle_v + reach_v), 1.0)
        position = jnp.maximum(enter, -1.0)
        valid = (position <= leave) & usable
        if group == 1:  # the ends of these edges are the ends of the others
            valid = valid & (enter > -1.0)
        point = start + free * (inward * position)
        ending = jnp.where(enter <= -1.0, VERTEX, jnp.where(enter_u > enter_v, CROSSING_U, CROSSING_V))
        code = jnp.where(valid, 4 * group + index + 12.0 * ending, -1.0).astype(center.x.dtype)
        found.append(_Candidate(point.x, point.y, point.z, code))
    return found


def _corners(face: _Face, half_u: Array, half_v: Array, usable: Array) -> list[_Candidate]:
    found = []
    for index, (side_u, side_v) in enumerate(SIGNS):
        u, v = side_u * half_u, side_v * half_v
        alpha, beta = _solve(face, u - face.center.x, v - face.center.y, usable)
        valid = (jnp.abs(alpha) <= 1.0) & (jnp.abs(beta) <= 1.0) & usable
        w = face.center.z + alpha * face.alpha.z + beta * face.beta.z
        found.append(_Candidate(u, v, w, jnp.where(valid, 8.0 + index, -1.0).astype(w.dtype)))
    return found


def _solve(face: _Face, u: Array, v: Array, usable: Array) -> tuple[Array, Array]:
    """(alpha, beta) of the point of the incident plane at (u, v) from its centre; 0 where not `usable`."""
    determinant = face.alpha.x * face.beta.y - face.alpha.y * face.beta.x
    inverse = jnp.where(usable, 1.0 / jnp.where(usable, determinant, 1.0), 0.0)
    return (u * face.beta.y - v * face.beta.x) * inverse, (face.alpha.x * v - face.alpha.y * u) * inverse


def _reciprocal(value: Array, scale: Array) -> Array:
    """1 / value, held finite (and of the same sign) where the edge runs parallel to the line."""
    tiny = jnp.finfo(value.dtype).eps ** 2 * scale
    return 1.0 / jnp.where(jnp.abs(value) > tiny, value, jnp.where(value < 0, -tiny, tiny))


def _winner(scores: list[Array], candidates: list[_Candidate], threshold: Array | float) -> _Candidate:
    """The valid candidate of the highest score above the threshold; where there is none, code -1."""
    lowest = jnp.finfo(scores[0].dtype).min
    entries = [(jnp.where(c.code >= 0, score, lowest), c) for score, c in zip(scores, candidates, strict=True)]
    lanes = [_better(_better(*entries[k:8:4]), entries[8 + k]) for k in range(4)]
    best, winner = _better(_better(lanes[0], lanes[2]), _better(lanes[1], lanes[3]))
    return winner._replace(code=jnp.where(best > threshold, winner.code, -1.0))


def _better(entry: tuple[Array, _Candidate], other: tuple[Array, _Candidate]) -> tuple[Array, _Candidate]:
    better = other[0] > entry[0]
    return jax.tree.map(lambda old, new: jnp.where(better, new, old), entry, other)


def _area(a: _Candidate, b: _Candidate, c: _Candidate) -> Array:
    """Twice the signed area of a triangle."""
    return (b.u - a.u) * (c.v - a.v) - (b.v - a.v) * (c.u - a.u)


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
    """The points with the given codes (point, pair, world) on faces with those axes, differentiable."""
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
