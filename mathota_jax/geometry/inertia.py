"""Mass properties: of composed bodies by the parallel axis theorem, and principal axes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

ROUND_OFF = 1e-12
"""Share of the largest moment below which a product of inertia, or a difference of moments, counts as zero."""


class MassProperties(NamedTuple):
    """Mass properties of a solid of uniform density, in the frame of its shape; arrays of NumPy or JAX.

    Attributes:
        volume: () [m^3].
        center_of_mass: (3,) [m].
        unit_inertia: (3, 3) inertia tensor about the centre of mass for unit mass [m^2].
    """

    volume: Any
    center_of_mass: Any
    unit_inertia: Any


def centered(volume: Any, moments: Sequence[Any]) -> MassProperties:
    """Mass properties of a shape whose centre of mass is its origin and whose principal axes are its own."""
    xp = volume.__array_namespace__()
    diagonal = xp.stack(list(moments))
    return MassProperties(volume, xp.zeros_like(diagonal), diagonal[:, None] * xp.eye(3, dtype=diagonal.dtype))


def point_inertia(position: Any) -> Any:
    """Inertia tensor (3, 3) about the origin of a unit mass at a point (3,)."""
    xp = position.__array_namespace__()
    identity = xp.eye(3, dtype=position.dtype)
    return (position @ position) * identity - position[:, None] * position[None, :]


def combine(parts: Sequence[tuple[MassProperties, Any, Any]]) -> MassProperties:
    """Mass properties of several solids of one density, held together.

    Parallel axis theorem: ``I = sum m_i (R_i I_i R_i^T + |d_i|^2 1 - d_i d_i^T)``. Where parts overlap, their common
    volume counts once for each.

    Args:
        parts: of each part its mass properties and its pose in the frame of the whole: position (3,) [m] and rotation
            matrix (3, 3). Arrays of NumPy or JAX; differentiable.
    """
    total = sum(part.volume for part, _, _ in parts)
    centers = [position + rotation @ part.center_of_mass for part, position, rotation in parts]
    shares = [part.volume / total for part, _, _ in parts]
    center = sum(share * c for share, c in zip(shares, centers, strict=True))
    inertia = sum(
        share * (rotation @ part.unit_inertia @ rotation.T + point_inertia(c - center))
        for share, c, (part, _, rotation) in zip(shares, centers, parts, strict=True)
    )
    return MassProperties(total, center, inertia)


def principal_axes(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal moments (3,) and the quaternion (w, x, y, z) that turns the frame's axes into the principal axes.

    Of all ways to name the axes the one closest to the frame's own is taken, and no turn at all where the tensor is
    diagonal to round-off. Moments that agree to round-off are made equal, so that a cube is known to be spherical.

    Args:
        inertia: (3, 3) symmetric tensor, float64.
    """
    diagonal = np.diag(inertia)
    largest = diagonal.max()
    if np.abs(inertia - np.diag(diagonal)).max() <= ROUND_OFF * largest:
        return _equalized(diagonal.copy()), np.asarray([1.0, 0.0, 0.0, 0.0])
    moments, axes = np.linalg.eigh(inertia)
    order = max(itertools.permutations(range(3)), key=lambda order: np.abs(np.diag(axes[:, order])).sum())
    moments, axes = moments[list(order)], axes[:, order]
    axes = axes * np.where(np.diag(axes) < 0, -1.0, 1.0)
    if np.linalg.det(axes) < 0:
        axes[:, np.argmin(np.diag(axes))] *= -1.0
    return _equalized(moments), Rotation.from_matrix(axes).as_quat(canonical=True)[[3, 0, 1, 2]]


def _equalized(moments: np.ndarray) -> np.ndarray:
    for one, other in ((0, 1), (1, 2), (0, 2)):
        if abs(moments[one] - moments[other]) <= ROUND_OFF * moments.max():
            moments[other] = moments[one]
    return moments
