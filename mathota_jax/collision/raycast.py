"""Rays through a scene."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.batching import batch_last
from mathota_jax.bodies import unpack
from mathota_jax.collision.placement import shape_parameters, shape_poses
from mathota_jax.collision.ray_frame import RayHit, far
from mathota_jax.collision.rays import RAYS
from mathota_jax.model import Model
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import settle_code
from mathota_jax.spatial.vector import Vec3, normalize
from mathota_jax.state import State
from mathota_jax.struct import pytree


@pytree
class Raycast:
    """What a ray meets first.

    Attributes:
      hit: () whether it meets anything within its reach.
      distance: () [m] to the surface; `max_distance` if there is no hit.
      body: () handle of the body, -1 if there is no hit.
      normal: (3,) outward unit normal of the surface, world frame; zero if there is no hit.
    """

    hit: Array
    distance: Array
    body: Array
    normal: Array


def raycast(
    model: Model, state: State, origin: Array, direction: Array, max_distance: Array | float = np.inf
) -> Raycast:
    """First surface on a ray (guide 7: ray against every shape in closed form).

    A ray that starts inside a solid does not see that solid, so that a sensor may sit in its body. Bodies that do not
    collide are seen like others. For many rays or worlds: `jax.vmap`.

    Args:
      model: parameters and static scene.
      state: state of one world.
      origin: (3,) start of the ray [m], world frame.
      direction: (3,) any length but zero, which meets nothing.
      max_distance: reach of the ray [m].

    Returns:
      The first hit. Differentiable in origin, direction, poses and sizes, except where the ray grazes a surface or the
      surface met changes; finite everywhere, with zero derivatives of the distance to those where nothing is met.

    Raises:
      ValueError: `origin` or `direction` is not a vector of three components, `max_distance` is not one number, or the
        state is that of another scene.
    """
    dtype = state.position.dtype
    origin, direction, max_distance = (jnp.asarray(value, dtype) for value in (origin, direction, max_distance))
    for name, value in (("origin", origin), ("direction", direction)):
        if value.shape != (3,):
            raise ValueError(f"raycast: {name} must have shape (3,), got {value.shape}; use jax.vmap for several rays")
    if max_distance.shape:
        raise ValueError(f"raycast: max_distance must be one number, got shape {max_distance.shape}; use jax.vmap")
    if state.position.shape != (model.scene.body_count, 3):
        raise ValueError(
            f"raycast: state.position must have shape ({model.scene.body_count}, 3) for this model, "
            f"got {state.position.shape}"
        )
    return _raycast(model, state, origin, direction, max_distance)


@batch_last
def _raycast(model: Model, state: State, origin: Array, direction: Array, max_distance: Array) -> Raycast:
    scene, bodies = model.scene, unpack(state)
    start, heading = (Vec3(*(value[axis][None] for axis in range(3))) for value in (origin, direction))
    # Of a length whose square is a number.
    largest = lax.stop_gradient(functools.reduce(jnp.maximum, heading.map(jnp.abs)))
    heading = normalize(heading * safe_divide(jnp.ones_like(largest), largest))
    worlds = np.broadcast_shapes(*(value.shape[-1:] for value in (state.position, origin, direction, max_distance)))
    found: list[RayHit] = []
    owners: list[int] = []
    for kind in dict.fromkeys(entry.kind for entry in scene.shapes):
        rows, owner = zip(*((entry.index, entry.body) for entry in scene.shapes if entry.kind == kind), strict=True)
        pose = shape_poses(model.shapes, kind, rows, owner, bodies.position, bodies.orientation)
        entry = RAYS[kind](shape_parameters(scene, model.shapes, kind, rows), pose, start, heading)
        full = (len(rows), *worlds)
        found.append(jax.tree.map(lambda value, full=full: jnp.broadcast_to(value, full), entry))
        owners += owner
    distance, surface, hit = jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)
    seen = hit & (distance <= max_distance)
    key = jnp.where(seen, distance, far(distance))
    nearest = settle_code(jnp.where(seen.any(0), key.argmin(0).astype(distance.dtype), -1.0))
    chosen = np.arange(len(owners))[:, None] == nearest
    hit = nearest >= 0
    return Raycast(
        hit,
        jnp.where(hit, jnp.where(chosen, distance, 0.0).sum(0), max_distance),
        jnp.where(hit, jnp.asarray(owners, jnp.int32)[jnp.maximum(nearest, 0)], -1),
        jnp.stack([jnp.where(chosen, component, 0.0).sum(0) for component in surface]),
    )
