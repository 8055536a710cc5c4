"""Capsule against box: segment against box, inflated by the radius."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.closest import clamp, clamp_to_box, round_point
from mathota_jax.collision.manifold import Manifold, Nearest
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import settle, settle_code
from mathota_jax.spatial.vector import Vec3, dot, where

FACE_SINE_SQUARED = 1e-4
"""Closest points whose direction is this near to a face normal (squared sine) count as face contact: two points."""
SLAB_TOLERANCE = 1e-3
"""The face is widened by this share of the capsule's size while deciding where the segment leaves it."""
BESIDE = 1e-5
"""... unless the segment is closer than its part over the face by this share of the capsule's size."""
EDGE_DEPTH_SHARE = 0.05
EDGE_MARGIN = 1e-3
"""When the segment enters the box an edge must be shallower than the best face by these shares of depth and size."""

FIRST_EDGE, CLOSEST = 6, 12
"""Modes: ``2 * axis + positive`` of a face; from 6 the same for edges along an axis; 12 the closest points."""
CLOSEST_FEATURE = 8
"""Features: 0, 1 ends of the segment; 2-7 where it crosses a side plane of the face; 8 an inner closest point."""


def capsule_box(capsule: dict[str, Any], pose_a: Pose, box: dict[str, Any], pose_b: Pose) -> Manifold:
    """Two contacts along a face, otherwise one.

    The distance of the segment is exact (a convex piecewise quadratic in the segment parameter, minimised in closed
    form); a segment that enters the box leaves along the axis of least overlap (three faces, three edge directions).
    """
    assert pose_a.rotation is not None
    assert pose_b.rotation is not None
    radius, half = capsule["radius"], box["half_extents"]
    center = pose_b.point_to_local(pose_a.position)
    reach = pose_b.rotation.apply_transposed(pose_a.rotation.column_y) * capsule["half_height"]
    size = radius + capsule["half_height"]

    parameter = _closest_parameter(center, reach, half)
    core = center + reach * parameter
    nearest = clamp_to_box(core, half)
    gap = core - nearest
    squared = dot(gap, gap)
    tiny = (16.0 * jnp.finfo(squared.dtype).eps * size) ** 2
    mode = _mode(center, reach, half, gap, squared, tiny, size)

    on_edge = (mode >= FIRST_EDGE) & (mode < CLOSEST)
    axis = jnp.where(on_edge, mode - FIRST_EDGE, mode) >> 1
    sign = jnp.where((mode & 1) == 1, 1.0, -1.0).astype(squared.dtype)
    starts, enters = _crossing(center, reach, half, axis, mode < FIRST_EDGE, size, -1.0)
    ends, leaves = _crossing(center, reach, half, axis, mode < FIRST_EDGE, size, 1.0)
    # A steep segment may be closest beside the face, well below what lies over it.
    lowest = lax.stop_gradient(jnp.minimum(*(_height(center, reach, half, axis, sign, t) for t in (starts, ends))))
    reached = jnp.sqrt(lax.stop_gradient(squared)) + BESIDE * size
    beside = (lax.stop_gradient(squared) > tiny) & (lowest > reached)
    on_face = settle(((mode < FIRST_EDGE) & ~beside).astype(squared.dtype)) > 0.5
    on_closest = ~(on_face | on_edge)

    inverse = jnp.where(on_closest, 1.0 / jnp.sqrt(jnp.where(on_closest, squared, 1.0)), 0.0)
    edge_normal, edge_parameter, edge_point = _edge(center, reach, half, axis, sign, on_edge)
    face_normal = Vec3(*(jnp.where(axis == k, sign, 0.0) for k in range(3)))
    outward = where(on_face, face_normal, where(on_edge, edge_normal, gap * inverse))
    normal = -pose_b.rotation.apply(outward)

    single = jnp.where(on_edge, edge_parameter, parameter)
    at_end = lax.stop_gradient(jnp.where(single <= -1.0, 0, jnp.where(single >= 1.0, 1, CLOSEST_FEATURE)))
    two = settle((on_face & (lax.stop_gradient(ends - starts) > SLAB_TOLERANCE)).astype(squared.dtype)) > 0.5

    points = []
    for index, (t, crossing_feature) in enumerate(((starts, enters), (ends, leaves))):
        if index == 0:
            t, feature = jnp.where(on_face, t, single), jnp.where(on_face, crossing_feature, at_end)
        else:
            feature = crossing_feature
        inner = center + reach * t
        surface = Vec3(*(jnp.where(axis == k, sign * h, c) for k, (c, h) in enumerate(zip(inner, half, strict=True))))
        if index == 0:
            surface = where(on_face, surface, where(on_edge, edge_point, nearest))
        points.append(
            round_point(
                pose_b.point_to_world(inner),
                pose_b.point_to_world(surface),
                normal,
                radius,
                0.0,
                feature,
                True if index == 0 else two,
            )
        )
    return Manifold(normal, tuple(points))


