"""Convex polytopes by vertices, faces and edges, each in its own frame: what the separating axis test needs of a shape.

The outward face normals are the corners of the Gauss map, and an edge is the arc between the normals of its two faces. A
segment (the core of a capsule) is a polytope, too: its Gauss map is a great circle, given here in four arcs. A point (the
core of a sphere) has no edge; any direction supports it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.collision.polyhedron import edge_table, polyhedron_faces, take_vertices
from mathota_jax.spatial.vector import Vec3, normalize

AXES = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
BOX_CORNERS = np.array([[1 if code >> axis & 1 else -1 for axis in range(3)] for code in range(8)])
BOX_FACES = np.array([(1, 3, 7, 5), (0, 4, 6, 2), (2, 6, 7, 3), (0, 1, 5, 4), (4, 5, 7, 6), (0, 2, 3, 1)], np.int32)
"""Counter-clockwise from outside, in the order of `AXES`."""
SIDEWAYS = AXES[[0, 5, 1, 4]]
"""Normals of a segment along y, in the order in which its four arcs follow each other about +y."""


class Edges(NamedTuple):
    """Edges with the outward normals on both sides; components (edge, pair, world).

    Attributes:
        start: One end.
        along: Unit vector along the edge, parallel to ``left x right``.
        left: Normal of the face to the left, seen from outside.
        right: Normal of the other face.
    """

    start: Vec3
    along: Vec3
    left: Vec3
    right: Vec3


def row_count(edges: Edges) -> int:
    """How many edges there are; components that all edges share have one row."""
    return max(component.shape[0] for component in jax.tree.leaves(edges))


class Polytope(NamedTuple):
    """Components (vertex, pair, world) and (face, pair, world) of vertices and outward unit normals; and the edges."""

    vertices: Vec3
    normals: Vec3
    edges: Edges | None


def polytope(kind: str, shape: dict[str, Any]) -> Polytope:
    """Core of a shape as a polytope.

    Args:
        kind: Key of `POLYTOPES`.
        shape: Parameters; of a polyhedron with the static "faces".
    """
    return POLYTOPES[kind](shape)


def _rows(values: Any, like: Array) -> Vec3:
    """Constant vectors (row, 3) as components (row, 1, 1)."""
    return Vec3(*(jnp.asarray(np.asarray(values)[:, k, None, None], like.dtype) for k in range(3)))


def _point(shape: dict[str, Any]) -> Polytope:
    radius = shape["radius"]
    return Polytope(_rows([(0, 0, 0)], radius), _rows([(0, 1, 0)], radius), None)


def _segment(shape: dict[str, Any]) -> Polytope:
    half = shape["half_height"]
    normals = _rows(SIDEWAYS, half)
    ends = _rows([(0, 1, 0), (0, -1, 0)], half) * half
    start, along = ends.map(lambda c: c[1:]), _rows([(0, 1, 0)], half)
    following = normals.map(lambda c: jnp.roll(c, -1, axis=0))
    return Polytope(ends, normals, Edges(start, along, normals, following))


def _box(shape: dict[str, Any]) -> Polytope:
    half: Vec3 = shape["half_extents"]
    corners = _rows(BOX_CORNERS, half.x)
    vertices = Vec3(*(c * h for c, h in zip(corners, half, strict=True)))
    start, end, left, right = edge_table(BOX_FACES[None])
    along = (BOX_CORNERS[end[:, 0]] - BOX_CORNERS[start[:, 0]]) / 2
    # The direction is known without the extents, of which one may be zero.
    faces = (_rows(AXES[side[:, 0]], half.x) for side in (left, right))
    return Polytope(vertices, _rows(AXES, half.x), Edges(take_vertices(vertices, start), _rows(along, half.x), *faces))


def _polyhedron(shape: dict[str, Any]) -> Polytope:
    vertices: Vec3 = shape["vertices"]
    normals = polyhedron_faces(vertices, shape["faces"]).normal
    table = edge_table(shape["faces"])
    ends, sides = take_vertices(vertices, table[:2]), take_vertices(normals, table[2:])
    first, second = (ends.map(lambda c, k=k: c[k]) for k in range(2))
    left, right = (sides.map(lambda c, k=k: c[k]) for k in range(2))
    edges = Edges(first, normalize(second - first), left, right)
    return Polytope(vertices, normals, edges)


POLYTOPES: dict[str, Callable[[dict[str, Any]], Polytope]] = {
    "sphere": _point,
    "capsule": _segment,
    "box": _box,
    "polyhedron": _polyhedron,
}
"""Registry: kind -> core as a polytope."""


def are_polytopes(kinds: Sequence[str]) -> bool:
    """Whether the cores of all these kinds are polytopes."""
    return all(kind in POLYTOPES for kind in kinds)
