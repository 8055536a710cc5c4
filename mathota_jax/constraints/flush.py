"""Static shapes that lie flush with what a body rests on: no obstacle to it.

A floor of boxes has edges inside. A body that slides towards one would run into it if its contact were taken alone: the
nearest point of the next box is that edge, and the way to it is not downwards. But what stays above a plane meets what lies
below all of it along the normal of the plane alone.

Meshes tell which edges are inside by their triangles; here shapes are told by where they are, so that a floor may be made of
any bodies.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.collision.convex.support import SUPPORT, support
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import settle
from mathota_jax.spatial.vector import Vec3, dot, where

FLUSH = 1e-3
"""Height above the plane, as a share of the inner radius of the body on it, up to which a shape is no obstacle."""

SINKING = 1e-2
"""As such a share, how far the body may come below the plane in the step, by its turning."""

SLANTED = 2e-5
"""One less the cosine of the angle between a contact's normal and that of the plane: 6 mrad, as uneven as floors may be."""


class Ground(NamedTuple):
    """The plane that each body rests on; components (body, world).

    Attributes:
      normal: unit vector towards the body; 0 for a body that rests on nothing.
      turned: the same as seen from the body, if it is turned back by what it turns in the step.
      center: centre of mass of the body.
      level: [m] of the plane above the centre, along the normal; mostly negative.
      rise: [m] of the centre in the step if the ground lets it come no closer.
      size: inner radius of the body [m].
    """

    normal: Vec3
    turned: Vec3
    center: Vec3
    level: Array
    rise: Array
    size: Array


class PlacedShape(NamedTuple):
    """Shapes of one kind in the world: sizes and poses, components (pair, world)."""

    kind: str
    sizes: dict[str, Any]
    pose: Pose


def may_be_flush(kind_a: str, kind_b: str) -> bool:
    """Whether the static one of two shapes of these kinds may lie flush with others: it ends on all sides."""
    return {kind_a, kind_b} <= set(SUPPORT)


def lies_flush(ground: Ground, a: PlacedShape, b: PlacedShape, a_is_static: Array | np.ndarray) -> Array:
    """(pair, world) whether the static shape of each pair is below the ground of the other's body, and that stays above.

    Args:
      ground: of the body that moves, components (pair, world).
      a, b: the shapes.
      a_is_static: (pair, world or 1) which of them does not move.
    """
    highest, lowest = [], []
    for shape, is_static in ((a, a_is_static), (b, ~a_is_static)):
        along = where(is_static, ground.normal, ground.turned)
        place, reach = dot(shape.pose.position - ground.center, along), _reach(shape, where(is_static, along, -along))
        highest.append(place + reach)
        lowest.append(place - reach)
    top = jnp.where(a_is_static, highest[0], highest[1]) - ground.level
    bottom = jnp.where(a_is_static, lowest[1], lowest[0]) + ground.rise - ground.level
    return (top <= FLUSH * ground.size) & (bottom >= -SINKING * ground.size)


def is_slanted(ground: Ground, normal: Vec3) -> Array:
    """Whether normals, of either sign, are not that of the ground; False where there is none."""
    rests = dot(ground.normal, ground.normal) > 0.5
    return rests & (jnp.abs(dot(normal, ground.normal)) < 1.0 - SLANTED)


def decide(flush: Array, dtype: Any) -> Array:
    """The decision, made once."""
    return settle(flush.astype(dtype)) > 0.5


def _reach(shape: PlacedShape, direction: Vec3) -> Array:
    """How far shapes reach from their origins along unit vectors in the world."""
    rotation = shape.pose.rotation
    local = direction if rotation is None else rotation.apply_transposed(direction)
    inflation = SUPPORT[shape.kind].inflation
    return dot(support(shape.kind, shape.sizes, local)[0], local) + (
        0.0 if inflation is None else inflation(shape.sizes)
    )
