"""Which bodies fly past each other: the spheres about them do not meet on their way."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from mathota_jax.bodies import Bodies, of_all_bodies
from mathota_jax.collision.placement import shape_parameters
from mathota_jax.geometry.bounds import bounding_radius
from mathota_jax.model import Model
from mathota_jax.scene import PairGroup
from mathota_jax.spatial.indexing import take, unstack
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.vector import Vec3, dot, norm


def misses(model: Model, bodies: Bodies, now: Array, then: Array, left: Array) -> Array:
    """(slot, world) whether the bounding spheres of a pair of bodies stay apart; of contacts that have slots of their own.

    Under a constant acceleration a path keeps within ``|a| t^2 / 8`` of its chord.

    Args:
      model: parameters and static scene.
      bodies: all of them.
      now, then: (component, block, world) velocities now and after the time `left` without constraints.
      left: (1, world) time [s].
    """
    scene = model.scene
    mean, change = (Vec3(*unstack(part[:3], 0)) for part in (0.5 * (now + then), then - now))
    path, bend = of_all_bodies(scene, mean * left), of_all_bodies(scene, change * (0.125 * left))
    found = []
    for group in scene.pair_groups:
        (from_a, path_a, bend_a), (from_b, path_b, bend_b) = (
            take((bodies.position, path, bend), side) for side in (group.bodies_a, group.bodies_b)
        )
        start, way = from_b - from_a, path_b - path_a
        share = jnp.clip(safe_divide(-dot(start, way), dot(way, way)), 0.0, 1.0)
        distance = norm(start + way * share) - norm(bend_b - bend_a)
        apart = distance > _reach(model, group)
        found.append(jnp.repeat(apart, group.point_count, axis=0))
    return jnp.concatenate(found)


def _reach(model: Model, group: PairGroup) -> Array:
    """(pair or 1, world) sum of the radii about the centres of mass that hold the shapes of a pair."""
    total = jnp.zeros((1, 1), model.size.dtype)
    for kind, rows in ((group.kind_a, group.shapes_a), (group.kind_b, group.shapes_b)):
        total = total + bounding_radius(kind, shape_parameters(model.scene, model.shapes, kind, rows))
        local = model.shapes[kind].get("local_position")
        if local is not None:
            total = total + norm(Vec3(*unstack(take(local, rows), 1)))
    return total
