"""Bounding volumes of shapes, half-spaces of planes, and whether they overlap (guide 5.1 to 5.3)."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.spatial.indexing import gather_together
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


def stored_bounds(bounds: Bounds) -> tuple[Bounds, Array]:
    """Bounds without derivative, evaluated once; and which shapes are bad, those of whose bounds some are not finite.

    Every method decides by comparing these numbers: were they computed again in each kernel, with other roundings, one
    pair could come out both ways. What is infinite becomes NaN, so that bad shapes pass no test of `overlaps`.
    """
    low, high, center, radius, planes = jax.lax.stop_gradient(bounds)
    volumes = (low, high, center, radius)
    worlds = max(component.shape[-1] for component in jax.tree.leaves(volumes))
    volumes = jax.tree.map(lambda x: jnp.broadcast_to(x, (low.x.shape[0], worlds)), volumes)
    low, high, center, radius = compute_once(volumes, volumes[-1])
    finite = functools.reduce(jnp.logical_and, [jnp.isfinite(x) for x in (*low, *high, *center, radius)])
    return Bounds(low, high, center, radius, planes), ~finite


def finite_bounds(bounds: Bounds) -> tuple[Bounds, Array]:
    """`stored_bounds`, those of bad shapes turned inside out."""
    (low, high, center, radius, planes), bad = stored_bounds(bounds)
    finite = ~bad
    largest = float(jnp.finfo(radius.dtype).max)
    low, high = low.map(lambda x: jnp.where(finite, x, largest)), high.map(lambda x: jnp.where(finite, x, -largest))
    center, radius = center.map(lambda x: jnp.where(finite, x, 0.0)), jnp.where(finite, radius, 0.0)
    return Bounds(low, high, center, radius, planes), bad


def overlaps(bounds: Bounds, first: Array, second: Array) -> tuple[Array, Array]:
    """`overlap` of pairs of shapes, given by index."""
    volumes = bounds._replace(planes=None)
    return overlap(gather_together(volumes, first), gather_together(volumes, second))


def overlap(one: Bounds, other: Bounds) -> tuple[Array, Array]:
    """Whether boxes and spheres overlap (guide 5.2 and 5.3), and by how much the boxes do along the best axis [m]."""
    top, bottom = jax.tree.map(jnp.minimum, one.high, other.high), jax.tree.map(jnp.maximum, one.low, other.low)
    along = top - bottom
    depth = jnp.minimum(jnp.minimum(along.x, along.y), along.z)
    between = other.center - one.center
    squared = dot(between, between)
    reach = (one.radius + other.radius) * (1.0 + SPHERE_MARGIN)
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
