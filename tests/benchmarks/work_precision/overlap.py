"""Penetration from poses alone, in NumPy float64: the same judge for every engine."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np

from mathota_jax import Box, Plane, Polyhedron, Sphere
from tests.hulls import BOX_CORNERS, hull
from tests.scenes import rotation_matrix

PARALLEL = 1e-9
"""Directions whose sine is below this are one."""


def deepest(bodies: tuple[Any, ...], position: np.ndarray, orientation: np.ndarray) -> float:
    """Largest penetration of any pair of bodies [m], 0 if none overlap.

    Overlap along the axis of least overlap: normals of the faces of both, and products of an edge of each (S. Gottschalk
    et al., OBBTree, SIGGRAPH 1996, for any convex polytope).

    Args:
      bodies: `Body` of each row of the poses; static ones, which stay where they are, come first and have no row.
      position: (moving body, 3).
      orientation: (moving body, 4).
    """
    static = [body for body in bodies if body.mass is None]
    shapes = [body.shape for body in bodies]
    place = np.concatenate([np.array([body.position for body in static], float).reshape(-1, 3), position])
    turn = rotation_matrix(
        np.concatenate([np.array([body.orientation for body in static], float).reshape(-1, 4), orientation])
    )
    depths = [
        _depth(shapes[a], place[a], turn[a], shapes[b], place[b], turn[b])
        for a, b in itertools.combinations(range(len(bodies)), 2)
        if b >= len(static)
    ]
    return float(max(0.0, *depths))


def _depth(a: Any, place_a: np.ndarray, turn_a: np.ndarray, b: Any, place_b: np.ndarray, turn_b: np.ndarray) -> float:
    if isinstance(a, Plane):
        normal = np.array(a.normal, float)
        return float(a.offset - normal @ place_b + _reach(b, turn_b, normal[None])[0])
    between = place_b - place_a
    if np.linalg.norm(between) > _bound(a) + _bound(b):
        return -np.inf
    if isinstance(a, Sphere) and isinstance(b, Sphere):
        return float(a.radius + b.radius - np.linalg.norm(between))
    axes = _axes(a, turn_a, b, turn_b)
    overlap = _reach(a, turn_a, axes) + _reach(b, turn_b, -axes) - axes @ between
    return float(overlap.min())


def _reach(shape: Any, turn: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Support function about the centre, (direction,)."""
    if isinstance(shape, Sphere):
        return np.full(len(directions), float(shape.radius))
    return (directions @ turn @ _polytope(shape)[0].T).max(axis=1)


def _bound(shape: Any) -> float:
    if isinstance(shape, Sphere):
        return float(shape.radius)
    return float(np.linalg.norm(_polytope(shape)[0], axis=1).max())


def _axes(a: Any, turn_a: np.ndarray, b: Any, turn_b: np.ndarray) -> np.ndarray:
    """Directions from A to B that may separate: unit, (direction, 3)."""
    (_, normals_a, edges_a), (_, normals_b, edges_b) = _polytope(a), _polytope(b)
    crossed = np.cross((edges_a @ turn_a.T)[:, None], (edges_b @ turn_b.T)[None]).reshape(-1, 3)
    length = np.linalg.norm(crossed, axis=1)
    crossed = crossed[length > PARALLEL] / length[length > PARALLEL, None]
    return np.concatenate([normals_a @ turn_a.T, -normals_b @ turn_b.T, crossed, -crossed])


@functools.cache
def _polytope(shape: Box | Polyhedron) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, outward face normals and directions of edges in the body frame."""
    points = BOX_CORNERS * np.array(shape.half_extents) if isinstance(shape, Box) else np.array(shape.vertices)
    vertices, faces = hull(points)
    normals, edges = [], []
    for face in faces:
        corners = vertices[face[: np.argmax(face == face[-1]) + 1]]
        sides = np.roll(corners, -1, axis=0) - corners
        normal = np.cross(sides[0], sides[1])
        normals.append(normal / np.linalg.norm(normal))
        edges.extend(sides / np.linalg.norm(sides, axis=1, keepdims=True))
    unique: list[np.ndarray] = []
    for edge in edges:
        if all(np.linalg.norm(np.cross(edge, other)) > PARALLEL for other in unique):
            unique.append(edge)
    return vertices, np.array(normals), np.array(unique)
