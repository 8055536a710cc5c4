"""Which bodies fly past each other: the spheres about them do not meet on their way.

What joints make of the way is not known beforehand: rows of contacts of jointed bodies rely on none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import Bodies, of_all_bodies
from mathota_jax.collision.placement import shape_parameters
from mathota_jax.geometry.bounds import bounding_radius
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.spatial.indexing import take, unstack
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.vector import Vec3, dot, norm


class Way(NamedTuple):
    """What bodies may do in some time if nothing stops them; components (body, world) [m].

    Attributes:
      start: centres of mass.
      path: displacement.
      bend: by how much the way may depart from its chord: under a constant acceleration by ``|a| t^2 / 8``.
    """

    start: Vec3
    path: Vec3
    bend: Vec3


def ways(scene: Scene, bodies: Bodies, now: Array, then: Array, left: Array) -> Way:
    """Of all bodies, without derivative.

    Args:
      scene: static structure.
      bodies: all of them.
      now, then: (component, block, world) velocities now and after the time `left` without constraints.
      left: (1, world) time [s].
    """
    bodies, now, then, left = lax.stop_gradient((bodies, now, then, left))
    mean, change = (Vec3(*unstack(part[:3], 0)) for part in (0.5 * (now + then), then - now))
    path, bend = of_all_bodies(scene, mean * left), of_all_bodies(scene, change * (0.125 * left))
    return Way(bodies.position, path, bend)


def stay_apart(a: Way, b: Way, reach: Array) -> Array:
    """Whether bodies that reach so far from their centres of mass, together, do not meet, however they turn."""
    start, path = b.start - a.start, b.path - a.path
    share = jnp.clip(safe_divide(-dot(start, path), dot(path, path)), 0.0, 1.0)
    return norm(start + path * share) - norm(b.bend - a.bend) > reach


def misses(model: Model, way: Way) -> Array | None:
    """(slot, world) which pairs of bodies with slots of their own stay apart; None where all are with planes."""
    worlds, found = way.path.x.shape[-1], []
    if all("plane" in (group.kind_a, group.kind_b) for group in model.scene.pair_groups):
        return None
    for group in model.scene.pair_groups:
        if "plane" in (group.kind_a, group.kind_b):
            found.append(jnp.zeros((group.slot_count, worlds), bool))
            continue
        a, b = (take(way, side) for side in (group.bodies_a, group.bodies_b))
        reach = shape_reach(model, group.kind_a, group.shapes_a) + shape_reach(model, group.kind_b, group.shapes_b)
        found.append(jnp.repeat(stay_apart(a, b, reach), group.point_count, axis=0))
    return jnp.concatenate(found)


def free_pairs(scene: Scene) -> np.ndarray:
    """(slot, 1) which pairs of bodies with slots of their own have no joints."""
    return np.asarray([[scene.jointed.isdisjoint(pair)] for pair in zip(*scene.slot_bodies, strict=True)])


def shape_reach(model: Model, kind: str, rows: Sequence[int]) -> Array:
    """(row, world or 1) radii of the spheres about the centres of mass that hold the shapes, without derivative."""
    shapes = lax.stop_gradient(model.shapes)
    reach = bounding_radius(kind, shape_parameters(model.scene, shapes, kind, rows))
    local = shapes[kind].get("local_position")
    return reach if local is None else reach + norm(Vec3(*unstack(take(local, rows), 1)))
