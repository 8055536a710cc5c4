"""The frame of the reference face in which two boxes meet."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.box_axes import FIRST_EDGE
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.vector import Mat3, Vec3


class BoxFrame(NamedTuple):
    """Two boxes seen from the reference one; vectors have components along the axes (u, v, w) of the frame.

    w is the outward normal of the reference face, (u, v) span it; the frame may be left-handed, which nothing uses.
    In edge mode A is the reference, w lies along A's edge and `incident` starts with the direction of B's edge.

    Attributes:
        edge: bool, edge against edge; else face against whatever of the other box looks most against it.
        reference_b: bool, the reference is box B (only in face mode).
        reverse: bool, the separating axis must be reversed to point from A to B.
        axis: int32, local axis of the reference that is w; u and v are the next two in cyclic order.
        outward: int32 1 where w is the positive local axis, else 0.
        incident_axis: int32, local axis of the incident box that comes first in `incident`.
        incident_outward: int32 1 where the incident face is the positive one, else 0.
        origin: World centre of the reference box.
        basis: The frame's axes in the world.
        center: Centre of the incident box in the frame.
        incident: Axes of the incident box in the frame, starting with `incident_axis`, in cyclic order.
        half: Half extents of the reference along (u, v, w).
        incident_half: Half extents of the incident box in the order of `incident`.
    """

    edge: Array
    reference_b: Array
    reverse: Array
    axis: Array
    outward: Array
    incident_axis: Array
    incident_outward: Array
    origin: Vec3
    basis: Mat3
    center: Vec3
    incident: Mat3
    half: Vec3
    incident_half: Vec3


def box_frame(code: Array, pose_a: Pose, half_a: Vec3, pose_b: Pose, half_b: Vec3) -> BoxFrame:
    """Builds the frame for the axis `code` of `best_axis`. Differentiable in all but the code."""
    assert pose_a.rotation is not None
    assert pose_b.rotation is not None
    index, reverse = code >> 1, (code & 1) == 1
    edge = index >= FIRST_EDGE
    reference_b = (index >= 3) & ~edge
    edge_index = index - FIRST_EDGE
    edge_row = (edge_index >= 3).astype(jnp.int32) + (edge_index >= 6)
    axis = jnp.where(edge, edge_row, jnp.where(reference_b, index - 3, index))
    outward = jnp.where(edge, 1, (reverse == reference_b).astype(jnp.int32))
    sign = (2 * outward - 1).astype(half_a.x.dtype)

    half = [jnp.where(reference_b, q, p) for p, q in zip(half_a, half_b, strict=True)]
    other_half = [jnp.where(reference_b, p, q) for p, q in zip(half_a, half_b, strict=True)]
    columns = Mat3(*(_pick(reference_b, p, q) for p, q in zip(pose_a.rotation, pose_b.rotation, strict=True)))
    others = Mat3(*(_pick(reference_b, q, p) for p, q in zip(pose_a.rotation, pose_b.rotation, strict=True)))
    origin = _pick(reference_b, pose_a.position, pose_b.position)
    other_origin = _pick(reference_b, pose_b.position, pose_a.position)

    axis_u, axis_v, axis_w = (_column(axis, shift, columns) for shift in (1, 2, 0))
    basis = compute_once(Mat3(axis_u, axis_v, axis_w * sign), code)
    incident_code = _incident(others.apply_transposed(basis.column_z), edge, edge_index - 3 * edge_row)
    first = incident_code >> 1
    incident = Mat3(*(basis.apply_transposed(_column(first, shift, others)) for shift in range(3)))
    return BoxFrame(
        edge=edge,
        reference_b=reference_b,
        reverse=reverse,
        axis=axis,
        outward=outward,
        incident_axis=first,
        incident_outward=incident_code & 1,
        origin=origin,
        basis=basis,
        center=compute_once(basis.apply_transposed(other_origin - origin), code),
        incident=compute_once(incident, code),
        half=Vec3(_cyclic(axis, 1, half), _cyclic(axis, 2, half), _cyclic(axis, 0, half)),
        incident_half=Vec3(*(_cyclic(first, shift, other_half) for shift in range(3))),
    )


def _pick(condition: Array, otherwise: Vec3, value: Vec3) -> Vec3:
    return Vec3(*(jnp.where(condition, q, p) for p, q in zip(otherwise, value, strict=True)))


def _column(axis: Array, shift: int, columns: Mat3) -> Vec3:
    """Column ``(axis + shift) % 3``."""
    return Vec3(*(_cyclic(axis, shift, [column[j] for column in columns]) for j in range(3)))


def _cyclic(axis: Array, shift: int, values: list[Any]) -> Array:
    """``values[(axis + shift) % 3]`` by selection: a gather is an order of magnitude slower."""
    return jnp.where(axis == 0, values[shift], jnp.where(axis == 1, values[(1 + shift) % 3], values[(2 + shift) % 3]))


def _incident(row_w: Vec3, edge: Array, edge_axis: Array) -> Array:
    """Code ``2 * axis + (1 if the positive face)`` of the incident face that looks most against w."""
    row_w = lax.stop_gradient(row_w)
    number = row_w.x.dtype
    best, code = jnp.abs(row_w.x), (row_w.x < 0).astype(number)
    for axis, value in ((1, row_w.y), (2, row_w.z)):
        better = jnp.abs(value) > best
        code = jnp.where(better, 2.0 * axis + (value < 0), code)
        best = jnp.where(better, jnp.abs(value), best)
    return settle_code(jnp.where(edge, (2 * edge_axis + 1).astype(number), code))