def capsule_box_distance(capsule: dict[str, Any], pose_a: Pose, box: dict[str, Any], pose_b: Pose) -> Nearest:
    """Exact signed distance: no face is read off, none preferred."""
    assert pose_a.rotation is not None
    assert pose_b.rotation is not None
    radius, half = capsule["radius"], box["half_extents"]
    center = pose_b.point_to_local(pose_a.position)
    reach = pose_b.rotation.apply_transposed(pose_a.rotation.column_y) * capsule["half_height"]
    parameter = _closest_parameter(center, reach, half)
    core = center + reach * parameter
    nearest = clamp_to_box(core, half)
    gap = core - nearest
    squared = dot(gap, gap)
    number, size = squared.dtype, radius + capsule["half_height"]
    tiny = (16.0 * jnp.finfo(number).eps * size) ** 2
    overlap = _least_overlap(*lax.stop_gradient((center, reach, half)), 0.0, 0.0)
    mode = settle_code(jnp.where(squared > tiny, float(CLOSEST), overlap))

    on_face, on_closest = mode < FIRST_EDGE, mode == CLOSEST
    on_edge = ~(on_face | on_closest)
    axis = jnp.where(on_edge, mode - FIRST_EDGE, mode) >> 1
    sign = jnp.where((mode & 1) == 1, 1.0, -1.0).astype(number)
    inverse = jnp.where(on_closest, 1.0 / jnp.sqrt(jnp.where(on_closest, squared, 1.0)), 0.0)
    edge_normal, edge_parameter, edge_point = _edge(center, reach, half, axis, sign, on_edge)
    face_normal = Vec3(*(jnp.where(axis == k, sign, 0.0) for k in range(3)))
    outward = where(on_face, face_normal, where(on_edge, edge_normal, gap * inverse))
    # The end that is deepest below the face; of a level segment the point found inside of the box.
    falls = lax.stop_gradient(dot(face_normal, reach))
    level = jnp.abs(falls) <= 16.0 * jnp.finfo(number).eps * size
    end = settle(jnp.where(level, parameter, -jnp.sign(falls)))
    inner = center + reach * jnp.where(on_face, end, jnp.where(on_edge, edge_parameter, parameter))
    below = Vec3(*(jnp.where(axis == k, sign * h, c) for k, (c, h) in enumerate(zip(inner, half, strict=True))))
    surface = where(on_face, below, where(on_edge, edge_point, nearest))
    normal = -pose_b.rotation.apply(outward)
    return Nearest(
        dot(outward, inner - surface) - radius,
        normal,
        pose_b.point_to_world(inner) + normal * radius,
        pose_b.point_to_world(surface),
    )


def _height(center: Vec3, reach: Vec3, half: Vec3, axis: Array, sign: Array, parameter: Array) -> Array:
    """Height of a point of the segment over a face."""
    heights = [sign * (c + r * parameter) - h for c, r, h in zip(center, reach, half, strict=True)]
    return jnp.where(axis == 0, heights[0], jnp.where(axis == 1, heights[1], heights[2]))


def _not_zero(value: Array, scale: Any) -> Array:
    """`value`, moved off zero by a round-off share of `scale`, so that quotients stay finite."""
    tiny = jnp.finfo(value.dtype).eps ** 2 * scale
    return jnp.where(jnp.abs(value) > tiny, value, jnp.where(value < 0, -tiny, tiny))


