"""Where a ray meets a shape, one entry of `RAY_SHAPES` a kind: closed forms for the common ones, else the engine's own.

Rays are component arrays of shape ``(ray,)``; a shape's pose and size are scalars that broadcast against them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.ray_frame import RayHit
from mathota_jax.collision.ray_heightfield import ray_surface
from mathota_jax.collision.rays import RAYS
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import Mat3, Vec3, cross, dot


class Placed(NamedTuple):
    """A shape in the world: its sizes by name, its body's position and rotation.

    Sizes are scalars or `Vec3`; vertices are a `Vec3` of components ``(vertex,)`` with their faces ``(face, corner)``,
    heights ``(row, column)``.
    """

    size: dict[str, Any]
    position: Vec3
    rotation: Mat3


class RayShape(NamedTuple):
    """How one kind of shape is seen.

    Attributes:
        meet: ``(origin, direction, placed)`` to the distance ``(ray,)`` [m] along unit directions to the entry point,
            infinite where the ray misses or starts inside, and the outward unit normal there.
        patterned: Whether to draw octants in two tones, which make the turning of a round shape visible.
    """

    meet: Callable[[Vec3, Vec3, Placed], tuple[Array, Vec3]]
    patterned: bool


def _closed_form(
    distance: Callable[[Vec3, Vec3, Placed], Array], normal: Callable[[Vec3, Placed], Vec3], patterned: bool
) -> RayShape:
    """A shape by the distance to its entry and the normal at a point of its surface."""

    def meet(origin: Vec3, direction: Vec3, placed: Placed) -> tuple[Array, Vec3]:
        entry = distance(origin, direction, placed)
        return entry, normal(origin + direction * entry, placed)

    return RayShape(meet, patterned)


def _of_the_engine(rays: Callable[..., RayHit], patterned: bool) -> RayShape:
    """A shape by the engine's own rays, to which shapes and worlds are the last two axes: here one shape, and the rays."""

    def meet(origin: Vec3, direction: Vec3, placed: Placed) -> tuple[Array, Vec3]:
        size = {
            name: values[None] if name == "faces" else jax.tree.map(lambda leaf: leaf[..., None, None], values)
            for name, values in placed.size.items()
        }
        pose = jax.tree.map(lambda leaf: leaf[..., None, None], Pose(placed.position, placed.rotation))
        start, heading = (vector.map(lambda c: c[None]) for vector in (origin, direction))
        found = rays(size, pose, start, heading)
        return _entry(found.hit, found.distance)[0], found.normal.map(lambda c: c[0])

    return RayShape(meet, patterned)


def _entry(hit: Array, distance: Array) -> Array:
    return jnp.where(hit & (distance > 0), distance, jnp.inf)


def sphere_distance(origin: Vec3, direction: Vec3, placed: Placed) -> Array:
    """Entry into a sphere.

    The discriminant is taken from the closest point on the ray, which stays exact in float32 for a small far sphere
    (E. Haines et al., "Precision Improvements for Ray/Sphere Intersection", Ray Tracing Gems, ch. 7).
    """
    return _ball_distance(origin - placed.position, direction, placed.size["radius"])


def _ball_distance(offset: Vec3, direction: Vec3, radius: Array) -> Array:
    along = dot(offset, direction)
    miss = offset - direction * along
    discriminant = radius * radius - dot(miss, miss)
    return _entry(discriminant > 0, -along - jnp.sqrt(jnp.maximum(discriminant, 0.0)))


def sphere_normal(point: Vec3, placed: Placed) -> Vec3:
    """Outward normal of a sphere."""
    return (point - placed.position) / placed.size["radius"]


