"""Convex hulls as the collision tests need them: vertices and polygonal faces, in plain NumPy and SciPy."""

import itertools

import numpy as np
from scipy.spatial import ConvexHull

BOX_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
"""Corners of the cube of half size 1."""


def hull(points):
    """Vertices (V, 3) and faces (F, K) of a hull: coplanar triangles merged, counter-clockwise, last vertex repeated."""
    points = np.asarray(points, float)
    found = ConvexHull(points)
    number = {old: new for new, old in enumerate(found.vertices)}
    vertices = points[found.vertices]
    size = np.abs(vertices).max()
    groups = []
    for simplex, equation in zip(found.simplices, found.equations, strict=True):
        corners = {number[v] for v in simplex}
        for normal, members in groups:
            if (
                np.abs(normal - equation[:3]).max() < 1e-7
                and np.ptp(vertices[[*members, *corners]] @ normal) < 1e-9 * size
            ):
                members |= corners
                break
        else:
            groups.append((equation[:3], corners))
    polygons = []
    for normal, members in groups:
        members = np.array(sorted(members))
        arms = vertices[members] - vertices[members].mean(0)
        u = arms[0] / np.linalg.norm(arms[0])
        angle = np.arctan2(arms @ np.cross(normal, u), arms @ u)
        polygons.append(members[np.argsort(angle)])
    width = max(len(p) for p in polygons)
    return vertices, np.array([np.r_[p, np.repeat(p[-1:], width - len(p))] for p in polygons], np.int32)


def point_to_hull(point, vertices, faces):
    """Signed distance by enumerating corners, edges and planes of the triangulated faces."""
    triangles = [(face[0], *pair) for face in faces for pair in itertools.pairwise(face[1:])]
    corners = vertices[np.array(triangles)]
    sides = np.roll(corners, -1, axis=1) - corners
    normals = np.cross(sides[:, 0], -sides[:, 2])
    lengths = np.linalg.norm(normals, axis=1)
    # Faces are padded with their last corner.
    proper = lengths > 1e-12 * np.abs(vertices).max() ** 2
    corners, sides, normals = corners[proper], sides[proper], normals[proper] / lengths[proper, None]
    heights = np.sum((point - corners[:, 0]) * normals, axis=1)
    if heights.max() <= 0:
        return heights.max()
    axes = np.stack([sides[:, 0], -sides[:, 2], normals], axis=2)
    shares = np.linalg.solve(axes, (point - corners[:, 0])[..., None])[:, :2, 0]
    over = (shares >= 0).all(1) & (shares.sum(1) <= 1)
    along = np.clip(np.sum((point - corners) * sides, axis=2) / np.sum(sides**2, axis=2), 0, 1)
    to_edges = np.linalg.norm(point - corners - along[..., None] * sides, axis=2)
    return min(np.abs(heights[over]).min(initial=np.inf), to_edges.min())
