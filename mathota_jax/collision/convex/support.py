"""Support functions of the convex shapes, in two steps: which piece of the shape is extreme, and where it is.

A *piece* is a part of the shape whose own support function is smooth: a vertex of a polytope, an end of a capsule's axis,
a rim of a cylinder, the base rim or the apex of a cone. The search deals in piece codes (small integers, each chosen
once, see `settle`); the differentiable part computes the points of given pieces. Faces, edges, the side of a cylinder or
cone appear as several pieces that are extreme at once.

Spheres and capsules are treated as their core (centre, axis) inflated by the radius. All components have the shape
``(pair, world)``; directions need not have unit length.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.spatial.indexing import gather_together, unstack
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once, settle_code, store
from mathota_jax.spatial.vector import Vec3, norm

Parameters = dict[str, Any]

UNROLLED_VERTICES = 24
"""Polyhedra with more vertices are searched by a loop, which compiles fast whatever their number."""


class Support(NamedTuple):
    """Support function of one kind of shape.

    Attributes:
        code: Piece that is extreme along a local direction, as a settled int32.
        point: Extreme local point [m] of a given piece along a local direction; differentiable.
        extent: Upper bound [m] of the distance of core points from the origin.
        rim_radius: Radius [m] of the circle that is a given piece (0 where it is a point); None for shapes without.
        inflation: Radius [m] added around the core; None where there is none.
        side: Parts of the unit normal of the round side away from the y axis and along it; None without a round side.
    """

    code: Callable[[Parameters, Vec3], Array]
    point: Callable[[Parameters, Array, Vec3], Vec3]
    extent: Callable[[Parameters], Array]
    rim_radius: Callable[[Parameters, Array], Array] | None = None
    inflation: Callable[[Parameters], Array] | None = None
    side: Callable[[Parameters], tuple[Array, Array]] | None = None


def support(kind: str, shape: Parameters, direction: Vec3) -> tuple[Vec3, Array]:
    """Core point of a shape that lies furthest along a direction, in the local frame, and the int32 code of its piece.

    Args:
        kind: Key of `SUPPORT`.
        shape: Parameters of the shape.
        direction: Local direction, any length.
    """
    functions = SUPPORT[kind]
    code = functions.code(lax.stop_gradient(shape), lax.stop_gradient(direction))
    return functions.point(shape, code, direction), code


def _sign(positive: Any, like: Array) -> Array:
    return jnp.where(positive, 1.0, -1.0).astype(like.dtype)


def _upward(shape: Parameters, direction: Vec3) -> Array:
    return settle_code((direction.y + 0.0 * shape["half_height"] >= 0).astype(direction.y.dtype))


def _sphere_code(shape: Parameters, direction: Vec3) -> Array:
    return jnp.zeros(jnp.shape(direction.x + shape["radius"]), jnp.int32)


def _sphere_point(shape: Parameters, code: Array, direction: Vec3) -> Vec3:
    zero = jnp.zeros_like(direction.x + shape["radius"])
    return Vec3(zero, zero, zero)


def _capsule_point(shape: Parameters, code: Array, direction: Vec3) -> Vec3:
    zero = jnp.zeros_like(direction.x)
    return Vec3(zero, _sign(code == 1, direction.y) * shape["half_height"], zero)


def _box_code(shape: Parameters, direction: Vec3) -> Array:
    positive = [(d + 0.0 * h >= 0).astype(d.dtype) for d, h in zip(direction, shape["half_extents"], strict=True)]
    return settle_code(positive[0] + 2.0 * positive[1] + 4.0 * positive[2])


def _box_point(shape: Parameters, code: Array, direction: Vec3) -> Vec3:
    half = shape["half_extents"]
    return Vec3(*(_sign((code >> k) & 1 == 1, h) * h for k, h in enumerate(half)))


def _radial(radius: Any, direction: Vec3) -> tuple[Array, Array]:
    """Point of a circle about the y axis furthest along a direction; its centre where that is the axis."""
    zero = jnp.zeros_like(direction.x)
    inverse = safe_divide(jnp.ones_like(zero), norm(Vec3(direction.x, zero, direction.z)))
    return radius * direction.x * inverse, radius * direction.z * inverse


def _cylinder_point(shape: Parameters, code: Array, direction: Vec3) -> Vec3:
    x, z = _radial(shape["radius"], direction)
    return Vec3(x, _sign(code == 1, direction.y) * shape["half_height"], z)


def _cylinder_rim(shape: Parameters, code: Array) -> Array:
    return shape["radius"] + 0.0 * code


def _cone_code(shape: Parameters, direction: Vec3) -> Array:
    base = shape["radius"] * jnp.sqrt(direction.x * direction.x + direction.z * direction.z)
    return settle_code((2.0 * shape["half_height"] * direction.y > base).astype(direction.y.dtype))


def _cone_point(shape: Parameters, code: Array, direction: Vec3) -> Vec3:
    """The origin is the centroid: the apex is at 3/2, the base at -1/2 of the half height."""
    x, z = _radial(_cone_rim(shape, code), direction)
    return Vec3(x, jnp.where(code == 1, 1.5, -0.5) * shape["half_height"], z)


def _cone_rim(shape: Parameters, code: Array) -> Array:
    return jnp.where(code == 1, 0.0, shape["radius"])


def _cylinder_side(shape: Parameters) -> tuple[Array, Array]:
    zero = jnp.zeros_like(shape["radius"])
    return zero + 1.0, zero


def _cone_side(shape: Parameters) -> tuple[Array, Array]:
    height, radius = 2.0 * shape["half_height"], shape["radius"]
    inverse = lax.rsqrt(height * height + radius * radius)
    return height * inverse, radius * inverse


def _polyhedron_code(shape: Parameters, direction: Vec3) -> Array:
    vertices = shape["vertices"]
    count = vertices.x.shape[0]

    def along(index: Any) -> Array:
        return vertices.x[index] * direction.x + vertices.y[index] * direction.y + vertices.z[index] * direction.z

    first = along(0)
    best, code = first, jnp.zeros_like(first)

    def keep_better(index: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        best, code = state
        this = along(index)
        better = this > best
        return jnp.where(better, this, best), jnp.where(better, jnp.asarray(index, code.dtype), code)

    if count <= UNROLLED_VERTICES:
        for index in range(1, count):
            best, code = keep_better(index, (best, code))
    else:
        best, code = lax.fori_loop(1, count, keep_better, (best, code))
    return settle_code(code)


def _polyhedron_point(shape: Parameters, code: Array, direction: Vec3) -> Vec3:
    vertices = shape["vertices"]
    if vertices.x.shape[0] > UNROLLED_VERTICES:
        return vertices.map(lambda component: _gathered(component, code))
    if vertices.x.shape[-1] > 1:
        return compute_once(vertices.map(lambda component: _selected(component, code)), direction.x)
    # Corners that all worlds share are looked up in one kernel.
    rows = jnp.stack(vertices, axis=1)
    rows = rows.reshape(*rows.shape[:2], *(1,) * (code.ndim + 2 - rows.ndim), *rows.shape[2:])
    found = _selected(rows, code)
    return Vec3(*unstack(store(found, found), 0))


def _selected(rows: Array, code: Array) -> Array:
    """Row `code` of a few, by halving: a third fewer instructions than one comparison for each row."""
    bit = 0
    candidates = [rows[index] for index in range(rows.shape[0])]
    while len(candidates) > 1:
        odd = (code >> bit) & 1 == 1
        pairs = zip(candidates[::2], [*candidates[1::2], None], strict=False)
        candidates = [first if second is None else jnp.where(odd, second, first) for first, second in pairs]
        bit += 1
    return jnp.broadcast_to(candidates[0], jnp.broadcast_shapes(candidates[0].shape, code.shape))


def _gathered(component: Array, code: Array) -> Array:
    count = component.shape[0]
    component = component.reshape(count, *(1,) * (code.ndim + 1 - component.ndim), *component.shape[1:])
    full = jnp.broadcast_to(component, (count, *jnp.broadcast_shapes(component.shape[1:], code.shape)))
    return jnp.take_along_axis(full, jnp.broadcast_to(code, full.shape[1:])[None], axis=0)[0]


def _polyhedron_extent(shape: Parameters) -> Array:
    vertices = shape.get("table", shape["vertices"])
    extent = jnp.sqrt(jnp.max(vertices.x**2 + vertices.y**2 + vertices.z**2, axis=0))
    return gather_together(extent, shape["row"]) if "row" in shape else extent


def _radius(shape: Parameters) -> Array:
    return shape["radius"]


SUPPORT: dict[str, Support] = {
    "sphere": Support(_sphere_code, _sphere_point, lambda s: 0.0 * s["radius"], inflation=_radius),
    "capsule": Support(_upward, _capsule_point, lambda s: s["half_height"], inflation=_radius),
    "box": Support(_box_code, _box_point, lambda s: norm(s["half_extents"])),
    "cylinder": Support(
        _upward, _cylinder_point, lambda s: s["radius"] + s["half_height"], _cylinder_rim, side=_cylinder_side
    ),
    "cone": Support(
        _cone_code, _cone_point, lambda s: s["radius"] + 1.5 * s["half_height"], _cone_rim, side=_cone_side
    ),
    "polyhedron": Support(_polyhedron_code, _polyhedron_point, _polyhedron_extent),
}
"""Registry: kind -> support function."""