def box_distance(origin: Vec3, direction: Vec3, placed: Placed) -> Array:
    """Entry into a box by the slab method in its own frame."""
    start = placed.rotation.apply_transposed(origin - placed.position)
    # A ray parallel to a face would give 0 times infinity when it also starts in the slab's middle plane.
    heading = placed.rotation.apply_transposed(direction).map(lambda c: jnp.where(jnp.abs(c) < 1e-9, 1e-9, c))
    inverse = heading.map(lambda c: 1.0 / c)
    half = placed.size["half_extents"]
    middle = Vec3(-start.x * inverse.x, -start.y * inverse.y, -start.z * inverse.z)
    reach = Vec3(half.x * jnp.abs(inverse.x), half.y * jnp.abs(inverse.y), half.z * jnp.abs(inverse.z))
    enter = jnp.maximum(jnp.maximum(middle.x - reach.x, middle.y - reach.y), middle.z - reach.z)
    leave = jnp.minimum(jnp.minimum(middle.x + reach.x, middle.y + reach.y), middle.z + reach.z)
    return _entry(enter < leave, enter)


def box_normal(point: Vec3, placed: Placed) -> Vec3:
    """Outward normal of the face on which the point lies."""
    local = placed.rotation.apply_transposed(point - placed.position)
    half = placed.size["half_extents"]
    x, y, z = local.x / half.x, local.y / half.y, local.z / half.z
    on_x = (jnp.abs(x) >= jnp.abs(y)) & (jnp.abs(x) >= jnp.abs(z))
    on_y = ~on_x & (jnp.abs(y) >= jnp.abs(z))
    on_z = ~on_x & ~on_y
    return placed.rotation.apply(
        Vec3(jnp.where(on_x, jnp.sign(x), 0.0), jnp.where(on_y, jnp.sign(y), 0.0), jnp.where(on_z, jnp.sign(z), 0.0))
    )


def capsule_distance(origin: Vec3, direction: Vec3, placed: Placed) -> Array:
    """Entry into a capsule along local Y: the infinite cylinder decides between the barrel and one of the caps."""
    radius, half_height = placed.size["radius"], placed.size["half_height"]
    axis = placed.rotation.column_y
    offset = origin - placed.position
    slope, height = dot(axis, direction), dot(axis, offset)
    across = direction - axis * slope
    # Along the axis the quotient below must send the cylinder's entry far to the viewer's side, not to NaN.
    squared = jnp.maximum(dot(across, across), 1e-9)
    moment = dot(axis, cross(offset, direction))
    discriminant = squared * radius * radius - moment * moment
    barrel = (-dot(offset, across) - jnp.sqrt(jnp.maximum(discriminant, 0.0))) / squared
    entry_height = height + barrel * slope
    cap = axis * jnp.where(entry_height > 0, half_height, -half_height)
    end = _ball_distance(offset - cap, direction, radius)
    return jnp.where(jnp.abs(entry_height) <= half_height, _entry(discriminant > 0, barrel), end)


def capsule_normal(point: Vec3, placed: Placed) -> Vec3:
    """Outward normal: away from the nearest point of the axis segment."""
    axis, half_height = placed.rotation.column_y, placed.size["half_height"]
    offset = point - placed.position
    return (offset - axis * jnp.clip(dot(offset, axis), -half_height, half_height)) / placed.size["radius"]


def plane_distance(origin: Vec3, direction: Vec3, placed: Placed) -> Array:
    """Distance to a plane, from its outer side only: a wall seen from behind does not hide the scene."""
    normal, offset = placed.size["normal"], placed.size["offset"]
    slope = dot(normal, direction)
    facing = slope < 0
    return _entry(facing, (offset - dot(normal, origin)) / jnp.where(facing, slope, 1.0))


def plane_normal(point: Vec3, placed: Placed) -> Vec3:
    """The plane's own normal at every point."""
    return placed.size["normal"].map(lambda c: jnp.broadcast_to(c, point.x.shape))


RAY_SHAPES = {
    "sphere": _closed_form(sphere_distance, sphere_normal, patterned=True),
    "box": _closed_form(box_distance, box_normal, patterned=False),
    "capsule": _closed_form(capsule_distance, capsule_normal, patterned=True),
    "cylinder": _of_the_engine(RAYS["cylinder"], patterned=True),
    "cone": _of_the_engine(RAYS["cone"], patterned=True),
    "polyhedron": _of_the_engine(RAYS["polyhedron"], patterned=False),
    # Of the surface alone: walls without an end would stand in every picture from the side.
    "heightfield": _of_the_engine(ray_surface, patterned=False),
    "plane": _closed_form(plane_distance, plane_normal, patterned=False),
}
