"""Four points of a circular rim, one of them the farthest in a given direction."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.candidates import depth_lean
from mathota_jax.spatial.safe import safe_sqrt
from mathota_jax.spatial.settle import settle_code


class RimPoints(NamedTuple):
    """Directions from the axis (local Y) to four rim points a quarter turn apart, as components along local x and z.

    Attributes:
        x, z: of the farthest point, its opposite, and the two between (one on each side).
        quadrant: int32 of each: the nearest of +x, +z, -x, -z. It names the point from step to step.
    """

    x: tuple[Array, Array, Array, Array]
    z: tuple[Array, Array, Array, Array]
    quadrant: tuple[Array, Array, Array, Array]


def rim_points(toward_x: Array, toward_z: Array) -> RimPoints:
    """Rim points for the direction whose lateral components in units of its length are given.

    As a set the four move continuously with the direction: where the farthest one changes its quadrant the square
    takes the same place a quarter turn on. A direction along the axis has no farthest point; its tremor must not spin
    the contacts of a resting cylinder. So below a lateral share of `depth_lean` the square turns back to the axes, which
    costs the farthest point 0.08 of that share of the radius, and bounds the derivative.
    """
    x, z = lax.stop_gradient((toward_x, toward_z))
    along_x = jnp.abs(x) >= jnp.abs(z)
    quadrant = settle_code(jnp.where(along_x, jnp.where(x >= 0, 0.0, 2.0), jnp.where(z >= 0, 1.0, 3.0)).astype(x.dtype))
    # Components along the quadrant's own direction and the next one.
    cosine, sine = _turn(quadrant, x.dtype)
    minor = toward_z * cosine - toward_x * sine
    fade = depth_lean(x.dtype)
    squared = toward_x * toward_x + toward_z * toward_z
    across = minor * safe_sqrt(squared) / (squared + fade * fade)
    along = jnp.sqrt(1.0 - across * across)  # `across` is at most sin 45 deg
    far_x, far_z = along * cosine - across * sine, along * sine + across * cosine
    return RimPoints(
        (far_x, -far_x, -far_z, far_z),
        (far_z, -far_z, far_x, -far_x),
        (quadrant, (quadrant + 2) & 3, (quadrant + 1) & 3, (quadrant + 3) & 3),
    )


def _turn(quadrant: Array, number: Any) -> tuple[Array, Array]:
    """Cosine and sine of a number of quarter turns."""
    cosine = jnp.where(quadrant == 0, 1.0, jnp.where(quadrant == 2, -1.0, 0.0)).astype(number)
    sine = jnp.where(quadrant == 1, 1.0, jnp.where(quadrant == 3, -1.0, 0.0)).astype(number)
    return cosine, sine
