"""Which approaches are impacts, and which are those of bodies that rest on each other."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

TOUCHING = 1e-3
"""Gap at which bodies touch that do not move relative to each other, as a share of the inner radius of the smaller one;
and height, as the same share, that a rebound must reach to be one."""

MEETS = 4.0
"""Gap, in tolerances of the search for a touch, up to which bodies meet at the time of an impact."""

ROUND_OFF = 64
"""Multiples of the machine epsilon, of the velocities at play, within which an approach is round-off."""


def tolerance(dtype: jnp.dtype) -> float:
    """Gap at which the search for a touch ends, as a share of the inner radius; a Newton step takes it to round-off."""
    return float(jnp.finfo(dtype).eps) ** 0.5


def meet(gap: Array, size: Array) -> Array:
    """Whether bodies with that inner radius of the smaller one, and that gap, meet at the time of an impact."""
    return gap <= MEETS * tolerance(gap.dtype) * size


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


def next_touch(gap: Array, rate: Array, bend: Array, near: Array | float = 0.0) -> tuple[Array, Array]:
    """First time after now at which ``gap + rate t + bend t^2 / 2`` is 0, or is so again for a point that leaves now.

    Returns:
      The time, infinite where there is none, and the speed then.
    """
    gap = jnp.where((gap <= near) & (rate > 0), 0.0, jnp.maximum(gap, 0.0))
    discriminant = rate * rate - 2.0 * bend * gap
    speed = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    divisor = speed - rate
    down = jnp.where(divisor > 0, 2.0 * gap / jnp.where(divisor > 0, divisor, 1.0), jnp.inf)
    falls = bend < 0
    up = jnp.where(falls, (rate + speed) / jnp.where(falls, -bend, 1.0), jnp.inf)
    return jnp.where(discriminant < 0, jnp.inf, jnp.where(rate > 0, up, down)), speed
