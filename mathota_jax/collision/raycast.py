"""Rays through a scene."""

from __future__ import annotations

import collections
import functools
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.batching import batch_last
from mathota_jax.bodies import Bodies, unpack
from mathota_jax.collision.placement import shape_parameters, shape_poses
from mathota_jax.collision.ray_frame import RayHit, far
from mathota_jax.collision.rays import RAYS
from mathota_jax.geometry.bounds import bounding_radius
from mathota_jax.model import Model
from mathota_jax.scene import ShapeEntry
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import settle, settle_code
from mathota_jax.spatial.vector import Vec3, dot, normalize
from mathota_jax.state import State
from mathota_jax.struct import pytree

ROUND_OFF = 16.0
"""Of the place of a face of a part of a compound, in units of the last place of the coordinates and sizes."""


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

    A ray that starts inside a body does not see it until it has left it, so that a sensor may sit in its body: the parts
    of a compound are one solid, in which faces that lie inside another part, or against one, are none. Bodies that do
    not collide are seen like others. For many rays or worlds: `jax.vmap`.

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
    kinds = list(dict.fromkeys(entry.kind for entry in scene.shapes))
    shapes = sorted(scene.shapes, key=lambda entry: kinds.index(entry.kind))
    found: list[RayHit] = []
    for kind, rows, owners in _by_kind(shapes):
        sizes, pose = _placed(model, bodies, kind, rows, owners)
        full = (len(rows), *worlds)
        entry = RAYS[kind](sizes, pose, start, heading)
        found.append(jax.tree.map(lambda value, full=full: jnp.broadcast_to(value, full), entry))
    entries = jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)
    distance, surface, hit = entries
    owners = [entry.body for entry in shapes]
    seen = hit & (distance <= max_distance)
    if len(set(owners)) < len(owners):
        seen &= ~_inside_own_body(model, bodies, shapes, start, heading, entries)
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


def _by_kind(shapes: Sequence[ShapeEntry]) -> list[tuple[str, list[int], list[int]]]:
    """Kinds of shapes that are sorted by kind, rows of each, and the bodies of these."""
    groups = [(kind, list(some)) for kind, some in itertools.groupby(shapes, key=lambda entry: entry.kind)]
    return [(kind, [entry.index for entry in some], [entry.body for entry in some]) for kind, some in groups]


def _placed(
    model: Model, bodies: Bodies, kind: str, rows: Sequence[int], owners: Sequence[int]
) -> tuple[dict[str, Any], Pose]:
    """Sizes and poses of some shapes of a kind."""
    sizes = shape_parameters(model.scene, model.shapes, kind, rows)
    return sizes, shape_poses(model.shapes, kind, rows, owners, bodies.position, bodies.orientation)


class _Span(NamedTuple):
    """Piece of a line in a convex shape (shape, world): where it enters and leaves [m], and the round-off of these.

    ``enter > leave`` if the line misses the shape.
    """

    enter: Array
    leave: Array
    noise: Array


def _inside_own_body(
    model: Model, bodies: Bodies, shapes: Sequence[ShapeEntry], start: Vec3, heading: Vec3, entries: RayHit
) -> Array:
    """(shape, world) whether a ray enters a shape where it is already inside another one of the same body.

    An entry into one part of a union is a point of its surface unless it lies in another part. That is a decision, without
    derivative, and settled: two parts must not hide each other. Entries into shapes that are bodies by themselves are not
    asked about.
    """
    model, bodies, start, heading, entries = lax.stop_gradient((model, bodies, start, heading, entries))
    count = collections.Counter(entry.body for entry in shapes)
    places = np.array([place for place, entry in enumerate(shapes) if count[entry.body] > 1])
    owner = np.array([shapes[place].body for place in places])
    spans = [_span(model, bodies, *some, start, heading) for some in _by_kind([shapes[place] for place in places])]
    worlds = entries.distance.shape[1:]
    span = jax.tree.map(
        lambda *some: jnp.concatenate([jnp.broadcast_to(value, (len(value), *worlds)) for value in some]), *spans
    )
    distance, normal, hit = jax.tree.map(lambda value: value[places], entries)
    contains_start = ~hit & (span.enter < 0) & (span.leave > 0)
    enter = settle(jnp.where(hit, distance, jnp.where(contains_start, -far(distance), far(distance))))
    # The gap between two faces that lie on each other is round-off, and the longer on the ray the flatter it is to them.
    slant = jnp.abs(dot(normal, heading))
    inside = jnp.zeros(entries.hit.shape, bool)
    for number in sorted(set(count.values()) - {1}):
        table = np.array([np.flatnonzero(owner == body) for body in sorted(count) if count[body] == number])
        # (body, part that is entered, part in which that may be, world)
        at, steep = (value[table][:, :, None] for value in (enter, slant))
        before, leave, noise = (value[table][:, None] for value in (enter, span.leave, span.noise))
        covered = ((before < at) & ((at - leave) * steep <= noise)).any(2)
        inside = inside.at[places[table]].set(covered)
    return settle(inside.astype(distance.dtype)) > 0.5


def _span(
    model: Model,
    bodies: Bodies,
    kind: str,
    rows: Sequence[int],
    owners: Sequence[int],
    start: Vec3,
    heading: Vec3,
) -> _Span:
    """Of convex shapes of one kind: by two rays, from before them and back from behind them."""
    sizes, pose = _placed(model, bodies, kind, rows, owners)
    radius = bounding_radius(kind, sizes)
    middle = dot(pose.position - start, heading) + jnp.zeros((len(rows), 1), start.x.dtype)
    before, behind = middle - 2.0 * radius, middle + 2.0 * radius
    there = RAYS[kind](sizes, pose, start + heading * before, heading)
    back = RAYS[kind](sizes, pose, start + heading * behind, -heading)
    met = there.hit & back.hit
    size = sum(jnp.abs(component) for vector in (pose.position, start) for component in vector) + radius
    return _Span(
        jnp.where(met, before + there.distance, far(middle)),
        jnp.where(met, behind - back.distance, -far(middle)),
        jnp.broadcast_to(ROUND_OFF * jnp.finfo(middle.dtype).eps * size, middle.shape),
    )
