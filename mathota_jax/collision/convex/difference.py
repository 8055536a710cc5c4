"""The Minkowski difference B - A of two convex shapes, in the frame of A.

Everything the search and its differentiable completion know of the shapes: the extreme piece pair along a direction, and
the difference point of a given piece pair. Working in the frame of A keeps float32 exact far from the world's origin.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.convex.support import SUPPORT, Parameters
from mathota_jax.collision.polyhedron import TOPOLOGY
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.vector import Mat3, Vec3, cross, dot, norm
from mathota_jax.struct import pytree, static

CODE_BITS = 6
CODES = 1 << CODE_BITS
"""Piece codes of one shape are below this; a pair of pieces has the code ``CODES * code_a + code_b``."""


@pytree
class Difference:
    """Two shapes in the frame of A: kinds (static), parameters, rotation and position of B relative to A.

    All lengths are measured in units of `scale`, the larger extent of the two shapes [m], so that tolerances are plain
    numbers and products of lengths do not underflow in float32.
    """

    kind_a: str = static()
    kind_b: str = static()
    a: Parameters
    b: Parameters
    rotation: Mat3
    position: Vec3
    scale: Array

    def pieces(self, direction: Vec3) -> Array:
        """Code of the piece pair whose difference is least along `direction` (int32, settled)."""
        code_a = SUPPORT[self.kind_a].code(self.a, direction)
        code_b = SUPPORT[self.kind_b].code(self.b, -self.rotation.apply_transposed(direction))
        # Joined as floats: the search of A would be part of the kernel of an integer sum, which does not vectorise.
        number = direction.x.dtype
        return settle_code(CODES * code_a.astype(number) + code_b.astype(number))

    def points(self, pieces: Array, direction: Vec3) -> tuple[Vec3, Vec3]:
        """Points of A and of B, in the frame of A, of a piece pair at a stored direction (A's along it, B's against it)."""
        point_a = SUPPORT[self.kind_a].point(self.a, code_of(pieces, of_b=False), direction)
        against = -self.rotation.apply_transposed(direction)
        if SUPPORT[self.kind_b].rim_radius is not None:
            # Along the axis of a rim what is left across it is round-off, but one and the same for all components: else
            # they belong to different points of the rim, and together to none.
            against = compute_once(against, direction.x)
        local = SUPPORT[self.kind_b].point(self.b, code_of(pieces, of_b=True), against)
        return point_a, self.position + self.rotation.apply(local)

    def point(self, pieces: Array, direction: Vec3) -> Vec3:
        """Point of B - A of a piece pair."""
        point_a, point_b = self.points(pieces, direction)
        return point_b - point_a

    def least(self, direction: Vec3) -> tuple[Vec3, Array]:
        """Point of B - A that is least along `direction`, and its piece pair."""
        pieces = self.pieces(direction)
        return self.point(pieces, direction), pieces


def code_of(pieces: Array, *, of_b: bool) -> Array:
    """Piece of one shape in the code of a pair, by its bits: division of integers takes jnp six operations."""
    return pieces & (CODES - 1) if of_b else pieces >> CODE_BITS


def difference(kind_a: str, a: Parameters, pose_a: Pose, kind_b: str, b: Parameters, pose_b: Pose) -> Difference:
    """Brings two placed shapes into the frame of A. Differentiable (the unit of length counts as a constant)."""
    scale = lax.stop_gradient(jnp.maximum(_extent(kind_a, a), _extent(kind_b, b)))
    inverse = 1.0 / jnp.where(scale > 0, scale, 1.0)
    rotation_a, rotation_b = _rotation(pose_a), _rotation(pose_b)
    columns = (rotation_a.apply_transposed(column) for column in rotation_b)
    position = rotation_a.apply_transposed(pose_b.position - pose_a.position) * inverse
    a, b = (jax.tree.map(lambda length: length * inverse, lengths(shape)) for shape in (a, b))
    return Difference(kind_a, kind_b, a, b, Mat3(*columns), position, scale)


def lengths(shape: Parameters) -> Parameters:
    """The parameters that are lengths."""
    return {name: value for name, value in shape.items() if name not in TOPOLOGY}


def _extent(kind: str, shape: Parameters) -> Array:
    core, inflation = SUPPORT[kind].extent(shape), SUPPORT[kind].inflation
    return core if inflation is None else core + inflation(shape)


def _rotation(pose: Pose) -> Mat3:
    """Rotation of a pose; the identity for shapes that carry none (sphere)."""
    if pose.rotation is not None:
        return pose.rotation
    one, zero = jnp.ones_like(pose.position.x), jnp.zeros_like(pose.position.x)
    return Mat3(Vec3(one, zero, zero), Vec3(zero, one, zero), Vec3(zero, zero, one))


Weights = tuple[Array, Array, Array]


def barycentric(points: Sequence[Vec3], two: Array, three: Array) -> Weights:
    """Weights of the point closest to the origin on the plane of three points; on the line of two; of the first alone.

    Differentiable. Degenerate triangles and segments weigh their first point.

    Args:
        points: Three points.
        two: bool, use the second point.
        three: bool, use the third point too.
    """
    first, second, third = points
    edge, other = second - first, third - first
    normal = cross(edge, other)
    inverse = safe_divide(jnp.ones_like(first.x), dot(normal, normal))
    u, v = dot(normal, cross(other, first)) * inverse, dot(normal, cross(first, edge)) * inverse
    along = safe_divide(-dot(first, edge), dot(edge, edge))
    weight_1 = jnp.where(three, u, jnp.where(two, along, 0.0))
    weight_2 = jnp.where(three, v, 0.0)
    return 1.0 - weight_1 - weight_2, weight_1, weight_2


def combine(weights: Weights, points: Sequence[Vec3]) -> Vec3:
    """Weighted sum of three points."""
    return points[0] * weights[0] + points[1] * weights[1] + points[2] * weights[2]


def unit(vector: Vec3, fallback: Vec3) -> Vec3:
    """Unit vector, or `fallback` where the length underflows. Value only: for the search."""
    length = norm(vector)
    usable = length > 0
    inverse = 1.0 / jnp.where(usable, length, 1.0)
    return Vec3(*(jnp.where(usable, v * inverse, f) for v, f in zip(vector, fallback, strict=True)))
