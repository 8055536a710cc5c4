"""Where a ray enters a shape: closed forms, one entry of `RAYS` a kind. Worlds last.

A ray that starts inside a solid does not hit it. Each function works in the frame of the shape with the ray's parameter
counted from the point nearest to the shape's origin, where float32 is best. Every discrete choice, with -1 for a miss, is
one settled number (see `spatial.settle`); what is selected by it is finite, also where the ray misses.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.collision.ray_frame import PARALLEL, LocalRay, RayHit, far, hit_at, local_ray, slab
from mathota_jax.collision.ray_heightfield import ray_heightfield
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import settle, settle_code
from mathota_jax.spatial.vector import Vec3, cross, dot, norm
from mathota_jax.spatial.vector import where as where3


def _first(entries: list[tuple[Array, Array]], begin: Array) -> tuple[Array, Array]:
    """Code of the earliest of several (parameter, whether valid), -1 if there is none or it lies before the start."""
    # Each candidate becomes one settled number; otherwise a candidate could beat the others in one copy of the comparison
    # and be refused in the next, and the ray would slip through the seam.
    keys = [settle(jnp.where(valid, parameter, far(begin))) for parameter, valid in entries]
    best, code = keys[0], jnp.zeros_like(keys[0])
    for index, key in enumerate(keys[1:], start=1):
        best, code = jnp.minimum(key, best), jnp.where(key < best, float(index), code)
    code = settle_code(jnp.where((best < far(begin)) & (best >= begin), code, -1.0))
    parameter = sum(jnp.where(code == index, value, 0.0) for index, (value, _) in enumerate(entries))
    return code, jnp.asarray(parameter)


def _last(intervals: list[tuple[Array, Array]], begin: Array) -> tuple[Array, Array]:
    """Code of the set that a ray enters last on its way into the intersection of several, -1 if it does not get in.

    Args:
        intervals: (enter, leave) of each convex set.
        begin: where the ray starts.
    """
    enters = [settle(enter) for enter, _ in intervals]
    leave = intervals[0][1]
    best, code = enters[0], jnp.zeros_like(enters[0])
    for index, (_, other) in enumerate(intervals[1:], start=1):
        best, code = jnp.maximum(enters[index], best), jnp.where(enters[index] > best, float(index), code)
        leave = jnp.minimum(leave, other)
    code = settle_code(jnp.where((best < leave) & (best >= begin), code, -1.0))
    parameter = sum(jnp.where(code == index, enter, 0.0) for index, (enter, _) in enumerate(intervals))
    return code, jnp.asarray(parameter)


def _choose(code: Array, vectors: list[Vec3]) -> Vec3:
    """The vector that a code selects; zero for -1."""
    chosen = vectors[0] * 0.0
    for index, vector in enumerate(vectors):
        chosen = where3(code == index, vector, chosen)
    return chosen


def _ball(ray: LocalRay, center: Vec3, radius: Any) -> tuple[Array, Array, Vec3]:
    """Entry into a ball: parameter, whether there is one, and outward normal there.

    From the point of the ray nearest to the centre, which stays exact in float32 for a small far ball (E. Haines et al.,
    "Precision Improvements for Ray/Sphere Intersection", Ray Tracing Gems, 2019, chapter 7).
    """
    offset = ray.origin - center
    along = dot(offset, ray.direction)
    miss = offset - ray.direction * along
    squared = radius * radius - dot(miss, miss)
    half = safe_sqrt(jnp.maximum(squared, 0.0))
    return -along - half, squared > 0, (miss - ray.direction * half) / radius


def ray_sphere(sphere: dict[str, Any], pose: Pose, origin: Vec3, direction: Vec3) -> RayHit:
    """Entry into a sphere."""
    ray = local_ray(pose, origin, direction)
    parameter, valid, normal = _ball(ray, ray.origin * 0.0, sphere["radius"])
    code, parameter = _first([(parameter, valid)], ray.begin)
    return hit_at(pose, ray, code, parameter, _choose(code, [normal]))


def ray_plane(plane: dict[str, Any], _: Pose, origin: Vec3, direction: Vec3) -> RayHit:
    """Entry into the half space behind a plane, which is given in the world frame."""
    normal = plane["normal"]
    slope, height = dot(normal, direction), dot(normal, origin) - plane["offset"]
    facing = slope < -PARALLEL
    distance = -height / jnp.where(facing, slope, -1.0)
    code = settle_code(jnp.where(facing & (height >= 0), 0.0, -1.0).astype(distance.dtype))
    return RayHit(jnp.where(code >= 0, distance, 0.0), _choose(code, [normal]), code >= 0)


def ray_box(box: dict[str, Any], pose: Pose, origin: Vec3, direction: Vec3) -> RayHit:
    """Entry into a box by its slabs (T. Kay and J. Kajiya, "Ray Tracing Complex Scenes", SIGGRAPH 1986)."""
    ray = local_ray(pose, origin, direction)
    intervals = [slab(*axis) for axis in zip(ray.origin, ray.direction, box["half_extents"], strict=True)]
    code, parameter = _last(intervals, ray.begin)
    zero = jnp.zeros_like(ray.begin)
    x, y, z = (jnp.where(slope < 0, 1.0, -1.0).astype(zero.dtype) + zero for slope in ray.direction)
    normals = [Vec3(x, zero, zero), Vec3(zero, y, zero), Vec3(zero, zero, z)]
    return hit_at(pose, ray, code, parameter, _choose(code, normals))


def _barrel(ray: LocalRay, radius: Any) -> tuple[Array, Array, Vec3]:
    """Interval of an endless cylinder about the y axis, and the outward normal at its entry."""
    (x, _, z), (dx, _, dz) = ray.origin, ray.direction
    squared = dx * dx + dz * dz
    parallel = squared < PARALLEL
    inverse = 1.0 / jnp.where(parallel, 1.0, squared)
    middle = -(x * dx + z * dz) * inverse
    moment = x * dz - z * dx
    # Half the chord seen along the axis, squared.
    chord = radius * radius - moment * moment * inverse
    half = safe_sqrt(jnp.maximum(chord, 0.0) * inverse)
    outside = jnp.where(parallel, x * x + z * z > radius * radius, chord <= 0)
    limit = jnp.where(outside, far(middle), -far(middle))
    special = parallel | outside
    enter, leave = jnp.where(special, limit, middle - half), jnp.where(special, -limit, middle + half)
    at = jnp.where(special, 0.0, enter)
    return enter, leave, Vec3((x + at * dx) / radius, jnp.zeros_like(at), (z + at * dz) / radius)


def _cap(ray: LocalRay) -> Vec3:
    """Outward normal of the end of a cylinder through which a ray comes in."""
    zero = jnp.zeros_like(ray.begin)
    return Vec3(zero, jnp.where(ray.direction.y < 0, 1.0, -1.0).astype(zero.dtype) + zero, zero)


def ray_cylinder(cylinder: dict[str, Any], pose: Pose, origin: Vec3, direction: Vec3) -> RayHit:
    """Entry into a cylinder: the later of those into its barrel and between its ends."""
    ray = local_ray(pose, origin, direction)
    enter, leave, normal = _barrel(ray, cylinder["radius"])
    ends = slab(ray.origin.y, ray.direction.y, cylinder["half_height"])
    code, parameter = _last([(enter, leave), ends], ray.begin)
    return hit_at(pose, ray, code, parameter, _choose(code, [normal, _cap(ray)]))


def ray_capsule(capsule: dict[str, Any], pose: Pose, origin: Vec3, direction: Vec3) -> RayHit:
    """Entry into a capsule: the earliest of those into the balls at its ends and the cylinder between them."""
    ray = local_ray(pose, origin, direction)
    radius, half_height = capsule["radius"], capsule["half_height"]
    enter, leave, normal = _barrel(ray, radius)
    low, high = slab(ray.origin.y, ray.direction.y, half_height)
    zero = jnp.zeros_like(ray.begin)
    # Where the cylinder is entered through an end, the ball there was entered before.
    on_barrel = (enter >= low) & (enter <= jnp.minimum(leave, high))
    top, bottom = (_ball(ray, Vec3(zero, sign * half_height + zero, zero), radius) for sign in (1.0, -1.0))
    code, parameter = _first([(enter, on_barrel), top[:2], bottom[:2]], ray.begin)
    return hit_at(pose, ray, code, parameter, _choose(code, [normal, top[2], bottom[2]]))


def ray_cone(cone: dict[str, Any], pose: Pose, origin: Vec3, direction: Vec3) -> RayHit:
    """Entry into a cone: the later of those into the endless cone below the apex and above its base."""
    ray = local_ray(pose, origin, direction)
    h = cone["half_height"]
    slope = cone["radius"] / (2.0 * h)
    from_apex = ray._replace(origin=ray.origin._replace(y=ray.origin.y - 1.5 * h))
    enter, leave = _below_apex(from_apex, slope)
    base = slab(ray.origin.y - 0.5 * h, ray.direction.y, h)
    code, parameter = _last([(enter, leave), base], ray.begin)
    at = jnp.where(code == 0, parameter, 0.0)
    x, z = ray.origin.x + at * ray.direction.x, ray.origin.z + at * ray.direction.z
    across = norm(Vec3(x, jnp.zeros_like(x), z))
    scale = 1.0 / jnp.sqrt(1.0 + slope * slope)
    # The apex has many normals: the axis is one.
    rise = jnp.where(across > 0, slope * scale, 1.0)
    side = Vec3(safe_divide(x, across) * scale, rise, safe_divide(z, across) * scale)
    return hit_at(pose, ray, code, parameter, _choose(code, [side, _cap(ray)]))


def _below_apex(ray: LocalRay, slope: Any) -> tuple[Array, Array]:
    """Interval of the endless cone ``x^2 + z^2 <= (slope y)^2, y <= 0``; empty (enter > leave) for a miss.

    A ray flatter than the side meets the double cone in one piece, above or below the apex; a steeper one is inside for
    ever at both ends. The roots are taken in the form that does not cancel.
    """
    (x, y, z), (dx, dy, dz) = ray.origin, ray.direction
    a = dx * dx + dz * dz - slope * slope * dy * dy
    b = x * dx + z * dz - slope * slope * y * dy
    c = x * x + z * z - slope * slope * y * y
    # b^2 - a c, without the cancellation of the large terms.
    moment = x * dz - z * dx
    along, beside = x * dy - y * dx, z * dy - y * dz
    squared = slope * slope * (along * along + beside * beside) - moment * moment
    root = safe_sqrt(jnp.maximum(squared, 0.0))
    positive = b > 0
    sum_ = jnp.where(positive, -b - root, root - b)  # of two numbers of one sign
    limit = far(sum_)
    # Parallel to a side counts as steeper: its other root lies beyond the end where the ray is inside for ever.
    degenerate = jnp.abs(a) < PARALLEL
    wide = jnp.where(degenerate, jnp.where(positive, limit, -limit), sum_ / jnp.where(degenerate, 1.0, a))
    near = safe_divide(c, sum_)
    low, high = jnp.minimum(wide, near), jnp.maximum(wide, near)
    flat = (a > 0) & ~degenerate
    miss = flat & ((squared <= 0) | (y * a > b * dy))
    down = dy < 0
    enter = jnp.where(flat, low, jnp.where(down, high, -limit))
    leave = jnp.where(flat, high, jnp.where(down, limit, low))
    return jnp.where(miss, limit, enter), jnp.where(miss, -limit, leave)


def ray_polyhedron(polyhedron: dict[str, Any], pose: Pose, origin: Vec3, direction: Vec3) -> RayHit:
    """Entry into a convex polyhedron: the last of the planes that the ray passes inwards."""
    ray = local_ray(pose, origin, direction)
    normal, anchor = _planes(polyhedron["vertices"], polyhedron["faces"])
    # Components (shape, face, world) from here on.
    start, heading = (Vec3(*(c[:, None] for c in vector)) for vector in (ray.origin, ray.direction))
    slope, gap = dot(normal, heading), dot(normal, start - anchor)
    inwards, outwards = slope < -PARALLEL, slope > PARALLEL
    crossing = -gap / jnp.where(inwards | outwards, slope, 1.0)
    entering = jnp.where(inwards, crossing, -far(gap))
    leave = jnp.where(outwards, crossing, far(gap)).min(1)
    enter = entering.max(1)
    clear = ~((~inwards & ~outwards) & (gap > 0)).any(1)
    valid = clear & (enter <= leave) & (enter >= ray.begin) & (enter > -far(gap))
    code = settle_code(jnp.where(valid, entering.argmax(1).astype(enter.dtype), -1.0))
    chosen = code[:, None] == np.arange(gap.shape[1])[:, None]

    def pick(values: Array) -> Array:
        return jnp.where(chosen, values, 0.0).sum(1)

    return hit_at(pose, ray, code, pick(crossing), normal.map(pick))


def _planes(vertices: Vec3, faces: np.ndarray) -> tuple[Vec3, Vec3]:
    """Outward unit normal and mean corner of every face, components (shape, face, world).

    Normals by M. Newell's method over all corners, about the first one. (shape, face, corner, world) inside.
    """
    shapes = np.arange(faces.shape[0])[:, None, None]
    corners = vertices.map(lambda c: c[faces, shapes])
    arm = corners.map(lambda c: c - c[:, :, :1])
    following = arm.map(lambda c: jnp.roll(c, -1, axis=2))
    area = cross(arm, following).map(lambda c: c.sum(2))
    return area / norm(area), corners.map(lambda c: c[:, :, 0])


RayFunction = Callable[[dict[str, Any], Pose, Vec3, Vec3], RayHit]

RAYS: dict[str, RayFunction] = {
    "plane": ray_plane,
    "sphere": ray_sphere,
    "capsule": ray_capsule,
    "box": ray_box,
    "cylinder": ray_cylinder,
    "cone": ray_cone,
    "polyhedron": ray_polyhedron,
    "heightfield": ray_heightfield,
}
