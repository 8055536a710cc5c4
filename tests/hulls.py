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
    planes, best = [], np.inf
    for face in faces:
        a = vertices[face[0]]
        for second, third in itertools.pairwise(face[1:]):
            b, c = vertices[second], vertices[third]
            normal = np.cross(b - a, c - a)
            if np.linalg.norm(normal) < 1e-12 * np.abs(vertices).max() ** 2:
                continue
            normal /= np.linalg.norm(normal)
            planes.append(normal @ (point - a))
            shares = np.linalg.solve(np.stack([b - a, c - a, normal], 1), point - a)
            if shares[0] >= 0 and shares[1] >= 0 and shares[0] + shares[1] <= 1:
                best = min(best, abs(shares[2]))
            for start, end in ((a, b), (b, c), (c, a)):
                t = np.clip((point - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
                best = min(best, np.linalg.norm(point - start - t * (end - start)))
    return max(planes) if max(planes) <= 0 else best
