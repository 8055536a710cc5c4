"""The result of a narrow-phase test (guide 7.1, with the normal from A to B)."""

from __future__ import annotations

from typing import NamedTuple

from jax import Array

from mathota_jax.spatial.vector import Vec3


class ContactPoint(NamedTuple):
    """One point of a manifold; every component has shape ``(pair, world)``.

    Attributes:
        position: World point [m] midway between the two surface points.
        separation: Signed gap [m] along the normal, negative when overlapping; always finite.
        feature: int32 id of the geometric feature, stable from step to step within a pair.
        active: bool, False where this slot holds no contact (its other fields are finite and meaningless).
        normal: Unit vector from A to B where the points of a manifold have normals of their own (heightfields), else None.
    """

    position: Vec3
    separation: Array
    feature: Array
    active: Array
    normal: Vec3 | None = None


class Manifold(NamedTuple):
    """Contact points of a pair and their unit `normal` from A to B, in the world frame; see `ContactPoint.normal`.

    `converged` is bool, shape ``(pair, world)``, False where an iterative search ended at its limit with the best bound
    found; None for methods that always end.
    """

    normal: Vec3
    points: tuple[ContactPoint, ...]
    converged: Array | None = None


class Nearest(NamedTuple):
    """Closest points of two shapes; components of shape ``(pair, world)``.

    Attributes:
        separation: Signed gap [m], negative when overlapping.
        normal: Unit vector from A to B, world frame.
        point_a, point_b: World points [m] of both surfaces; ``point_b - point_a = separation * normal``.
        converged: bool, as of `Manifold`.
    """

    separation: Array
    normal: Vec3
    point_a: Vec3
    point_b: Vec3
    converged: Array | None = None
