"""Which approaches are impacts, and which are those of bodies that rest on each other."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

TOUCHING = 1e-3
"""Gap at which bodies touch that do not move relative to each other, as a share of the inner radius of the smaller one;
and height, as the same share, that a rebound must reach to be one."""

ROUND_OFF = 64
"""Multiples of the machine epsilon, of the velocities at play, within which an approach is round-off."""


def rest_speed(gravity: Array, dt: Array, size: Array, scale: Array) -> Array:
    """Speed of a rebound, (pair, world), up to which bodies rest on each other.

    So fast a body leaves neither for a step nor by more than `TOUCHING` in the gravity of the scene. Without gravity
    nothing rests; round-off remains. No derivative.

    Args:
      gravity: magnitude, (1, world) [m/s^2].
      dt: whole time step.
      size: inner radius of the smaller moving body.
      scale: sum of the speeds of both, whose difference the approach is.
    """
    rises = jnp.minimum(gravity * dt, jnp.sqrt(2.0 * gravity * TOUCHING * size))
    return jax.lax.stop_gradient(jnp.maximum(rises, ROUND_OFF * jnp.finfo(scale.dtype).eps * scale))
