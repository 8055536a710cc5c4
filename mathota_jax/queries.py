"""Questions about two shapes: how far apart, where they touch, when they will touch. No scene is needed.

A pose is ``(position, orientation)``: (3,) [m] and a unit quaternion (4,), (w, x, y, z), world from shape. All functions
are pure, differentiable, and fast under `jax.vmap` (the mapped pairs run side by side, see `batching`).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from mathota_jax.advancement import Contact, Mover, first_contact
from mathota_jax.batching import batch_last
from mathota_jax.collision.height_grid import window_size
from mathota_jax.collision.manifold import Manifold, Nearest
from mathota_jax.collision.pairs import PAIRS, Pair
from mathota_jax.geometry import SHAPES, Shape
from mathota_jax.geometry.bounds import bounding_radius
from mathota_jax.geometry.hull import padded_faces
from mathota_jax.geometry.leaves import Geometry
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, to_matrix
from mathota_jax.spatial.settle import materialize, settle
from mathota_jax.spatial.vector import Vec3, cross, dot, where

NaturalPose = tuple[Any, Any]


class ClosestPoints(NamedTuple):
    """Closest points of two shapes.

    Attributes:
      separation: () signed gap [m], negative when overlapping: then the least translation that parts the shapes.
      normal: (3,) unit vector from A to B, world frame; the derivative of the separation by the position of B.
      point_a, point_b: (3,) points of the surfaces [m], world frame; ``point_b - point_a = separation * normal``.
      converged: () False where an iterative search ended at its limit: the rest is then the best bound found.
    """

    separation: Array
    normal: Array
    point_a: Array
    point_b: Array
    converged: Array


class ContactManifold(NamedTuple):
    """Contact points of two shapes, with unit normals from A to B.

    Attributes:
      normal: (3,) of the first, deepest point and, but for heightfields, of all; world frame.
      normals: (point, 3) of each point, world frame.
      position: (point, 3) midway between the surfaces [m], world frame.
      separation: (point,) signed gaps along the normal [m].
      feature: (point,) id of the geometric feature, stable under small motions.
      active: (point,) whether the slot holds a point.
    """

    normal: Array
    normals: Array
    position: Array
    separation: Array
    feature: Array
    active: Array


class Impact(NamedTuple):
    """First contact of two moving shapes.

    Attributes:
      time: () seconds from now; 0 if they touch already, the given duration if they do not within it.
      hit: () whether they touch within the duration.
      distance: closest points at that time. Where its `converged` is False the search may have ended at its limit: without
        a hit, nothing is known beyond `time`.
    """

    time: Array
    hit: Array
    distance: ClosestPoints


def signed_distance(shape_a: Any, pose_a: NaturalPose, shape_b: Any, pose_b: NaturalPose) -> ClosestPoints:
    """Signed distance of two shapes with the points where it is attained.

    Differentiable in the poses and, where a `Geometry` is given, in its sizes, except where the closest features change
    (one of the one-sided derivatives there). Values and derivatives are finite at every pose.

    Args:
      shape_a: a shape such as ``Box((1, 1, 1))`` or a `Geometry`.
      pose_a: ``(position, orientation)`` of A.
      shape_b: as `shape_a`.
      pose_b: ``(position, orientation)`` of B.

    Raises:
      ValueError: not a shape, a pose of the wrong shape, or a pair that can not collide (two planes).
    """
    _check_poses("signed_distance", pose_a, pose_b)
    return _distance(*_pair("signed_distance", shape_a, shape_b), pose_a, pose_b)


def closest_points(shape_a: Any, pose_a: NaturalPose, shape_b: Any, pose_b: NaturalPose) -> tuple[Array, Array]:
    """Points (3,) of A and of B [m], world frame, between which the signed distance is measured."""
    found = signed_distance(shape_a, pose_a, shape_b, pose_b)
    return found.point_a, found.point_b


def manifold(shape_a: Any, pose_a: NaturalPose, shape_b: Any, pose_b: NaturalPose) -> ContactManifold:
    """Contact points of two shapes, at most four; arguments and errors as for `signed_distance`.

    Shapes that are apart have contact points as well, with positive separations.
    """
    _check_poses("manifold", pose_a, pose_b)
    return _manifold(*_pair("manifold", shape_a, shape_b), pose_a, pose_b)


def time_of_impact(
    shape_a: Any,
    pose_a: NaturalPose,
    motion_a: NaturalPose,
    shape_b: Any,
    pose_b: NaturalPose,
    motion_b: NaturalPose,
    duration: Any,
) -> Impact:
    """When two shapes that move uniformly touch first, by conservative advancement.

    No step can jump over a contact of convex shapes: they advance by the time in which their velocities and rotations can
    not close the gap (see `advancement`). Beside a heightfield, which is not convex, the motion is sampled: what grazes it
    for less than 1/16 of the other shape's reach may be missed. The derivative of the time is that of the root of the gap,
    ``dt = -d gap / (d gap / d t)``; it is 0 where nothing is hit.

    Args:
      shape_a: a shape or a `Geometry`.
      pose_a: ``(position, orientation)`` of A.
      motion_a: ``(velocity, angular_velocity)``, (3,) each [m/s, rad/s], world frame, of the origin of A.
      shape_b: as `shape_a`.
      pose_b: as `pose_a`.
      motion_b: as `motion_a`.
      duration: [s], at least 0.

    Raises:
      ValueError: as `signed_distance`, a motion of the wrong shape, or a negative duration.
    """
    _check_poses("time_of_impact", pose_a, pose_b)
    for name, motion in (("motion_a", motion_a), ("motion_b", motion_b)):
        if [jnp.shape(part) for part in motion] != [(3,), (3,)]:
            raise ValueError(
                f"time_of_impact: {name} must be (velocity, angular_velocity) of shapes (3,) and (3,), "
                f"got {[jnp.shape(part) for part in motion]}"
            )
    if not isinstance(duration, Tracer) and np.any(np.asarray(duration) < 0):
        raise ValueError(f"time_of_impact: the duration must be at least 0 s, got {duration}")
    a, b = _pair("time_of_impact", shape_a, shape_b)
    return _impact(a, pose_a, motion_a, b, pose_b, motion_b, jnp.asarray(duration, jnp.result_type(float)))


def _pair(label: str, shape_a: Any, shape_b: Any) -> tuple[Geometry, Geometry]:
    try:
        a, b = Geometry.of(shape_a), Geometry.of(shape_b)
    except ValueError as error:
        raise ValueError(f"{label}: {error}") from None
    if _key(a, b) not in PAIRS:
        raise ValueError(f"{label}: there is no distance between a {a.kind} and a {b.kind}")
    if a.kind == "heightfield":
        return _windowed(label, a, b), b
    return a, _windowed(label, b, a) if b.kind == "heightfield" else b


def _windowed(label: str, field: Geometry, other: Geometry) -> Geometry:
    """The heightfield with the size of the window of its cells that are tested."""
    if field.window is not None:
        return field
    sizes = [field.parameters["cell_size"], *other.parameters.values()]
    if any(isinstance(size, Tracer) for size in sizes):
        raise ValueError(
            f"{label}: the sizes of a {other.kind} and the cells of a heightfield are traced, so how many cells lie under "
            "the shape is unknown; give the number along each side: dataclasses.replace(geometry, window=...)"
        )
    reach = float(SHAPES[other.kind].reach_of({name: np.asarray(v) for name, v in other.parameters.items()}))
    return dataclasses.replace(field, window=window_size(reach, float(field.parameters["cell_size"])))


def _check_poses(label: str, *poses: NaturalPose) -> None:
    for name, pose in zip(("pose_a", "pose_b"), poses, strict=True):
        shapes = [jnp.shape(part) for part in pose]
        if shapes != [(3,), (4,)]:
            raise ValueError(
                f"{label}: {name} must be (position, orientation) of shapes (3,) and (4,), got {shapes}; "
                "use jax.vmap for many pairs"
            )


def _key(a: Geometry, b: Geometry) -> tuple[str, str]:
    order = list(SHAPES)
    return (a.kind, b.kind) if order.index(a.kind) <= order.index(b.kind) else (b.kind, a.kind)


_Placed = tuple[dict[str, Any], Pose]


def _ordered(a: Geometry, pose_a: Pose, b: Geometry, pose_b: Pose) -> tuple[Pair, _Placed, _Placed, bool]:
    """The entry of the registry, both shapes in its order as pair functions take them, and whether they are swapped."""
    key = _key(a, b)
    placed = _placed(a, pose_a), _placed(b, pose_b)
    swapped = key != (a.kind, b.kind)
    first, second = placed[::-1] if swapped else placed
    return PAIRS[key], first, second, swapped


def _run_pair(a: Geometry, pose_a: Pose, b: Geometry, pose_b: Pose) -> Manifold:
    """The contact points; the normal leads from A to B whatever the order of the registry."""
    pair, first, second, swapped = _ordered(a, pose_a, b, pose_b)
    found = pair.function(*first, *second)
    return _reversed(found) if swapped else found


def _reversed(found: Manifold) -> Manifold:
    points = (p if p.normal is None else p._replace(normal=-p.normal) for p in found.points)
    return Manifold(-found.normal, tuple(points))


def _placed(geometry: Geometry, pose: Pose) -> _Placed:
    """Parameters and pose as pair functions take them: a plane is given in the world frame."""
    sizes = _sizes(geometry)
    if geometry.kind != "plane":
        return sizes, pose
    assert pose.rotation is not None
    normal = pose.rotation.apply(sizes["normal"])
    return {"normal": normal, "offset": sizes["offset"] + dot(normal, pose.position)}, pose


def _sizes(geometry: Geometry) -> dict[str, Any]:
    """Worlds-last sizes of one shape: components (1, world), of vertices (vertex, 1, world)."""
    found: dict[str, Any] = {}
    for name, value in geometry.parameters.items():
        if name == "vertices":
            found[name] = Vec3(*(value[:, axis, None] for axis in range(3)))
        elif name == "heights":
            found[name] = value[:, :, None]
        else:
            found[name] = Vec3(*(value[axis][None] for axis in range(3))) if value.ndim == 2 else value[None]
    if geometry.faces is not None:
        found["faces"] = padded_faces([geometry.faces])
    if geometry.window is not None:
        found["window"] = geometry.window
    return found


def _pose(pose: NaturalPose) -> Pose:
    position, orientation = pose
    rotation = to_matrix(Quaternion(*(orientation[k][None] for k in range(4))))
    return Pose(Vec3(*(position[axis][None] for axis in range(3))), rotation)


def _nearest(a: Geometry, pose_a: Pose, b: Geometry, pose_b: Pose) -> Nearest:
    """The closest points, components (1, world); the normal leads from A to B whatever the order of the registry."""
    pair, first, second, swapped = _ordered(a, pose_a, b, pose_b)
    found = _deepest(pair.function(*first, *second)) if pair.distance is None else pair.distance(*first, *second)
    return Nearest(found.separation, -found.normal, found.point_b, found.point_a, found.converged) if swapped else found


def _deepest(found: Manifold) -> Nearest:
    """The deepest active point of a manifold."""
    first, *others = found.points
    position, separation, normal = first.position, first.separation, found.normal
    for point in others:
        nearer = settle(jnp.where(point.active & (point.separation < separation), 1.0, 0.0)) > 0.5
        position, separation = where(nearer, point.position, position), jnp.where(nearer, point.separation, separation)
        normal = normal if point.normal is None else where(nearer, point.normal, normal)
    half = normal * (0.5 * separation)
    return Nearest(separation, normal, position - half, position + half, found.converged)


def _natural(nearest: Nearest) -> ClosestPoints:
    worlds = np.broadcast_shapes(*(jnp.shape(x) for x in jax.tree.leaves(nearest)))
    # Stored first, or each coordinate of each point is computed from the poses by itself, a world at a time.
    separation, *vectors = materialize(jax.tree.map(lambda x: jnp.broadcast_to(x, worlds)[0], nearest[:4]))
    normal, point_a, point_b = map(jnp.stack, vectors)
    converged = jnp.ones(worlds, bool) if nearest.converged is None else jnp.broadcast_to(nearest.converged, worlds)
    return ClosestPoints(separation, normal, point_a, point_b, converged[0])


@batch_last
def _distance(a: Geometry, b: Geometry, pose_a: NaturalPose, pose_b: NaturalPose) -> ClosestPoints:
    return _natural(_nearest(a, _pose(pose_a), b, _pose(pose_b)))


@batch_last
def _manifold(a: Geometry, b: Geometry, pose_a: NaturalPose, pose_b: NaturalPose) -> ContactManifold:
    found = _run_pair(a, _pose(pose_a), b, _pose(pose_b))
    worlds = np.broadcast_shapes(*(jnp.shape(x) for x in jax.tree.leaves(found)))

    def full(value: Array) -> Array:
        return jnp.broadcast_to(value, worlds)[0]

    def vector(v: Vec3) -> Array:
        return jnp.stack([full(component) for component in v])

    return ContactManifold(
        normal=vector(found.normal),
        normals=jnp.stack([vector(found.normal if p.normal is None else p.normal) for p in found.points]),
        position=jnp.stack([vector(point.position) for point in found.points]),
        separation=jnp.stack([full(point.separation) for point in found.points]),
        feature=jnp.stack([full(point.feature) for point in found.points]),
        active=jnp.stack([full(point.active) for point in found.points]),
    )


@batch_last
def _impact(
    a: Geometry,
    pose_a: NaturalPose,
    motion_a: NaturalPose,
    b: Geometry,
    pose_b: NaturalPose,
    motion_b: NaturalPose,
    duration: Array,
) -> Impact:
    movers = _mover(a, pose_a, motion_a), _mover(b, pose_b, motion_b)
    time, hit, searched, found = _first_impact(movers, duration[None])
    distance = _natural(found)
    return Impact(time[0], hit[0], distance._replace(converged=distance.converged & searched[0]))


_Movers = tuple[Mover, Mover]


def _nearest_at(movers: _Movers, time: Array) -> Nearest:
    """The closest points at a time."""
    return _nearest(movers[0].geometry, movers[0].at(time), movers[1].geometry, movers[1].at(time))


@jax.custom_jvp
def _first_impact(movers: _Movers, duration: Array) -> Contact:
    """The first contact, differentiably."""
    touching = 16.0 * jnp.finfo(duration.dtype).eps * jnp.minimum(*(mover.reach for mover in movers))
    return first_contact(*movers, functools.partial(_nearest_at, movers), duration, touching)


@_first_impact.defjvp
def _first_impact_jvp(primals: tuple, tangents: tuple) -> tuple:
    """The time is that of the root of the gap (implicit function theorem); a miss ends with the duration."""
    (movers, duration), (d_movers, d_duration) = primals, tangents
    contact = time, hit, searched, found = _first_impact(movers, duration)
    _, change = jax.linearize(_nearest_at, movers, time)
    rate = _approach(movers[0], movers[1], time, found)
    touches = hit & (time > 0) & (rate < 0)
    d_gap = change(d_movers, jnp.zeros_like(time)).separation
    d_contact = jnp.where(touches, -d_gap / jnp.where(touches, rate, 1.0), 0.0)
    d_time = jnp.where(hit, d_contact, jnp.where(searched, d_duration, 0.0))
    d_found = change(d_movers, d_time)
    unmoved: Any = np.zeros(time.shape, jax.dtypes.float0)
    d_found = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, time.shape), d_found._replace(converged=None))
    return contact, Contact(d_time, unmoved, unmoved, d_found._replace(converged=unmoved))


def _mover(geometry: Geometry, pose: NaturalPose, motion: NaturalPose) -> Mover:
    position, velocity, angular_velocity = (
        Vec3(*(array[axis][None] for axis in range(3))) for array in (pose[0], *motion)
    )
    orientation = Quaternion(*(pose[1][k][None] for k in range(4)))
    reach = bounding_radius(geometry.kind, _sizes(geometry))
    return Mover(geometry, position, orientation, velocity, angular_velocity, reach)


def _approach(a: Mover, b: Mover, time: Array, nearest: Nearest) -> Array:
    """Rate of change of the separation [m/s]."""
    speeds = [
        dot(nearest.normal, m.velocity + cross(m.angular_velocity, point - (m.position + m.velocity * time)))
        for m, point in ((a, nearest.point_a), (b, nearest.point_b))
    ]
    return speeds[1] - speeds[0]


__all__ = [
    "ClosestPoints",
    "ContactManifold",
    "Geometry",
    "Impact",
    "Shape",
    "closest_points",
    "manifold",
    "signed_distance",
    "time_of_impact",
]
