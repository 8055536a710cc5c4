"""Bounding volumes of shapes, half-spaces of planes, and whether they overlap (guide 5.1 to 5.3)."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.spatial.indexing import gather
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Vec3, dot

SPHERE_MARGIN = 1e-4
"""Relative growth of bounding spheres, so that round-off never parts spheres that touch (float32 has 1e-7)."""


class Planes(NamedTuple):
    """Solid half-spaces ``normal . x <= offset``: components of shape ``(plane, world)``."""

    normal: Vec3
    offset: Array


class Bounds(NamedTuple):
    """Bounding volumes of shapes; components of shape ``(shape, world)``.

    Attributes:
      low, high: corners of the axis-aligned boxes [m] (guide 5.1).
      center, radius: bounding spheres [m] (guide 5.3).
      planes: of the first shapes, which have no bounds (any number that is not finite); None if there are none.
    """

    low: Vec3
    high: Vec3
    center: Vec3
    radius: Array
    planes: Planes | None = None

    @property
    def plane_count(self) -> int:
        """How many of the shapes are planes."""
        return 0 if self.planes is None else self.planes.offset.shape[0]


def finite_bounds(bounds: Bounds) -> tuple[Bounds, Array]:
    """Bounds without derivative, evaluated once, those of bad shapes turned inside out; and which shapes are bad.

    Every method decides by comparing these numbers: were they computed again in each kernel, with other roundings, one
    pair could come out both ways.
    """
    low, high, center, radius, planes = jax.lax.stop_gradient(bounds)
    worlds = max(component.shape[-1] for component in (*low, *high, *center, radius))
    count = low.x.shape[0]
    low, high, center, radius = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (count, worlds)), (low, high, center, radius)
    )
    finite = functools.reduce(jnp.logical_and, [jnp.isfinite(x) for x in (*low, *high, *center, radius)])
    largest = float(jnp.finfo(radius.dtype).max)
    low, high = low.map(lambda x: jnp.where(finite, x, largest)), high.map(lambda x: jnp.where(finite, x, -largest))
    center, radius = center.map(lambda x: jnp.where(finite, x, 0.0)), jnp.where(finite, radius, 0.0)
    return Bounds(*compute_once((low, high, center, radius), radius), planes), ~finite


def overlaps(bounds: Bounds, first: Array, second: Array) -> tuple[Array, Array]:
    """Whether boxes and spheres overlap (guide 5.2 and 5.3), and by how much the boxes do along the best axis [m]."""
    depth = None
    for low, high in zip(bounds.low, bounds.high, strict=True):
        top = jnp.minimum(gather(high, first), gather(high, second))
        along = top - jnp.maximum(gather(low, first), gather(low, second))
        depth = along if depth is None else jnp.minimum(depth, along)
    assert depth is not None
    squared = jnp.zeros(())
    for center in bounds.center:
        between = gather(center, second) - gather(center, first)
        squared = squared + between * between
    reach = (gather(bounds.radius, first) + gather(bounds.radius, second)) * (1.0 + SPHERE_MARGIN)
    # A subtraction is negative, zero or positive exactly when the comparison says so.
    return (depth >= 0) & (squared <= reach * reach), depth


def plane_overlaps(bounds: Bounds) -> Array:
    """(plane, shape, world) how far the boxes, or the spheres if that is less, reach below the planes [m].

    Negative if they do not; anything for the planes themselves.
    """
    assert bounds.planes is not None
    normal, offset = bounds.planes.normal.map(lambda n: n[:, None]), bounds.planes.offset[:, None]
    sides = list(zip(normal, bounds.low, bounds.high, strict=True))
    box = functools.reduce(jnp.add, [jnp.minimum(n * low, n * high) for n, low, high in sides])
    return offset - jnp.maximum(box, dot(normal, bounds.center) - bounds.radius * (1.0 + SPHERE_MARGIN))
