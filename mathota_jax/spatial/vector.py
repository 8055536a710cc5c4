"""Three-vectors and 3x3 matrices whose components are separate arrays.

Inside the engine every component is an array of shape ``(element, world)``. Keeping the components apart lets XLA fuse
whole expressions into one vectorised loop over worlds; arrays of shape ``(..., 3)`` were measured 8x slower (docs in
`batching.py`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp

from mathota_jax.spatial.safe import safe_divide, safe_sqrt


class Vec3(NamedTuple):
    """Cartesian vector; each component broadcasts against the others."""

    x: Any
    y: Any
    z: Any

    def __add__(self, other: Vec3) -> Vec3:  # type: ignore[override]
        return Vec3(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: Vec3) -> Vec3:
        return Vec3(self.x - other.x, self.y - other.y, self.z - other.z)

    def __neg__(self) -> Vec3:
        return Vec3(-self.x, -self.y, -self.z)

    def __mul__(self, scalar: Any) -> Vec3:  # type: ignore[override]
        return Vec3(self.x * scalar, self.y * scalar, self.z * scalar)

    __rmul__ = __mul__  # type: ignore[assignment]

    def __truediv__(self, scalar: Any) -> Vec3:
        return Vec3(self.x / scalar, self.y / scalar, self.z / scalar)

    def map(self, function: Any) -> Vec3:
        """Applies `function` to each component."""
        return Vec3(function(self.x), function(self.y), function(self.z))


def dot(a: Vec3, b: Vec3) -> Any:
    """Inner product."""
    return a.x * b.x + a.y * b.y + a.z * b.z


def cross(a: Vec3, b: Vec3) -> Vec3:
    """Right-handed vector product."""
    return Vec3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


def multiply(a: Vec3, b: Vec3) -> Vec3:
    """Componentwise product."""
    return Vec3(a.x * b.x, a.y * b.y, a.z * b.z)


def norm(a: Vec3) -> Any:
    """Euclidean length; derivative 0 at the zero vector."""
    return safe_sqrt(dot(a, a))


def normalize(a: Vec3) -> Vec3:
    """Unit vector along `a`; the zero vector, with zero derivative, where `a` is zero."""
    inverse = safe_divide(jnp.ones_like(a.x), norm(a))
    return a * inverse


def where(condition: Any, a: Vec3, b: Vec3) -> Vec3:
    """Componentwise selection."""
    return Vec3(jnp.where(condition, a.x, b.x), jnp.where(condition, a.y, b.y), jnp.where(condition, a.z, b.z))


def tangent_basis(normal: Vec3) -> tuple[Vec3, Vec3]:
    """Two unit vectors that complete a unit `normal` to a right-handed frame, without branching.

    Orthogonal to the normal by the terms themselves, so that a normal whose length is 1 to round-off only brings nothing of
    what goes along it into the tangents: a column of aligned bodies stays aligned to the last bit.

    Source: T. Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017, with ``1 - x^2`` and ``1 - y^2``
    written by the other two components.
    """
    sign = jnp.where(normal.z >= 0, 1.0, -1.0).astype(normal.z.dtype)
    a = -1.0 / (sign + normal.z)
    b = normal.x * normal.y * a
    return (
        Vec3(sign * (normal.z - normal.y * normal.y * a), sign * b, -sign * normal.x),
        Vec3(b, normal.z - normal.x * normal.x * a, -normal.y),
    )


class Mat3(NamedTuple):
    """3x3 matrix by columns: ``column_x`` is the image of the x axis."""

    column_x: Vec3
    column_y: Vec3
    column_z: Vec3

    def apply(self, v: Vec3) -> Vec3:
        """Matrix times vector (body to world for a rotation)."""
        return self.column_x * v.x + self.column_y * v.y + self.column_z * v.z

    def apply_transposed(self, v: Vec3) -> Vec3:
        """Transposed matrix times vector (world to body for a rotation)."""
        return Vec3(dot(self.column_x, v), dot(self.column_y, v), dot(self.column_z, v))
