"""The flat part of a shape that looks most along a direction: the one input of the general manifold.

`FACES` is the registry: a new shape with a support function and a face collides, with a manifold, with everything.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.collision.candidates import best_candidate, pick
from mathota_jax.collision.polyhedron import face_corners, face_normals
from mathota_jax.collision.rim import rim_points
from mathota_jax.spatial.settle import settle_code
from mathota_jax.spatial.vector import Vec3, dot, where

ROUND_CORNERS = 8
"""A disc is given as the inscribed octagon one corner of which is farthest along the direction."""
SEGMENT_BREADTH = 0.02
"""Share of its radius (or half its length, if less) by which a generator counts as broad: the surface falls away by
2e-4 of the radius there."""
SEGMENT_CORNERS = 4


class Face(NamedTuple):
    """Polygon or segment on the surface of a convex shape, in its own frame.

    Attributes:
        corners: Counter-clockwise from outside; components (corner, pair, world). Polygons of fewer corners repeat
            their last one, a segment from p to q reads p, q, q, p, p, ...
        normal: Outward unit normal; components (pair, world).
        breadth: Half the width [m] that a segment is taken to have; 0 for polygons.
        corner_ids: int32 numbers of the corners, stable while the shape turns, of the shape of a component of `corners`.
    """

    corners: Vec3
    normal: Vec3
    breadth: Array
    corner_ids: Array


class FaceFunction(Protocol):
    """Face of a shape (parameters) that looks most along a unit direction in the shape's frame, components (pair, world)."""

    def __call__(self, shape: dict[str, Any], direction: Vec3, /) -> Face:
        """Returns the face; its derivative is that of the face chosen."""
        ...


class FaceKind(NamedTuple):
    """How a kind makes faces.

    Attributes:
        function: See `FaceFunction`.
        flatness: 2 polygons only, 1 polygons and segments, 0 segments only.
        corner_count: How many corner ids there are; None: one for each vertex of the shape.
    """

    function: FaceFunction
    flatness: int
    corner_count: int | None


def box_face(box: dict[str, Any], direction: Vec3) -> Face:
    """One of six rectangles; corners are numbered by bits (x, y, z positive)."""
    half, frozen = box["half_extents"], lax.stop_gradient(direction)
    number = frozen.x.dtype
    best, code = jnp.abs(frozen.x), (frozen.x > 0).astype(number)
    for axis, value in ((1, frozen.y), (2, frozen.z)):
        better = jnp.abs(value) > best
        code = jnp.where(better, 2.0 * axis + (value > 0), code)
        best = jnp.where(better, jnp.abs(value), best)
    code = settle_code(code)
    axis, positive = code >> 1, code & 1
    sign = jnp.where(positive == 1, 1.0, -1.0).astype(number)
    normal = Vec3(*(jnp.where(axis == k, sign, 0.0) for k in range(3)))
    # Along the next two axes in cyclic order; a negative face is walked the other way round.
    first, second = _on_leading_axis([-1, 1, 1, -1], sign), _on_leading_axis([-1, -1, 1, 1], sign)
    forward, across = jnp.where(sign > 0, first, second), jnp.where(sign > 0, second, first)
    corners = Vec3(
        *(jnp.where(axis == k, sign, jnp.where(axis == (k - 1) % 3, forward, across)) * half[k] for k in range(3))
    )
    bits = [(corners[k] > 0).astype(jnp.int32) << k for k in range(3)]
    return Face(corners, normal, jnp.zeros_like(frozen.x), bits[0] + bits[1] + bits[2])


def _on_leading_axis(values: Any, like: Array) -> Array:
    return jnp.asarray(np.reshape(values, (-1,) + (1,) * like.ndim), like.dtype)


def polyhedron_face(polyhedron: dict[str, Any], direction: Vec3) -> Face:
    """One of the polygons; corners are numbered as vertices."""
    vertices: Vec3 = polyhedron["vertices"]
    normals = face_normals(polyhedron)
    _, code = best_candidate(dot(lax.stop_gradient(normals), lax.stop_gradient(direction)))
    # Looked up: a sum over a mask, as `pick` makes it, costs more the more corners and faces there are.
    ids = face_corners(polyhedron, code)
    return Face(vertices.map(lambda c: _looked_up(c, ids)), pick(normals, code), jnp.zeros_like(direction.x), ids)


def _looked_up(values: Array, ids: Array) -> Array:
    """Rows of (vertex, pair or 1, world or 1) by number (corner, pair, world)."""
    values = jnp.broadcast_to(values, (values.shape[0], *jnp.broadcast_shapes(values.shape[1:], ids.shape[1:])))
    return jnp.take_along_axis(values, ids, axis=0, mode="promise_in_bounds")


