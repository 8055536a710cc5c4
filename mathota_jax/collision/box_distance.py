"""Signed distance of two boxes: exact, without the preference for faces that keeps a manifold steady.

The separating axis theorem gives the depth of boxes that overlap. If they are apart, either the interiors of two edges
are closest: then their common perpendicular is the direction of largest separation, and the pair of edges whose axis
separates best is the only one to try. Or else a corner of one of the boxes is closest: the distance is the least of the
sixteen distances of a corner from a box.

The search ends in one number, which names the features; all that is differentiable is computed from it.

Sources: S. Gottschalk, M. Lin, D. Manocha, "OBBTree" (SIGGRAPH 1996); guide 6.5.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.box_axes import relative_rotation
from mathota_jax.collision.closest import clamp
from mathota_jax.collision.manifold import Nearest
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import compute_once, settle, settle_code
from mathota_jax.spatial.vector import Vec3, dot, where

ROUNDING = 8.0
"""Separations that differ by fewer round-offs of the size are equal: then faces come before edges."""
PARALLEL_ROUNDING = 100.0
"""Edges whose sine is below this many round-offs are parallel: the faces beside them know all that they do."""
TIED_ROUNDING = 64.0
"""An edge that rises by fewer round-offs of its length over a face lies on it."""

CORNER, EDGES = 3, 128
"""Code: below `EDGES` the bits of the corner (3), what it meets (2: the axis of a face, or `CORNER`: the closest point of
the box), the side of the face (1) and whose corner it is (1, of A). From there ``32 * (3 i + j)`` of the axes of A's and
B's edge, the sides on which they lie (4 bits) and whether the axis is reversed (1)."""

Matrix = list[list[Array]]


class _Boxes(NamedTuple):
    """B's axes in the frame of A (``c[i][j]``: component i of axis j), B's centre in the frames of A and of B, sizes."""

    c: Matrix
    t: Vec3
    t_b: Vec3
    half_a: Vec3
    half_b: Vec3


