"""Faces and edges of polyhedra: vertices on the leading axis, incidence known at trace time."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.vector import Vec3, cross, normalize


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


def polyhedron_edges(faces: np.ndarray) -> np.ndarray:
    """Vertex numbers of all edges, int32 (2, edge, pair); padded to a common count by repeating the first edge.

    Args:
        faces: int32 (pair, face, corner).
    """
    return edge_table(faces)[:2]


def edge_table(faces: np.ndarray) -> np.ndarray:
    """All edges: vertex numbers of start and end, numbers of the faces to the left and right; int32 (4, edge, pair).

    Seen from outside, the edge runs counter-clockwise about the face to its left. Padded as `polyhedron_edges`.

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
