"""Signed distances of spheres, capsules, boxes and hulls in float64, all poses at once: every direction that can separate.

The separation along any unit direction is a lower bound of the signed distance. The best direction is normal to a face,
across an edge of each, or leads from a corner or edge to a corner: the greatest of all these bounds is the distance.
"""

import itertools

import numpy as np
from scipy.spatial.transform import Rotation

from mathota_jax.collision.polyhedron import edge_table
from tests.convex_oracle import CORNER_FACES
from tests.hulls import BOX_CORNERS, hull

KINDS = ("sphere", "capsule", "box", "polyhedron")
BLOCK = 250
"""Poses at a time."""


class Cores:
    """World corners (pose, corner, 3) of one side's cores, directions of its edges and normals of its faces; radii."""

    def __init__(self, kind, shape, position, quaternion):
        count = len(position)
        turns = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix()
        if kind == "sphere":
            corners, ends, faces = np.zeros((count, 1, 3)), np.zeros((2, 0), int), np.zeros((0, 3), int)
        elif kind == "capsule":
            corners = np.array([[0, 1, 0], [0, -1, 0]]) * shape["half_height"][:, None, None]
            ends, faces = np.array([[0], [1]]), np.zeros((0, 3), int)
        else:
            box = kind == "box"
            corners = BOX_CORNERS * shape["half_extents"][:, None] if box else shape["vertices"]
            faces = hull(BOX_CORNERS)[1] if box else CORNER_FACES
            ends = edge_table(faces[None])[:2, :, 0]
        self.ends, self.radius = ends, shape["radius"] if kind in ("sphere", "capsule") else np.zeros(count)
        self.corners = corners @ turns.swapaxes(1, 2) + position[:, None]
        first, second, third = (self.corners[:, faces[:, k]] for k in range(3))
        self.normals = np.cross(second - first, third - first)
        self.edges = self.corners[:, ends[1]] - self.corners[:, ends[0]]
        self.starts = self.corners[:, ends[0]]


def separations(a, b, directions):
    """Separation [m] along unit directions (pose, row, 3) from A to B."""
    heights = (np.einsum("prk,pck->prc", directions, cores.corners) for cores in (b, a))
    return next(heights).min(-1) - next(heights).max(-1) - (a.radius + b.radius)[:, None]


def polytope_distance(pair, scene):
    """Signed distances [m] and unit normals from A to B, one a pose."""
    found = [_block(pair, scene, slice(k, k + BLOCK)) for k in range(0, len(scene["pa"]), BLOCK)]
    return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))


def placed(pair, scene, rows=slice(None)):
    """Both sides of a scene."""
    return [
        Cores(kind, {n: v[rows] for n, v in scene[side].items()}, scene["p" + side][rows], scene["q" + side][rows])
        for side, kind in zip("ab", pair, strict=True)
    ]


def _block(pair, scene, rows):
    a, b = placed(pair, scene, rows)
    candidates = [a.normals, -a.normals, b.normals, -b.normals]
    across = _pairs(a.edges, b.edges, np.cross)
    candidates += [across, -across, _pairs(a.corners, b.corners, lambda p, q: q - p)]
    for cores, other, sign in ((a, b, 1.0), (b, a, -1.0)):
        candidates.append(sign * _across(cores, other))
    candidates = np.concatenate(candidates, axis=1)
    lengths = np.linalg.norm(candidates, axis=2, keepdims=True)
    usable = lengths[..., 0] > 1e-14
    unit = candidates / np.where(lengths > 0, lengths, 1.0)
    bounds = np.where(usable, separations(a, b, unit), -np.inf)
    best = np.argmax(bounds, axis=1)
    every = np.arange(len(best))
    return bounds[every, best], unit[every, best]


def _pairs(left, right, function):
    left, right = np.broadcast_arrays(left[:, :, None], right[:, None])
    return function(left, right).reshape(len(left), -1, 3)


def _across(cores, other):
    """From the corners of the other to the lines of the edges, made orthogonal twice for what cancellation leaves."""
    squared = np.einsum("pek,pek->pe", cores.edges, cores.edges)[:, :, None, None]
    edge = cores.edges[:, :, None]
    offset = cores.starts[:, :, None] - other.corners[:, None]
    for _ in range(2):
        offset = offset - edge * ((offset * edge).sum(-1, keepdims=True) / np.where(squared > 0, squared, 1.0))
    return -offset.reshape(len(offset), -1, 3)


def polytope_pairs():
    """All pairs of kinds that this oracle knows."""
    return list(itertools.combinations_with_replacement(KINDS, 2))
