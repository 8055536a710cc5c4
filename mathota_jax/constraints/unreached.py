"""What contacts foresee wrongly, since points go straight on in their rows.

In truth a body that spins in place comes no closer than it reaches, and bodies that pass each other do not meet. As much of
the way as they will not go is added to the gap: then nothing holds off what comes no nearer by itself, and whatever else
pushes the two together still finds that they stop each other.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.scene import Scene


class Turns(NamedTuple):
    """How contacts come closer by turning alone, (column, world).

    Attributes:
      start, free: normal velocities by the spins at the start and, unconstrained, at the end of the step.
      most: [m] by how much, if the bodies turn about their centres until the points lie farthest towards each other.
    """

    start: Array
    free: Array
    most: Array


def unreached(
    separation: Array, start: Array, free: Array, turns: Turns | None, apart: Array | None, dt: Array
) -> Array:
    """Way [m] along the normal (column, world) that points seem to go within the step, and will not.

    Args:
      separation: at the start; nothing is foreseen of what touches.
      start, free: normal velocities at the start and, unconstrained, at the end of the step.
      turns: the part of the spins; None where turning brings nothing closer.
      apart: whether the bodies do not meet in the step, however they turn; None where nobody asked.
      dt: time step.
    """
    way = jnp.zeros(())
    if turns is not None:
        # What turning may bring within reach is held off as if it were: seen a step later it would lie deep.
        shift = dt * jnp.minimum(_lesser_mean(start - turns.start, free - turns.free), 0.0)
        turn = -dt * _lesser_mean(turns.start, turns.free)
        way = jnp.where(separation + shift > turns.most, jnp.maximum(turn - turns.most, 0.0), 0.0)
    if apart is not None:
        # Nothing moves by it: it has no derivative.
        whole = lax.stop_gradient(-dt * _lesser_mean(start, free))
        way = jnp.where(apart & (separation < whole), jnp.maximum(way, whole), way)
    return jnp.where(separation > 0, way, 0.0)


def lone_spheres(scene: Scene) -> bool:
    """Whether every moving body with shapes is one sphere, which comes no closer when it turns."""
    shapes = [shape for shape in scene.shapes if not scene.static[shape.body]]
    return len({shape.body for shape in shapes}) == len(shapes) and {shape.kind for shape in shapes} <= {"sphere"}


def _lesser_mean(start: Array, free: Array) -> Array:
    """The lesser of the rates at the start and in the mean of a step."""
    return jnp.minimum(start, 0.5 * (start + free))
