"""Unit quaternions ``(w, x, y, z)``, world from body, components in separate arrays."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Mat3, Vec3, cross, dot


class Quaternion(NamedTuple):
    """Quaternion with scalar part first."""

    w: Any
    x: Any
    y: Any
    z: Any


def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product: the rotation `q` followed by the rotation `p` (guide 1.2)."""
    return Quaternion(
        p.w * q.w - p.x * q.x - p.y * q.y - p.z * q.z,
        p.w * q.x + p.x * q.w + p.y * q.z - p.z * q.y,
        p.w * q.y - p.x * q.z + p.y * q.w + p.z * q.x,
        p.w * q.z + p.x * q.y - p.y * q.x + p.z * q.w,
    )


def rotate(q: Quaternion, v: Vec3) -> Vec3:
    """The vector turned by a unit quaternion."""
    axis = Vec3(q.x, q.y, q.z)
    twice = cross(axis, v) * 2.0
    return v + twice * q.w + cross(axis, twice)


@jax.custom_jvp
def normalize(q: Quaternion) -> Quaternion:
    """Projects back to the unit sphere. Undefined (NaN) for the zero quaternion, which the flags report."""
    return _scaled(q, _inverse_length(q))


@normalize.defjvp
def _normalize_jvp(primals: tuple[Quaternion], tangents: tuple[Quaternion]) -> tuple[Quaternion, Quaternion]:
    # In terms of the result: the derivatives of root and quotient would each store quotients of their own.
    (q,), (change,) = primals, tangents
    inverse = _inverse_length(q)
    unit = _scaled(q, inverse)
    along = _inner(unit, change)
    across = Quaternion(*(c - u * along for c, u in zip(change, unit, strict=True)))
    return unit, _scaled(across, inverse)


def _inverse_length(q: Quaternion) -> Any:
    return 1.0 / jnp.sqrt(_inner(q, q))


def _inner(p: Quaternion, q: Quaternion) -> Any:
    return p.w * q.w + p.x * q.x + p.y * q.y + p.z * q.z


def _scaled(q: Quaternion, factor: Any) -> Quaternion:
    return Quaternion(q.w * factor, q.x * factor, q.y * factor, q.z * factor)


def to_matrix(q: Quaternion) -> Mat3:
    """Rotation matrix of a quaternion (guide 1.2), orthogonal to round-off whatever its length.

    A stored unit quaternion is off by round-off, always to the same side for hours: taken as exact, its matrix shrinks
    what it turns a little, and the angular momentum with it (measured: 1.2e-4 in 1000 steps in float32).
    """
    twice = 2.0 / _inner(q, q)
    x2, y2, z2 = q.x * twice, q.y * twice, q.z * twice
    wx, wy, wz = q.w * x2, q.w * y2, q.w * z2
    xx, xy, xz = q.x * x2, q.x * y2, q.x * z2
    yy, yz, zz = q.y * y2, q.y * z2, q.z * z2
    return Mat3(
        Vec3(1.0 - (yy + zz), xy + wz, xz - wy),
        Vec3(xy - wz, 1.0 - (xx + zz), yz + wx),
        Vec3(xz + wy, yz - wx, 1.0 - (xx + yy)),
    )


def exponential(rotation_vector: Vec3) -> Quaternion:
    """Quaternion of a rotation vector [rad]; smooth at zero."""
    quarter = 0.25 * dot(rotation_vector, rotation_vector)
    # Each serves several components; trigonometry is worth doing once.
    cosine, scale = compute_once(_cosine_and_scale(quarter), quarter)
    return Quaternion(cosine, rotation_vector.x * scale, rotation_vector.y * scale, rotation_vector.z * scale)


@jax.custom_jvp
def _cosine_and_scale(squared: Any) -> tuple[Any, Any]:
    """``cos(t)`` and ``sin(t) / (2 t)`` of half an angle t, from its square.

    Below 1e-6 their series are exact to float64 round-off.
    """
    small = squared < 1e-6
    half = jnp.sqrt(jnp.where(small, 1.0, squared))
    scale = jnp.where(small, 0.5 - squared * (1.0 / 12.0 - squared / 240.0), 0.5 * (jnp.sin(half) / half))
    return jnp.where(small, 1.0 - squared * (0.5 - squared / 24.0), jnp.cos(half)), scale


@_cosine_and_scale.defjvp
def _cosine_and_scale_jvp(primals: tuple[Any], tangents: tuple[Any]) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    # Of the values themselves, where they do not cancel: below, the series is exact to float64 round-off as well.
    (squared,), (change,) = primals, tangents
    cosine, scale = _cosine_and_scale(squared)
    small = squared < 1e-2
    series = 1.0 / 12.0 - squared * (1.0 / 120.0 - squared * (1.0 / 3360.0 - squared / 181440.0))
    slope = jnp.where(small, -series, 0.25 * (cosine - 2.0 * scale) / jnp.where(small, 1.0, squared))
    return (cosine, scale), (-scale * change, slope * change)


def logarithm(q: Quaternion) -> Vec3:
    """Rotation vector of a unit quaternion, the short way round; smooth at no rotation."""
    sign = jnp.where(q.w < 0, -1.0, 1.0)
    axis = Vec3(q.x * sign, q.y * sign, q.z * sign)
    sine = safe_sqrt(dot(axis, axis))
    # Below, the quotient is 2 to the round-off of either precision.
    small = sine < jnp.sqrt(jnp.finfo(sine.dtype).eps)
    angle = 2.0 * jnp.arctan2(jnp.where(small, 1.0, sine), q.w * sign)
    return axis * jnp.where(small, 2.0, safe_divide(angle, jnp.where(small, 1.0, sine)))


def turn_between(first: Quaternion, second: Quaternion) -> Vec3:
    """Rotation vector, in the world frame, that turns the first orientation into the second the short way round."""
    return logarithm(multiply(second, Quaternion(first.w, -first.x, -first.y, -first.z)))