def box_distance(a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Nearest:
    """Signed distance, normal and witness points of two boxes; arguments as of `box_box`.

    Differentiable in poses and sizes away from changes of feature.
    """
    assert pose_a.rotation is not None
    assert pose_b.rotation is not None
    between = pose_b.position - pose_a.position
    c = relative_rotation(pose_a.rotation, pose_b.rotation)
    t, t_b = pose_a.rotation.apply_transposed(between), pose_b.rotation.apply_transposed(between)
    boxes = _Boxes(c, t, t_b, a["half_extents"], b["half_extents"])
    code, on_face = _search(lax.stop_gradient(boxes))
    on_edges = code >= EDGES
    of_a = ~on_edges & ((code >> 6) & 1 == 1)
    corner, edge = _corner_contact(boxes, code, of_a, on_face), _edge_contact(boxes, code)
    normal = where(on_edges, edge.normal, corner.normal)
    separation = jnp.where(on_edges, edge.separation, corner.separation)
    own, other = where(on_edges, edge.own, corner.own), where(on_edges, edge.other, corner.other)
    own, other, normal, separation = compute_once((own, other, normal, separation), separation)

    # The frame is that of the box whose face, edge or inside meets the corner of the other.
    def to_world(vector: Vec3) -> Vec3:
        assert pose_a.rotation is not None
        assert pose_b.rotation is not None
        return where(of_a, pose_b.rotation.apply(vector), pose_a.rotation.apply(vector))

    origin = where(of_a, pose_b.position, pose_a.position)
    own, other = origin + to_world(own), origin + to_world(other)
    facing = jnp.where(of_a, -1.0, 1.0).astype(separation.dtype)
    return Nearest(separation, to_world(normal) * facing, where(of_a, other, own), where(of_a, own, other))


# ---- the search, not differentiated -------------------------------------------------------------------------------


def _search(boxes: _Boxes) -> tuple[Array, Vec3]:
    """The code of the closest features, settled; and where the box that meets a face does so, if one is closest.

    A point over the face that separates best is closest: its distance is that lower bound. Where edges lie on the face no
    other feature is sure to tell: which of the edges that tie cross, round-off decides.
    """
    c, t, t_b, half_a, half_b = boxes
    number = c[0][0].dtype
    eps = float(jnp.finfo(number).eps)
    size = jnp.maximum(half_a.x, jnp.maximum(half_a.y, half_a.z))
    size = jnp.maximum(size, jnp.maximum(half_b.x, jnp.maximum(half_b.y, half_b.z)))
    face, face_code = _best_face(boxes)
    face_code = settle(face_code)
    place, over_face = _place_on_face(boxes, face_code.astype(jnp.int32))
    edge, edge_code, crossed_code = _best_edges(boxes)
    crossed = crossed_code > 0
    corner_b = _nearest_corner(Vec3(*t), c, half_b, half_a)
    corner_a = _nearest_corner(-t_b, [list(row) for row in zip(*c, strict=True)], half_a, half_b)
    of_a = corner_a[0] < corner_b[0]
    gap, corner_code = jnp.where(of_a, corner_a[0], corner_b[0]), jnp.where(of_a, 64.0 + corner_a[1], corner_b[1])
    apart_code = jnp.where(over_face & (face > 0), face_code, jnp.where(crossed, crossed_code, corner_code))
    overlap_code = jnp.where(edge > face + ROUNDING * eps * size, edge_code, face_code)
    # A corner that touches gives no direction: then the axis does.
    apart = (jnp.maximum(face, edge) > 0) & (crossed | (gap > (16.0 * eps * size) ** 2))
    return settle_code(jnp.where(apart, apart_code, overlap_code)), place


def _best_face(boxes: _Boxes) -> tuple[Array, Array]:
    """Largest separation along the normals of the faces, and its code with the corner that is deepest."""
    c, t, t_b, half_a, half_b = boxes
    number = c[0][0].dtype
    best = code = jnp.zeros(())
    for side, (place, own, other) in enumerate(((t, half_a, half_b), (t_b, half_b, half_a))):
        for k in range(3):
            row = c[k] if side == 0 else [c[i][k] for i in range(3)]
            separation = jnp.abs(place[k]) - own[k] - sum(jnp.abs(row[j]) * other[j] for j in range(3))
            positive = (place[k] >= 0) if side == 0 else (place[k] < 0)
            bits = sum(2.0**j * ((row[j] < 0) == positive).astype(number) for j in range(3))
            this = bits + 8.0 * k + 32.0 * positive.astype(number) + 64.0 * side
            if side == k == 0:
                best, code = separation, this
            else:
                better = separation > best
                best, code = jnp.where(better, separation, best), jnp.where(better, this, code)
    return best, code


def _place_on_face(boxes: _Boxes, code: Array) -> tuple[Vec3, Array]:
    """Coordinates in [-1, 1] along the axes of the other box of a point that is deepest, and whether the face is below it.

    Edges and faces that lie on the face: any of their points is deepest, one over the face is the witness.
    """
    shapes, signs, axis, _ = _corner_features(boxes, code, (code >> 6) & 1 == 1)
    tied = TIED_ROUNDING * float(jnp.finfo(signs.x.dtype).eps)
    free = [jnp.abs(_entry(axis, column)) <= tied for column in shapes.axes]
    shapes = _in_every_pair(shapes, signs.x)
    place = lax.cond(
        jnp.any(free[0] | free[1] | free[2]),
        _over_face,
        lambda _shapes, _axis, signs, _free: signs,
        shapes,
        axis,
        signs,
        free,
    )
    point = shapes.point(place)
    over = [(axis == k) | (jnp.abs(at) <= half) for k, (at, half) in enumerate(zip(point, shapes.half, strict=True))]
    return place, over[0] & over[1] & over[2]


def _best_edges(boxes: _Boxes) -> tuple[Array, Array, Array]:
    """Largest separation along cross products of edges, and its code; and that of a pair that is closest (0 for none).

    The separation is that along the cross product as rounded, so that it is a lower bound of the distance however near
    the edges are to parallel: products with B's axes are formed, not looked up among the entries of the rotation.

    A pair is closest if it separates and the closest points of both lines lie on the edges. It need not be the one that
    separates best: where a face lies across a face, several pairs do so equally, and not all of them cross.
    """
    c, t, _, half_a, half_b = boxes
    number = c[0][0].dtype
    negligible = (PARALLEL_ROUNDING * float(jnp.finfo(number).eps)) ** 2
    best = code = jnp.zeros(())
    crossed_code = jnp.zeros((), number)
    arms = [[c[i][j] * half_b[j] for j in range(3)] for i in range(3)]
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            across_1, across_2 = -c[i2][j], c[i1][j]
            height = t[i1] * across_1 + t[i2] * across_2
            along_1 = c[i1][j1] * across_1 + c[i2][j1] * across_2
            along_2 = c[i1][j2] * across_1 + c[i2][j2] * across_2
            reach = half_a[i1] * jnp.abs(across_1) + half_a[i2] * jnp.abs(across_2)
            reach += half_b[j1] * jnp.abs(along_1) + half_b[j2] * jnp.abs(along_2)
            squared = across_1 * across_1 + across_2 * across_2
            usable = squared > negligible
            separation = (jnp.abs(height) - reach) * lax.rsqrt(jnp.where(usable, squared, 1.0))
            separation = jnp.where(usable, separation, jnp.finfo(number).min)
            positive = height >= 0
            sides = [
                (value > 0) == toward
                for value, toward in (
                    (across_1, positive),
                    (across_2, positive),
                    (along_1, ~positive),
                    (along_2, ~positive),
                )
            ]
            bits = sum(2.0**k * side.astype(number) for k, side in enumerate(sides))
            this = EDGES + 32.0 * (3 * i + j) + bits + 16.0 * (~positive).astype(number)
            # Where along B's edge, and along A's, the lines are closest, both times the squared sine.
            ends = [
                t[k] + jnp.where(sides[2], arms[k][j1], -arms[k][j1]) + jnp.where(sides[3], arms[k][j2], -arms[k][j2])
                for k in (i1, i2, i)
            ]
            gap_1 = ends[0] - jnp.where(sides[0], half_a[i1], -half_a[i1])
            gap_2 = ends[1] - jnp.where(sides[1], half_a[i2], -half_a[i2])
            on_b = gap_2 * across_1 - gap_1 * across_2
            on_a = ends[2] * squared + c[i][j] * on_b
            crossed = (jnp.abs(on_b) <= half_b[j] * squared) & (jnp.abs(on_a) <= half_a[i] * squared) & (separation > 0)
            crossed_code = jnp.where(crossed, this, crossed_code)
            if i == j == 0:
                best, code = separation, this
            else:
                better = separation > best
                best, code = jnp.where(better, separation, best), jnp.where(better, this, code)
    return best, code, crossed_code


def _nearest_corner(center: Vec3, axes: Matrix, half: Vec3, other_half: Vec3) -> tuple[Array, Array]:
    """Least squared distance of the corners of one box from another, and its code, in the frame of the other."""
    best = code = jnp.zeros(())
    arms = [[axes[i][j] * half[j] for j in range(3)] for i in range(3)]
    for bits in range(8):
        squared = jnp.zeros(())
        for i in range(3):
            place = center[i]
            for j in range(3):
                place = place + arms[i][j] if bits >> j & 1 else place - arms[i][j]
            beyond = jnp.maximum(jnp.abs(place) - other_half[i], 0.0)
            squared = squared + beyond * beyond
        if bits == 0:
            best, code = squared, jnp.full_like(squared, 8.0 * CORNER)
        else:
            better = squared < best
            best, code = jnp.where(better, squared, best), jnp.where(better, 8.0 * CORNER + bits, code)
    return best, code


# ---- the features of a code, differentiable -----------------------------------------------------------------------


class _Contact(NamedTuple):
    """Normal and points in the frame of a box: `own` on that box, `other` on the other one."""

    normal: Vec3
    separation: Array
    own: Vec3
    other: Vec3


class _Shapes(NamedTuple):
    """A box at the origin and another one: its centre and axes, half extents of the first and of the other."""

    center: Vec3
    axes: list[Vec3]
    half: Vec3
    arm: Vec3

    def point(self, place: Vec3) -> Vec3:
        """The point of the other box at the coordinates `place`, in [-1, 1], along its axes."""
        point = self.center
        for column, length, at in zip(self.axes, self.arm, place, strict=True):
            point = point + column * (length * at)
        return point


def _in_every_pair(tree: Any, like: Array) -> Any:
    return jax.tree.map(lambda x: jnp.broadcast_to(x, like.shape), tree)


def _corner_features(boxes: _Boxes, code: Array, of_a: Array) -> tuple[_Shapes, Vec3, Array, Array]:
    """What `code` names of a corner and what it meets: the boxes, signs of the corner, axis and side of the face."""
    number = boxes.t.x.dtype
    signs = Vec3(*(_sign((code >> k) & 1, number) for k in range(3)))
    half = where(of_a, boxes.half_b, boxes.half_a)
    arm = where(of_a, boxes.half_a, boxes.half_b)
    center = where(of_a, -boxes.t_b, boxes.t)
    axes = [Vec3(*(jnp.where(of_a, boxes.c[j][i], boxes.c[i][j]) for i in range(3))) for j in range(3)]
    return _Shapes(center, axes, half, arm), signs, (code >> 3) & 3, _sign((code >> 5) & 1, number)


def _corner_contact(boxes: _Boxes, code: Array, of_a: Array, place: Vec3) -> _Contact:
    """A corner of one box at the closest point of the other, or what is at `place` at a face."""
    shapes, signs, axis, side = _corner_features(boxes, code, of_a)
    half = shapes.half
    on_face = axis != CORNER
    other = shapes.point(where(on_face, place, signs))

    on = [axis == k for k in range(3)]
    own = Vec3(
        *(
            jnp.where(hit, side * h, jnp.where(on_face, p, clamp(p, -h, h)))
            for hit, p, h in zip(on, other, half, strict=True)
        )
    )
    difference = other - own
    squared = dot(difference, difference)
    usable = ~on_face & (squared > 0)
    inverse = lax.rsqrt(jnp.where(usable, squared, 1.0))
    normal = Vec3(
        *(jnp.where(on_face, jnp.where(hit, side, 0.0), gap * inverse) for hit, gap in zip(on, difference, strict=True))
    )
    separation = jnp.where(on_face, side * (_entry(axis, other)) - _entry(axis, half), squared * inverse)
    return _Contact(normal, separation, own, other)


def _over_face(shapes: _Shapes, axis: Array, signs: Vec3, free: list[Array]) -> Vec3:
    """Coordinates in [-1, 1] along the axes of the other box of a point that is over the face, where edges lie on it.

    The middle of the face if that is over the other box. Else the border of what lies on the face crosses the face: the
    middle of the longest part of an edge that is over it (clipped by slabs: Liang and Barsky, 1984).
    """
    center, axes, half, arm = shapes
    number = center.x.dtype
    places: list[Array] = list(signs)
    longest = jnp.full_like(center.x, jnp.finfo(number).min)
    for j, k, m in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for sign_k, sign_m in itertools.product((-1.0, 1.0), repeat=2):
            at_k, at_m = jnp.where(free[k], sign_k, signs[k]), jnp.where(free[m], sign_m, signs[m])
            start = center + axes[k] * (arm[k] * at_k) + axes[m] * (arm[m] * at_m)
            enter, leave = -jnp.ones_like(longest), jnp.ones_like(longest)
            for i in range(3):
                slope = axes[j][i] * arm[j]
                inverse = 1.0 / jnp.where(
                    jnp.abs(slope) > jnp.finfo(number).tiny ** 0.5, slope, jnp.finfo(number).tiny ** 0.5
                )
                middle, reach = -start[i] * inverse, half[i] * jnp.abs(inverse)
                # Along the normal the face is no bound.
                enter = jnp.where(axis == i, enter, jnp.maximum(enter, middle - reach))
                leave = jnp.where(axis == i, leave, jnp.minimum(leave, middle + reach))
            better = free[j] & (leave - enter > longest)
            longest = jnp.where(better, leave - enter, longest)
            found = {j: clamp(0.5 * (enter + leave), -1.0, 1.0), k: at_k, m: at_m}
            places = [jnp.where(better, found[n], places[n]) for n in range(3)]
    inside = sum(f.astype(jnp.int32) for f in free) == 2
    middles = []
    for j in range(3):
        level = sum(jnp.where(axis == i, 0.0, axes[j][i] * center[i]) for i in range(3))
        middles.append(-level / jnp.where(arm[j] > 0, arm[j], 1.0))
        inside &= ~free[j] | (jnp.abs(middles[j]) <= 1.0)
    return Vec3(*(jnp.where(inside & free[n], middles[n], places[n]) for n in range(3)))


def _edge_contact(boxes: _Boxes, code: Array) -> _Contact:
    """The closest points of an edge of A and one of B, in the frame of A."""
    number = boxes.t.x.dtype
    code = jnp.maximum(code - EDGES, 0)
    index = code >> 5
    i = (index >= 3).astype(jnp.int32) + (index >= 6)
    j = index - 3 * i
    sides = [_sign((code >> k) & 1, number) for k in range(4)]
    facing = _sign(~(code >> 4) & 1, number)
    # Components along the directions (i1, i2, i) of A, of B's axes in the order (j, j1, j2).
    rows = [[_cyclic(i, shift, [boxes.c[k][m] for k in range(3)]) for m in range(3)] for shift in (1, 2, 0)]
    along, first, second = (Vec3(*(_cyclic(j, shift, row) for row in rows)) for shift in range(3))
    half = Vec3(*(_cyclic(i, shift, list(boxes.half_a)) for shift in (1, 2, 0)))
    arm = Vec3(*(_cyclic(j, shift, list(boxes.half_b)) for shift in range(3)))
    center = Vec3(*(_cyclic(i, shift, list(boxes.t)) for shift in (1, 2, 0)))

    squared = along.x * along.x + along.y * along.y
    usable = lax.stop_gradient(squared) > 0
    inverse = lax.rsqrt(jnp.where(usable, squared, 1.0))
    edge_u, edge_v = sides[0] * half.x, sides[1] * half.y
    start = center + first * (sides[2] * arm.y) + second * (sides[3] * arm.z)
    gap_u, gap_v = start.x - edge_u, start.y - edge_v
    normal_u, normal_v = -along.y * inverse * facing, along.x * inverse * facing
    parameter = clamp(-(gap_u * along.x + gap_v * along.y) * inverse * inverse, -arm.x, arm.x)
    other = start + along * parameter
    own = Vec3(edge_u, edge_v, clamp(other.z, -half.z, half.z))

    def back(u: Array, v: Array, w: Array) -> Vec3:
        """Components along the axes of A of those along (i1, i2, i)."""
        return Vec3(*(jnp.where(i == k, w, jnp.where(i == (k + 2) % 3, u, v)) for k in range(3)))

    return _Contact(
        back(normal_u, normal_v, jnp.zeros_like(normal_u)),
        normal_u * gap_u + normal_v * gap_v,
        back(*own),
        back(*other),
    )


def _sign(bit: Any, number: Any) -> Array:
    return jnp.where(bit == 1, 1.0, -1.0).astype(number)


def _entry(axis: Array, vector: Vec3) -> Array:
    """Component `axis` (0 for `CORNER`)."""
    return jnp.where(axis == 2, vector.z, jnp.where(axis == 1, vector.y, vector.x))


def _cyclic(axis: Array, shift: int, values: list[Any]) -> Array:
    """``values[(axis + shift) % 3]`` by selection."""
    return jnp.where(axis == 0, values[shift], jnp.where(axis == 1, values[(1 + shift) % 3], values[(2 + shift) % 3]))
