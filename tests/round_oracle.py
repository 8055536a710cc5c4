"""Signed distance of spheres and capsules in closed form, float64, all poses at once: points and segments with radii."""

import numpy as np
from scipy.spatial.transform import Rotation

KINDS = ("sphere", "capsule")


def round_distance(pair, scene):
    """Signed distances [m] and unit normals from A to B, one a pose."""
    (middle_a, half_a, radius_a), (middle_b, half_b, radius_b) = (
        _segment(kind, scene[side], scene["p" + side], scene["q" + side]) for side, kind in zip("ab", pair, strict=True)
    )
    between = middle_b - middle_a
    aa, ab, bb = _dot(half_a, half_a), _dot(half_a, half_b), _dot(half_b, half_b)
    across = np.cross(half_a, half_b)
    squared = _dot(across, across)
    # The lines' own closest points, if inside both segments; else an end of one and what is closest to it on the other.
    s = _quotient(_dot(np.cross(between, half_b), across), squared)
    t = _quotient(_dot(np.cross(between, half_a), across), squared)
    places = [(np.clip(s, -1, 1), np.clip(t, -1, 1))]
    for end in (-1.0, 1.0):
        ends = np.full(len(s), end)
        places.append((ends, np.clip(_quotient(end * ab - _dot(between, half_b), bb), -1, 1)))
        places.append((np.clip(_quotient(end * ab + _dot(between, half_a), aa), -1, 1), ends))
    gaps = [between + half_b * t[:, None] - half_a * s[:, None] for s, t in places]
    lengths = np.array([np.linalg.norm(gap, axis=1) for gap in gaps])
    least = np.argmin(lengths, axis=0)
    rows = np.arange(len(least))
    gap, length = np.array(gaps)[least, rows], lengths[least, rows]
    # Cores that meet are parted along any direction across both.
    aside = np.where(squared[:, None] > 0, across, _any_across(np.where(bb[:, None] > aa[:, None], half_b, half_a)))
    normal = np.where(length[:, None] > 0, gap, aside)
    return length - radius_a - radius_b, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _segment(kind, shape, position, quaternion):
    radius = shape["radius"]
    if kind == "sphere":
        return position, np.zeros_like(position), radius
    turns = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]])
    return position, turns.apply([0.0, 1.0, 0.0]) * shape["half_height"][:, None], radius


def _any_across(axis):
    smallest = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    across = np.cross(axis, smallest)
    return np.where(_dot(axis, axis)[:, None] > 0, across, smallest)


def _dot(a, b):
    return np.einsum("ij,ij->i", a, b)


def _quotient(numerator, denominator):
    return numerator / np.where(denominator > 0, denominator, 1.0)
