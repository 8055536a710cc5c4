"""What all rays share: the ray seen from a shape, the answer, and the interval between two parallel planes."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import Vec3, dot

PARALLEL = 1e-15
"""Sine of the angle to a face below which a ray counts as parallel to it."""


class RayHit(NamedTuple):
    """Entry of a ray into each shape, components of shape (shape, world).

    Attributes:
        distance: [m] along the unit direction; finite and meaningless for a miss.
        normal: outward unit normal, world frame; zero for a miss.
        hit: bool.
    """

    distance: Array
    normal: Vec3
    hit: Array


class LocalRay(NamedTuple):
    """Ray in the frame of a shape: `origin` is its point nearest to the shape's origin, `begin` where it starts."""

    origin: Vec3
    direction: Vec3
    begin: Array


def local_ray(pose: Pose, origin: Vec3, direction: Vec3) -> LocalRay:
    """The ray seen from a shape."""
    if pose.rotation is None:
        start, heading = origin - pose.position, direction
    else:
        start, heading = pose.point_to_local(origin), pose.rotation.apply_transposed(direction)
    begin = dot(start, heading)
    return LocalRay(start - heading * begin, heading, begin)


def far(like: Array) -> Array:
    """A length beyond all others whose square is finite."""
    return jnp.asarray(0.25 * np.sqrt(float(jnp.finfo(like.dtype).max)), like.dtype)


def slab(start: Array, slope: Array, half: Any) -> tuple[Array, Array]:
    """Interval of the parameter in which ``|start + t slope| <= half``; empty (enter > leave) for a miss."""
    parallel = jnp.abs(slope) < PARALLEL
    inverse = 1.0 / jnp.where(parallel, 1.0, slope)
    middle, reach = -start * inverse, half * jnp.abs(inverse)
    always = jnp.where(jnp.abs(start) <= half, far(start), -far(start))
    return jnp.where(parallel, -always, middle - reach), jnp.where(parallel, always, middle + reach)


def hit_at(pose: Pose, ray: LocalRay, code: Array, parameter: Array, normal: Vec3) -> RayHit:
    """The answer in the world frame from the parameter and the normal in the shape's; code -1 is a miss."""
    world = normal if pose.rotation is None else pose.rotation.apply(normal)
    return RayHit(jnp.where(code >= 0, parameter - ray.begin, 0.0), world, code >= 0)
