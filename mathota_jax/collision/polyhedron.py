"""Faces and edges of polyhedra: vertices on the leading axis, incidence known at trace time.

Which polyhedron a pair has may be known in the step only (`polyhedra_of_places`). Then its parameters hold, beside its
"vertices", all polyhedra of the scene (the "table" of their vertices, and their "faces") and the "row" (pair, world) of its
own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.spatial.indexing import gather_together, unstack
from mathota_jax.spatial.vector import Vec3, cross, normalize

TOPOLOGY = ("faces", "row", "table")
"""Parameters of a polyhedron that are no lengths."""


class PolyhedronFaces(NamedTuple):
    """Faces of polyhedra in their own frame.

    Attributes:
        corners: Vertices of each face, counter-clockwise from outside; components (corner, face, pair, world).
        normal: Outward unit normals; components (face, pair, world).
        center: Mean of the distinct corners; components (face, pair, world).
    """

    corners: Vec3
    normal: Vec3
    center: Vec3


def polyhedron_faces(vertices: Vec3, faces: np.ndarray) -> PolyhedronFaces:
    """Planes of all faces, differentiable in the vertices.

    The normal is Newell's (M. Newell, 1972: the vector area of the polygon), which no short or nearly straight corner
    upsets.

    Args:
        vertices: Components (vertex, pair, world).
        faces: int32 (pair, face, corner); faces of fewer corners repeat their last one.
    """
    corner_numbers = np.moveaxis(faces, 0, -1).swapaxes(0, 1)
    both = take_vertices(vertices, np.stack([corner_numbers, np.roll(corner_numbers, -1, axis=0)]))
    corners, following = both.map(lambda c: c[0]), both.map(lambda c: c[1])
    first = corners.map(lambda c: c[:1])
    area = cross(corners - first, following - first).map(lambda c: jnp.sum(c, axis=0))
    distinct = (faces != np.roll(faces, 1, axis=2)) | (faces.shape[2] == 1)
    weight = np.moveaxis(distinct / distinct.sum(axis=2, keepdims=True), 0, -1).swapaxes(0, 1)[..., None]
    center = corners.map(lambda c: jnp.sum(c * jnp.asarray(weight, c.dtype), axis=0))
    return PolyhedronFaces(corners, normalize(area), center)


def take_vertices(vertices: Vec3, indices: np.ndarray) -> Vec3:
    """Vertices by number.

    Args:
        vertices: Components (vertex, pair, world).
        indices: (..., pair); the pair axis of either may be 1.

    Returns:
        Components (..., pair, world).
    """
    pairs = max(indices.shape[-1], vertices.x.shape[1])
    indices = np.broadcast_to(indices, (*indices.shape[:-1], pairs))

    rows = np.arange(pairs) if vertices.x.shape[1] > 1 else np.zeros(pairs, np.int32)
    if vertices.x.shape[-1] > 1:
        return vertices.map(lambda component: component[indices, np.broadcast_to(rows, indices.shape)])
    # What all worlds share is taken by one operation, which is compiled once.
    return Vec3(*unstack(jnp.stack(vertices)[:, indices, np.broadcast_to(rows, indices.shape)], 0))


def edge_table(faces: np.ndarray) -> np.ndarray:
    """All edges: vertex numbers of start and end, numbers of the faces to the left and right; int32 (4, edge, pair).

    Seen from outside, the edge runs counter-clockwise about the face to its left. Padded to a common count by repeating the
    first edge.

    Args:
        faces: int32 (pair, face, corner) of closed polyhedra.
    """
    lists = []
    for polygons in faces:
        face_of: dict[tuple[int, int], int] = {}
        for face, polygon in enumerate(polygons.tolist()):
            for ends in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                if ends[0] != ends[1]:
                    face_of.setdefault(ends, face)
        lists.append(sorted((*ends, f, face_of[ends[1], ends[0]]) for ends, f in face_of.items() if ends[0] < ends[1]))
    count = max(len(edges) for edges in lists)
    padded = [edges + edges[:1] * (count - len(edges)) for edges in lists]
    return np.moveaxis(np.asarray(padded, np.int32), -1, 0).swapaxes(1, 2)


def polyhedra_of_places(polyhedra: dict[str, Any], row: Array) -> dict[str, Any]:
    """Parameters of the polyhedra in the given rows (place, world) of those with vertices (vertex, row, world)."""
    table: Vec3 = polyhedra["vertices"]
    return {"vertices": gather_together(table, row), "faces": polyhedra["faces"], "table": table, "row": row}


def face_normals(polyhedron: dict[str, Any]) -> Vec3:
    """Outward unit normals of the polyhedra of all pairs, components (face, pair, world)."""
    if "row" not in polyhedron:
        return polyhedron_faces(polyhedron["vertices"], polyhedron["faces"]).normal
    return gather_together(polyhedron_faces(polyhedron["table"], polyhedron["faces"]).normal, polyhedron["row"])


def polyhedron_surface(polyhedron: dict[str, Any]) -> tuple[PolyhedronFaces, Vec3, Vec3]:
    """Faces of the polyhedra of all pairs, and both ends of their edges, components (edge, pair, world)."""
    vertices = polyhedron.get("table", polyhedron["vertices"])
    start, end, *_ = edge_table(polyhedron["faces"])
    found = (
        polyhedron_faces(vertices, polyhedron["faces"]),
        take_vertices(vertices, start),
        take_vertices(vertices, end),
    )
    return gather_together(found, polyhedron["row"]) if "row" in polyhedron else found


def face_corners(polyhedron: dict[str, Any], face: Array) -> Array:
    """int32 (corner, pair, world) numbers of the vertices of a face, given by number (pair, world)."""
    table = polyhedron["faces"]
    row = polyhedron.get("row", np.arange(len(table), dtype=np.int32)[:, None])
    return jnp.moveaxis(jnp.asarray(table)[row, face], -1, 0)
