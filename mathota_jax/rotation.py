"""Quaternions (w, x, y, z) of one body in NumPy float64, for build time."""

from __future__ import annotations

import numpy as np


def _multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    scalar = p[0] * q[0] - p[1:] @ q[1:]
    return np.concatenate([[scalar], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])])


def _conjugate(q: np.ndarray) -> np.ndarray:
    return q * np.asarray([1.0, -1.0, -1.0, -1.0])


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vector `v` turned by the unit quaternion `q`."""
    return v + 2.0 * np.cross(q[1:], np.cross(q[1:], v) + q[0] * v)


def rotate_back(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vector `v` turned by the inverse of the unit quaternion `q`."""
    return rotate(_conjugate(q), v)


def relative_rotation(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Orientation `p` seen from the frame `q`."""
    return _multiply(_conjugate(q), p)


def frame_with_axis(axis: np.ndarray) -> np.ndarray:
    """Quaternion of the shortest rotation that turns the x axis to a nonzero direction."""
    direction = axis / np.linalg.norm(axis)
    if direction[0] < -1.0 + 1e-12:
        return np.asarray([0.0, 0.0, 1.0, 0.0])  # half a turn about y
    q = np.concatenate([[1.0 + direction[0]], np.cross([1.0, 0.0, 0.0], direction)])
    return q / np.linalg.norm(q)
