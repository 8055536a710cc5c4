"""Convex polytopes by vertices, faces and edges, each in its own frame: what the separating axis test needs of a shape.

The outward face normals are the corners of the Gauss map, and an edge is the arc between the normals of its two faces. A
segment (the core of a capsule) is a polytope, too: its Gauss map is a great circle, given here in four arcs. A point (the
core of a sphere) has no edge; any direction supports it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.collision.polyhedron import edge_table, face_normals
from mathota_jax.spatial.vector import Vec3

AXES = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
BOX_CORNERS = np.array([[1 if code >> axis & 1 else -1 for axis in range(3)] for code in range(8)])
BOX_FACES = np.array([(1, 3, 7, 5), (0, 4, 6, 2), (2, 6, 7, 3), (0, 1, 5, 4), (4, 5, 7, 6), (0, 2, 3, 1)], np.int32)
"""Counter-clockwise from outside, in the order of `AXES`."""
SIDEWAYS = AXES[[0, 5, 1, 4]]
"""Normals of a segment along y, in the order in which its four arcs follow each other about +y."""

Edges = np.ndarray | Array


class Polytope(NamedTuple):
    """A convex polytope in its own frame.

    Attributes:
        vertices: Components (vertex, pair, world).
        normals: Outward unit normals of the faces; components (face, pair, world).
        edges: int32 (4, edge, row): vertices at the start and the end, faces to the left and the right, seen from
            outside (`collision.polyhedron.edge_table`). None where no edge has a direction of its own.
        row: int32 (pair, world) row of `edges`; None where it is the number of the pair, or there is one only.
    """

    vertices: Vec3
    normals: Vec3
    edges: Edges | None
    row: Array | None = None

    def without_edges(self) -> tuple[Polytope, Edges | None]:
        """The polytope as arrays ``(..., pair, world)`` only, and the table of its edges, of which it has the rows."""
        row = self.row
        if row is None and self.edges is not None and self.edges.shape[-1] > 1:
            row = jnp.arange(self.edges.shape[-1], dtype=jnp.int32)[:, None]
        return self._replace(edges=None, row=row), self.edges


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
    ends = _rows([(0, 1, 0), (0, -1, 0)], half) * half
    side = np.arange(4)
    arcs = np.stack([np.ones(4), np.zeros(4), side, np.roll(side, -1)])
    return Polytope(ends, _rows(SIDEWAYS, half), arcs.astype(np.int32)[..., None])


def _box(shape: dict[str, Any]) -> Polytope:
    half: Vec3 = shape["half_extents"]
    corners = _rows(BOX_CORNERS, half.x)
    vertices = Vec3(*(c * h for c, h in zip(corners, half, strict=True)))
    return Polytope(vertices, _rows(AXES, half.x), edge_table(BOX_FACES[None]))


def _polyhedron(shape: dict[str, Any]) -> Polytope:
    return Polytope(shape["vertices"], face_normals(shape), edge_table(shape["faces"]), shape.get("row"))


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
