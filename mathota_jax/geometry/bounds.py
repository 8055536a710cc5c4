"""Axis-aligned bounds and bounding spheres of placed shapes; worlds last, differentiable."""

from __future__ import annotations

from typing import Any

from mathota_jax.geometry import SHAPES
from mathota_jax.geometry.shape import Bounds
from mathota_jax.spatial.pose import Pose


def aabb(kind: str, parameters: dict[str, Any], pose: Pose) -> Bounds:
    """Smallest axis-aligned box that contains each shape (for a heightfield: that contains the box around it).

    Args:
        kind: Key of `SHAPES`.
        parameters: Sizes by name, components of shape ``(element, world)``; vertices of a polyhedron are a `Vec3` of
            components ``(vertex, element, world)``, heights have shape ``(row, column, element, world)``.
        pose: Of the shapes, components of shape ``(element, world)``.

    Returns:
        ``(low, high)`` corners [m], world frame. Infinite for a plane.
    """
    return SHAPES[kind].bounds_of(parameters, pose)


def bounding_radius(kind: str, parameters: dict[str, Any]) -> Any:
    """Radius [m] of the smallest sphere about the origin of each shape that contains it; arguments as for `aabb`."""
    return SHAPES[kind].reach_of(parameters)