def _closest_parameter(center: Vec3, reach: Vec3, half: Vec3) -> Array:
    """Parameter in [-1, 1] of the point of the segment ``center + t * reach`` closest to the box.

    The squared distance has a monotone, piecewise linear slope that bends where the segment meets a face plane:
    evaluate the slope at the bends, interpolate in the bracket of its root. The derivative comes from the active faces.
    """
    frozen_center, frozen_reach, frozen_half = lax.stop_gradient((center, reach, half))

    def slope(t: Any) -> Array:
        point = frozen_center + frozen_reach * t
        return dot(point - clamp_to_box(point, frozen_half), frozen_reach)

    size = frozen_half.x + frozen_half.y + frozen_half.z
    low, slope_low = jnp.full_like(frozen_center.x, -1.0), slope(-1.0)
    high, slope_high = jnp.full_like(low, 1.0), slope(1.0)
    bends = [
        settle(clamp((s * h - c) / _not_zero(r, size), -1.0, 1.0))
        for c, r, h in zip(frozen_center, frozen_reach, frozen_half, strict=True)
        for s in (-1.0, 1.0)
    ]
    start, stop = slope_low > 0, slope_high <= 0
    for bend in bends:
        here = slope(bend)
        below, above = (here <= 0) & (bend > low), (here > 0) & (bend < high)
        low, slope_low = jnp.where(below, bend, low), jnp.where(below, here, slope_low)
        high, slope_high = jnp.where(above, bend, high), jnp.where(above, here, slope_high)
    rise = slope_high - slope_low
    inside = low + (high - low) * clamp(-slope_low / jnp.where(rise > 0, rise, 1.0), 0.0, 1.0)
    found = settle(jnp.where(start, -1.0, jnp.where(stop, 1.0, inside)))

    numerator, denominator = jnp.zeros_like(found), jnp.zeros_like(found)
    for c, r, h, fc, fr, fh in zip(center, reach, half, frozen_center, frozen_reach, frozen_half, strict=True):
        at = fc + found * fr
        active = jnp.abs(at) > fh
        numerator = numerator + jnp.where(active, r * (jnp.sign(at) * h - c), 0.0)
        denominator = denominator + jnp.where(active, r * r, 0.0)
    free = (jnp.abs(found) < 1.0) & (lax.stop_gradient(denominator) > jnp.finfo(found.dtype).eps * size * size)
    exact = jnp.where(free, numerator / jnp.where(free, denominator, 1.0), 0.0)
    return found + (exact - lax.stop_gradient(exact))


def _mode(center: Vec3, reach: Vec3, half: Vec3, gap: Vec3, squared: Array, tiny: Any, size: Any) -> Array:
    """Settled mode of the contact, see `CLOSEST`."""
    center, reach, half, gap, squared, size = lax.stop_gradient((center, reach, half, gap, squared, size))
    # Outside: the closest points, read as face contact where they point along a face normal.
    outside = jnp.full_like(squared, float(CLOSEST))
    for axis, component in enumerate(gap):
        lateral = squared - component * component
        along = (lateral < FACE_SINE_SQUARED * squared) & _over_face(center, reach, half, axis, size)
        outside = jnp.where(along, 2.0 * axis + (component > 0), outside)

    overlap = _least_overlap(center, reach, half, EDGE_MARGIN * size, EDGE_DEPTH_SHARE)
    return settle_code(jnp.where(squared > tiny, outside, overlap))


def _least_overlap(center: Vec3, reach: Vec3, half: Vec3, margin: Any, share: float) -> Array:
    """Mode of a segment that enters the box; an edge must be shallower than the best face by a margin and a share."""
    number = center.x.dtype
    best, code = None, None
    for axis, (c, r, h) in enumerate(zip(center, reach, half, strict=True)):
        separation, this = jnp.abs(c) - h - jnp.abs(r), (2.0 * axis + (c > 0)).astype(number)
        if best is None or code is None:
            best, code = separation, this
        else:
            better = separation > best
            best, code = jnp.where(better, separation, best), jnp.where(better, this, code)
    assert best is not None
    assert code is not None
    threshold = best + margin - share * best
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        length = reach[i] * reach[i] + reach[j] * reach[j]
        usable = length > jnp.finfo(number).eps ** (2.0 / 3.0) * dot(reach, reach)
        projection = reach[i] * center[j] - reach[j] * center[i]
        overlap = jnp.abs(projection) - half[i] * jnp.abs(reach[j]) - half[j] * jnp.abs(reach[i])
        separation = overlap * lax.rsqrt(jnp.where(usable, length, 1.0))
        better = usable & (separation > threshold)
        threshold = jnp.where(better, separation, threshold)
        code = jnp.where(better, FIRST_EDGE + 2.0 * axis + (projection > 0), code)
    return code


