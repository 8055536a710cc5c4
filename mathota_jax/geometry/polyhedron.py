"""Solid convex polyhedron."""

from typing import Any, ClassVar

import numpy as np

from mathota_jax.geometry.hull import Faces, Hull, convex_hull, face_planes
from mathota_jax.geometry.inertia import MassProperties
from mathota_jax.geometry.shape import Bounds, Shape
from mathota_jax.geometry.validation import finite_array
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import Vec3, dot

VERTEX_LIMIT = 64


class Polyhedron(Shape):
    """Convex hull of points, in the frame in which they are given. Its centre of mass need not be the origin.

    Args:
        points: Points [m], shape ``(point, 3)``, in any order; at most 64 of them may be corners of the hull.

    Attributes:
        vertices: Corners of the hull, shape ``(vertex, 3)``.
        faces: Vertex indices of each polygonal face, counter-clockwise seen from outside; coplanar triangles are merged.

    Raises:
        ValueError: if the points are not finite, span no volume or have too many corners.
    """

    kind: ClassVar[str] = "polyhedron"

    def __init__(self, points: Any) -> None:
        name = "Polyhedron.points"
        array = finite_array(name, points)
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name} must have shape (points, 3), got {array.shape}")
        hull = convex_hull(name, array)
        if len(hull.vertices) > VERTEX_LIMIT:
            raise ValueError(
                f"{name} has a hull of {len(hull.vertices)} corners, at most {VERTEX_LIMIT} are possible; simplify it, "
                "for example by mathota_jax.io.simplified_hull"
            )
        self.vertices = hull.vertices
        self.faces: Faces = hull.faces

    def __repr__(self) -> str:
        return f"Polyhedron(<{len(self.vertices)} vertices, {len(self.faces)} faces>)"

    def parameters(self) -> dict[str, np.ndarray]:
        """Float64 arrays, which become differentiable leaves of the model."""
        return {"vertices": self.vertices.copy()}

    def mass_properties(self) -> MassProperties:
        """Volume, centre of mass and inertia in the shape's own frame, NumPy float64."""
        return self.mass_of({"vertices": self.vertices, "faces": self.faces})

    @staticmethod
    def mass_of(parameters: dict[str, Any]) -> MassProperties:
        """Sums over the tetrahedra between a point inside and the triangles of the surface.

        A tetrahedron (0, a, b, c) has the volume det / 6 and the second moment
        ``det / 120 (aa + bb + cc + (a + b + c)(a + b + c))``. Which faces there are is held fixed: derivatives are exact
        for motions that keep them flat. A face of more than three corners folds when one of them leaves its plane, one
        way outwards, another inwards; it is cut about its mean corner, which lies between the two (half way for a
        rectangle).

        Args:
            parameters: "vertices" (vertex, 3), and "faces", vertex indices of each face (static).
        """
        vertices = parameters["vertices"]
        xp = vertices.__array_namespace__()
        origin = vertices.mean(0)
        mean, first, second = _triangles(parameters["faces"], len(vertices))
        a, b, c = (xp.asarray(weights, dtype=vertices.dtype) @ (vertices - origin) for weights in (mean, first, second))
        det = (a * xp.stack(_cross(b, c), axis=1)).sum(1)
        volume = det.sum() / 6.0
        total = a + b + c
        center = (det[:, None] * total).sum(0) / (24.0 * volume)
        second_moment = sum((det[:, None] * v).T @ v for v in (a, b, c, total)) / (120.0 * volume)
        # About the centre of mass (parallel axes), then from second moments to moments of inertia.
        second_moment = second_moment - center[:, None] * center[None, :]
        inertia = xp.trace(second_moment) * xp.eye(3, dtype=vertices.dtype) - second_moment
        return MassProperties(volume, origin + center, inertia)

    @staticmethod
    def bounds_of(parameters: dict[str, Any], pose: Pose) -> Bounds:
        """Over all vertices, given as a `Vec3` of components (vertex, element, world)."""
        assert pose.rotation is not None
        turned = pose.rotation.apply(parameters["vertices"])
        return Bounds(pose.position + turned.map(lambda c: c.min(0)), pose.position + turned.map(lambda c: c.max(0)))

    @staticmethod
    def reach_of(parameters: dict[str, Any]) -> Any:
        """To the farthest vertex."""
        vertices = parameters["vertices"]
        vertices = vertices if isinstance(vertices, Vec3) else Vec3(*vertices.T)
        return dot(vertices, vertices).max(0) ** 0.5

    def inradius(self) -> float:
        """Distance [m] from the centre of mass to the nearest face."""
        normals, offsets = face_planes(Hull(self.vertices, self.faces))
        return float((offsets - normals @ self.center_of_mass()).min())


def _cross(b: Any, c: Any) -> tuple[Any, Any, Any]:
    return (
        b[:, 1] * c[:, 2] - b[:, 2] * c[:, 1],
        b[:, 2] * c[:, 0] - b[:, 0] * c[:, 2],
        b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0],
    )


def _triangles(faces: Faces, vertex_count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights (triangle, vertex) of the vertices in the three corners of every triangle of the surface."""
    identity = np.eye(vertex_count)
    rows = [
        (identity[list(face)].mean(0), identity[start], identity[end])
        for face in faces
        for start, end in zip(face, face[1:] + face[:1], strict=True)
    ]
    mean, first, second = (np.stack(column) for column in zip(*rows, strict=True))
    return mean, first, second
