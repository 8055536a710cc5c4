"""Walls of a heightfield: below its border the solid ends in four vertical planes."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.collision.candidates import best_candidate, pick
from mathota_jax.collision.convex.support import SUPPORT
from mathota_jax.collision.height_grid import SEAM, Window, ground_at, height_over
from mathota_jax.spatial.settle import settle
from mathota_jax.spatial.vector import Mat3, Vec3, dot

LEVEL = 0.02
"""A body whose lowest point is level with the border, to this share of its size, meets no wall: it slides from the ground
beside onto the field, and is lifted over what is in its way."""
DOWNWARD = 1e-3
"""Slope by which the point nearest to a wall is looked for downwards: of a face along the wall, its lower end."""

AWAY = np.asarray([(-1, 1, 0, 0, 0), (0, 0, 0, 0, 1), (0, 0, -1, 1, 0)])
"""Normals (axis, direction) of the walls and of level ground."""


class Wall(NamedTuple):
    """The wall that parts a body best from the field, in the frame of the field from the body's centre on.

    Attributes:
        number: 0 to 3; that of the wall at -x, +x, -z, +z.
        up: horizontal unit normal out of the solid.
        offset: [m] of the plane along it.
        way: [m] by which the body is inside of it, 0 where it is not.
        level: whether the lowest point of the body is level with the ground there, or with the border.
        beside: whether it is the wall that the body meets: it is under the border there and no way up is shorter.
    """

    number: Array
    up: Vec3
    offset: Array
    way: Array
    level: Array
    beside: Array


def nearest_wall(kind: str, a: dict[str, Any], rotation: Mat3, window: Window, size: Array) -> Wall:
    """The wall next to a body of a kind, turned so and of that size [m]."""
    x, y, z = (jnp.asarray(side, size.dtype).reshape(-1, 1, 1) + jnp.zeros_like(size) for side in AWAY)
    out = Vec3(x, y, z)
    known, turned = lax.stop_gradient((a, rotation))
    local = turned.apply_transposed(Vec3(-x, -y - DOWNWARD, -z))
    point = turned.apply(SUPPORT[kind].point(known, SUPPORT[kind].code(known, local), local))
    up = out.map(lambda c: c[:-1])
    half_x, half_z = _halves(window)
    offset = jnp.abs(up.x) * half_x + jnp.abs(up.z) * half_z - dot(up, window.center)
    gap, number = best_candidate(dot(up, point.map(lambda c: c[:-1])) - offset)
    up, offset = pick((up, offset), number)
    nearest, lowest = pick(point, number), point.map(lambda c: c[-1])
    way = jnp.maximum(-gap, 0.0)
    fall = depth_under(window, lowest)
    inflation = SUPPORT[kind].inflation
    if inflation is not None:
        way, fall = jnp.maximum(inflation(known) - gap, 0.0), fall + inflation(known)
    step = LEVEL * size
    code = jnp.where(jnp.abs(fall) <= step, 1.0, 0.0)
    code = jnp.where((fall > step) & (fall > way) & (depth_under(window, nearest) > 0), 2.0, code)
    code = settle(code)
    return Wall(number, up, offset, way, (code > 0.5) & (code < 1.5), code > 1.5)


def depth_under(window: Window, point: Vec3) -> Array:
    """How far [m] points (..., pair, world) are under the ground, those beside the field under its border."""
    point, center = lax.stop_gradient((point, window.center))
    held = [
        jnp.clip(p + c, -half, half) - c
        for p, c, half in zip((point.x, point.z), (center.x, center.z), _halves(window), strict=True)
    ]
    point = Vec3(held[0], point.y, held[1])
    ground = ground_at(window, point)
    return -height_over(ground.normal, ground.corner, point) / ground.normal.y


def inside_border(window: Window, point: Vec3) -> Array:
    """How far [m] points (..., pair, world) are from the nearest wall, seen from above; negative beside the field."""
    half_x, half_z = _halves(window)
    return jnp.minimum(half_x - jnp.abs(point.x + window.center.x), half_z - jnp.abs(point.z + window.center.z))


def along_wall(window: Window, point: Vec3) -> Array:
    """Whether points on a wall (..., pair, world) are between its two ends."""
    return inside_border(window, point) >= -SEAM * window.field["cell_size"]


def _halves(window: Window) -> tuple[Array, Array]:
    """Half the extent [m] of the field along x and z."""
    rows, columns = window.field["heights"].shape[:2]
    return 0.5 * (rows - 1) * window.field["cell_size"], 0.5 * (columns - 1) * window.field["cell_size"]