def cylinder_face(cylinder: dict[str, Any], direction: Vec3) -> Face:
    """An end disc, or the generator farthest along the direction.

    Corners 0-7 are the octants of the rim at -Y, 8-15 of that at +Y, 16 and 17 the ends of a generator.
    """
    radius, half_height = cylinder["radius"], cylinder["half_height"]
    code = _settled(jnp.abs(direction.y) >= jnp.sqrt(0.5), direction.y > 0)
    on_disc, top = code >= 2, code & 1
    sign = jnp.where(top == 1, 1.0, -1.0).astype(direction.y.dtype)
    disc, disc_ids = _disc(direction, sign, radius, sign * half_height)
    radial = _radial(direction)
    foot = Vec3(radius * radial.x, -half_height * jnp.ones_like(sign), radius * radial.z)
    generator, generator_ids = _segment(foot, Vec3(foot.x, -foot.y, foot.z), ROUND_CORNERS)
    cap = Vec3(jnp.zeros_like(sign), sign, jnp.zeros_like(sign))
    return Face(
        where(on_disc, disc, generator),
        where(on_disc, cap, radial),
        jnp.where(on_disc, 0.0, SEGMENT_BREADTH * jnp.minimum(radius, half_height)),
        jnp.where(on_disc, disc_ids + ROUND_CORNERS * top, generator_ids + 2 * ROUND_CORNERS),
    )


def cone_face(cone: dict[str, Any], direction: Vec3) -> Face:
    """The base, or the generator farthest along the direction.

    Corners 0-7 are the octants of the rim, 8 and 9 the foot and the apex of a generator.
    """
    radius, half_height = cone["radius"], cone["half_height"]
    radial = _radial(direction)
    one, zero = jnp.ones_like(direction.y), jnp.zeros_like(direction.y)
    slant = jnp.sqrt(radius * radius + 4.0 * half_height * half_height)
    side = Vec3(radial.x * (2.0 * half_height / slant), radius / slant * one, radial.z * (2.0 * half_height / slant))
    on_base = _settled(-direction.y >= dot(side, direction)) == 1
    disc, disc_ids = _disc(direction, -one, radius, -0.5 * half_height)
    foot = Vec3(radius * radial.x, -0.5 * half_height * one, radius * radial.z)
    generator, generator_ids = _segment(foot, Vec3(zero, 1.5 * half_height * one, zero), ROUND_CORNERS)
    return Face(
        where(on_base, disc, generator),
        where(on_base, Vec3(zero, -one, zero), side),
        jnp.where(on_base, 0.0, SEGMENT_BREADTH * jnp.minimum(radius, half_height)),
        jnp.where(on_base, disc_ids, generator_ids + ROUND_CORNERS),
    )


def capsule_face(capsule: dict[str, Any], direction: Vec3) -> Face:
    """The points of the two end spheres that are farthest along the direction: 0 at -Y, 1 at +Y."""
    radius, half_height = capsule["radius"], capsule["half_height"]
    end = direction * radius
    corners, ids = _segment(
        Vec3(end.x, end.y - half_height, end.z), Vec3(end.x, end.y + half_height, end.z), SEGMENT_CORNERS
    )
    breadth = SEGMENT_BREADTH * jnp.minimum(radius, half_height) * jnp.ones_like(end.x)
    return Face(corners, _radial(direction), breadth, ids)


def _settled(first: Array, second: Array | None = None) -> Array:
    """One or two conditions as one settled number, the first one being the higher bit."""
    number = first.astype(jnp.result_type(float))
    return settle_code(number if second is None else 2.0 * number + second)


def _radial(direction: Vec3) -> Vec3:
    """Unit vector away from the Y axis; local x, constant, where the direction runs along the axis."""
    squared = direction.x * direction.x + direction.z * direction.z
    usable = _settled(squared > jnp.finfo(squared.dtype).eps ** 2) == 1
    inverse = jnp.where(usable, 1.0 / jnp.sqrt(jnp.where(usable, squared, 1.0)), 0.0)
    x = jnp.where(usable, direction.x * inverse, 1.0)
    return Vec3(x, jnp.zeros_like(x), direction.z * inverse)


def _disc(direction: Vec3, sign: Array, radius: Any, height: Any) -> tuple[Vec3, Array]:
    """Octagon in the disc at `height`, whose outward normal is `sign` times Y, and the octants of its corners."""
    rim = rim_points(direction.x, direction.z)
    step = np.arange(ROUND_CORNERS)
    cosine = _on_leading_axis(np.cos(step * np.pi / 4), sign)
    sine = _on_leading_axis(np.sin(step * np.pi / 4), sign) * sign
    x, z = rim.x[0] * cosine + rim.z[0] * sine, rim.z[0] * cosine - rim.x[0] * sine
    turn = jnp.asarray(step.reshape((-1,) + (1,) * sign.ndim), jnp.int32) * (sign > 0)
    back = jnp.asarray(step.reshape((-1,) + (1,) * sign.ndim), jnp.int32) * (sign <= 0)
    return Vec3(radius * x, height * jnp.ones_like(x), radius * z), (2 * rim.quadrant[0] - turn + back) & 7


def _segment(start: Vec3, end: Vec3, count: int) -> tuple[Vec3, Array]:
    """Corners p, q, q, p, p, ... and their ids 0, 1, 1, 0, 0, ..."""
    at_end = np.zeros(count, bool)
    at_end[1:3] = True
    mask = at_end.reshape((-1,) + (1,) * jnp.ndim(start.x))
    return where(mask, end, start), jnp.asarray(mask, jnp.int32)


FACES: dict[str, FaceKind] = {
    "capsule": FaceKind(capsule_face, 0, 2),
    "box": FaceKind(box_face, 2, 8),
    "cylinder": FaceKind(cylinder_face, 1, 2 * ROUND_CORNERS + 2),
    "cone": FaceKind(cone_face, 1, ROUND_CORNERS + 2),
    "polyhedron": FaceKind(polyhedron_face, 2, None),
}
