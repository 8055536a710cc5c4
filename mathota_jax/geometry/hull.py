"""Convex hulls at build time: polygonal faces from raw points. NumPy and SciPy, float64."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

FLAT = 1e-6
"""Share of the size below which a thickness counts as none: float32 coordinates say no more."""

COPLANAR = 1e-6
"""Share of the size within which the corners of triangles count as lying in one plane; see `FLAT`."""

Faces = tuple[tuple[int, ...], ...]
"""Vertex indices of each polygonal face, counter-clockwise seen from outside."""


class Hull(NamedTuple):
    """Corners (vertex, 3) of a convex polyhedron and its faces."""

    vertices: np.ndarray
    faces: Faces


def convex_hull(name: str, points: np.ndarray) -> Hull:
    """Convex hull with coplanar triangles merged into polygons; only its corners are kept, in the order of the points.

    Source: C. B. Barber et al., "The Quickhull Algorithm for Convex Hulls", ACM TOMS 22(4), 1996.

    Args:
        name: what to call the points in messages.
        points: (point, 3) finite coordinates.

    Raises:
        ValueError: fewer than four different points, or all of them in one plane.
    """
    distinct = np.unique(points, axis=0)
    if len(distinct) < 4:
        raise ValueError(
            f"{name} must hold at least 4 different points, got {len(distinct)} ({len(points)} with duplicates); "
            "add points that span a volume"
        )
    center = distinct.mean(0)
    size = np.abs(points - center).max()
    scaled = (points - center) / size
    if _thickness(scaled) < FLAT:
        raise ValueError(
            f"{name} must span a volume, but all {len(points)} points lie in one plane or on one line to round-off; "
            "give the body a thickness, or use a thin Box"
        )
    try:
        hull = ConvexHull(scaled)
    except QhullError as error:
        raise ValueError(f"{name} has no convex hull with a volume: {str(error).splitlines()[0]}") from error
    faces = _merged(scaled, hull)
    corners = sorted({vertex for face in faces for vertex in face})
    number = {corner: index for index, corner in enumerate(corners)}
    return Hull(points[corners], tuple(tuple(number[vertex] for vertex in face) for face in faces))


def _thickness(points: np.ndarray) -> float:
    """Extent across the plane that fits best."""
    centered = points - points.mean(0)
    _, _, directions = np.linalg.svd(centered, full_matrices=False)
    return float(np.ptp(centered @ directions[-1]))


def _merged(points: np.ndarray, hull: ConvexHull) -> Faces:
    """Polygonal faces of a triangulated hull, or its triangles where merging would not leave a closed surface."""
    corners = hull.vertices
    triangles = hull.simplices
    area = np.linalg.norm(
        np.cross(points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]),
        axis=1,
    )
    # Large triangles know their plane best, so they are asked first, and slivers join them.
    free = np.ones(len(triangles), bool)
    polygons: list[tuple[np.ndarray, np.ndarray]] = []
    for triangle in np.argsort(-area, kind="stable"):
        if not free[triangle]:
            continue
        normal, offset = hull.equations[triangle, :3], hull.equations[triangle, 3]
        inside = corners[np.abs(points[corners] @ normal + offset) <= COPLANAR]
        free &= ~np.isin(triangles, inside).all(1)
        free[triangle] = False
        polygons.append((normal, inside))
    # A point with two faces only lies on an edge, one with a single face in its middle: neither is a corner.
    count = np.bincount(np.concatenate([inside for _, inside in polygons]), minlength=len(points))
    faces = tuple(_ordered(points, normal, inside[count[inside] >= 3]) for normal, inside in polygons)
    if _closed(faces):
        return faces
    flipped = np.einsum(
        "ij,ij->i",
        np.cross(points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]),
        hull.equations[:, :3],
    )
    return tuple(
        tuple(int(v) for v in (triangle if sign > 0 else triangle[::-1]))
        for triangle, sign in zip(triangles, flipped, strict=True)
    )


def _ordered(points: np.ndarray, normal: np.ndarray, inside: np.ndarray) -> tuple[int, ...]:
    """Corners of a convex face counter-clockwise about its outward normal, the smallest index first."""
    offset = points[inside] - points[inside].mean(0)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    second = np.cross(normal, first)
    order = inside[np.argsort(np.arctan2(offset @ second, offset @ first))]
    return tuple(int(v) for v in np.roll(order, -int(np.argmin(order))))


def _closed(faces: Faces) -> bool:
    """Whether every edge has one face to its left and one to its right, and Euler's formula holds."""
    edges = {(a, b) for face in faces for a, b in zip(face, face[1:] + face[:1], strict=True)}
    edge_count = sum(len(face) for face in faces)
    vertex_count = len({vertex for face in faces for vertex in face})
    paired = len(edges) == edge_count and all((b, a) in edges for a, b in edges)
    return paired and vertex_count - edge_count // 2 + len(faces) == 2


def face_planes(hull: Hull) -> tuple[np.ndarray, np.ndarray]:
    """Outward unit normals (face, 3) and offsets (face,): ``normal . x = offset`` on a face. Newell's method."""
    normals, offsets = [], []
    for face in hull.faces:
        corners = hull.vertices[list(face)]
        center = corners.mean(0)
        normal = np.cross(corners - center, np.roll(corners, -1, 0) - center).sum(0)
        normal /= np.linalg.norm(normal)
        normals.append(normal)
        offsets.append(normal @ center)
    return np.stack(normals), np.stack(offsets)


def padded_faces(hulls: list[Faces] | tuple[Faces, ...]) -> np.ndarray:
    """Faces of several polyhedra as one int32 array (polyhedron, face, corner).

    A face repeats its last corner and a polyhedron its first face until all have the same number of them.
    """
    corner_count = max(len(face) for faces in hulls for face in faces)
    face_count = max(len(faces) for faces in hulls)
    full = [[face + face[-1:] * (corner_count - len(face)) for face in faces] for faces in hulls]
    return np.asarray([faces + faces[:1] * (face_count - len(faces)) for faces in full], np.int32)
