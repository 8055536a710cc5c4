"""Rotations of natural ``(..., 4)`` and ``(..., 3)`` arrays, JAX; quaternions (w, x, y, z)."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from mathota_jax.spatial import quaternion
from mathota_jax.spatial.quaternion import Quaternion
from mathota_jax.spatial.vector import Vec3


def _components(array: Any) -> list[Array]:
    return [array[..., k] for k in range(array.shape[-1])]


def turned(rotation_vector: Any, orientation: Any) -> Array:
    """Orientation after a rotation about the axes of the world; unit quaternions (..., 4)."""
    product = quaternion.multiply(
        quaternion.exponential(Vec3(*_components(rotation_vector))), Quaternion(*_components(orientation))
    )
    return jnp.stack(quaternion.normalize(product), -1)


def rotation_between(first: Any, second: Any) -> Array:
    """Rotation vector (..., 3) [rad] in the world frame that turns orientation `first` into `second`."""
    back = first * jnp.asarray([1.0, -1.0, -1.0, -1.0], first.dtype)
    turn = quaternion.multiply(Quaternion(*_components(second)), Quaternion(*_components(back)))
    return jnp.stack(quaternion.logarithm(turn), -1)