def _over_face(center: Vec3, reach: Vec3, half: Vec3, axis: int, size: Any) -> Array:
    """Whether a part of the segment lies over the face across `axis`."""
    low, high = -1.0, 1.0
    for k in ((axis + 1) % 3, (axis + 2) % 3):
        inverse = 1.0 / _not_zero(reach[k], half[k])
        width = (half[k] + SLAB_TOLERANCE * size) * jnp.abs(inverse)
        low, high = jnp.maximum(low, -center[k] * inverse - width), jnp.minimum(high, -center[k] * inverse + width)
    return jnp.asarray(high > low)


def _crossing(
    center: Vec3, reach: Vec3, half: Vec3, axis: Array, usable: Array, size: Any, end: float
) -> tuple[Array, Array]:
    """Where the segment, followed to its `end` (-1 or 1), leaves the face across `axis`: parameter and feature."""
    frozen_center, frozen_reach, frozen_half, size = lax.stop_gradient((center, reach, half, size))
    best = jnp.ones_like(center.x)  # end * parameter
    code = jnp.full_like(center.x, -1.0)
    for k, (c, r, h) in enumerate(zip(frozen_center, frozen_reach, frozen_half, strict=True)):
        inverse = 1.0 / _not_zero(r, h)
        exit_parameter = -end * c * inverse + (h + SLAB_TOLERANCE * size) * jnp.abs(inverse)
        sooner = usable & (axis != k) & (exit_parameter < best)
        best = jnp.where(sooner, exit_parameter, best)
        code = jnp.where(sooner, 2.0 * k + (end * r > 0), code)
    code = settle_code(code)
    parameter = jnp.full_like(center.x, end)
    for k, (c, r, h) in enumerate(zip(center, reach, half, strict=True)):
        here = code >> 1 == k
        side = jnp.where((code & 1) == 1, 1.0, -1.0).astype(h.dtype)
        parameter = jnp.where(here, clamp((side * h - c) / jnp.where(here, _not_zero(r, h), 1.0), -1.0, 1.0), parameter)
    return parameter, jnp.where(code < 0, 0 if end < 0 else 1, 2 + code)


def _edge(center: Vec3, reach: Vec3, half: Vec3, axis: Array, sign: Array, usable: Array) -> tuple[Vec3, Array, Vec3]:
    """Outward normal, segment parameter and point of the box edge along `axis` that the segment crosses."""

    def cyclic(values: Any, shift: int) -> Array:
        return jnp.where(
            axis == 0, values[shift], jnp.where(axis == 1, values[(1 + shift) % 3], values[(2 + shift) % 3])
        )

    r_i, r_j = cyclic(reach, 1), cyclic(reach, 2)
    squared = jnp.where(usable, r_i * r_i + r_j * r_j, 1.0)
    inverse = sign / jnp.sqrt(squared)
    n_i, n_j = -r_j * inverse, r_i * inverse
    bits = settle_code((n_i > 0).astype(sign.dtype) + 2.0 * (n_j > 0))
    edge_i = jnp.where((bits & 1) == 1, 1.0, -1.0).astype(sign.dtype) * cyclic(half, 1)
    edge_j = jnp.where(bits >= 2, 1.0, -1.0).astype(sign.dtype) * cyclic(half, 2)
    parameter = ((edge_i - cyclic(center, 1)) * r_i + (edge_j - cyclic(center, 2)) * r_j) / squared
    parameter = clamp(parameter, -1.0, 1.0)
    along = cyclic(half, 0)
    edge_k = clamp(cyclic(center, 0) + parameter * cyclic(reach, 0), -along, along)
    zero = jnp.zeros_like(n_i)

    def restore(k: Array, i: Array, j: Array) -> Vec3:
        return Vec3(
            jnp.where(axis == 0, k, jnp.where(axis == 1, j, i)),
            jnp.where(axis == 0, i, jnp.where(axis == 1, k, j)),
            jnp.where(axis == 0, j, jnp.where(axis == 1, i, k)),
        )

    return restore(zero, n_i, n_j), parameter, restore(edge_k, edge_i, edge_j)
