"""Where a ray meets a heightfield: at a wall, or by a walk through the triangles below it, a fixed number of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.height_grid import gather_heights
from mathota_jax.collision.ray_frame import PARALLEL, LocalRay, RayHit, far, hit_at, local_ray, slab
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import settle, settle_code
from mathota_jax.spatial.vector import Vec3, norm


class _GridRay(NamedTuple):
    """Ray in units of cells: `u` and `v` count grid rows and columns, `y` is the height [m]."""

    u: Array
    v: Array
    y: Array
    du: Array
    dv: Array
    dy: Array


class _Walk(NamedTuple):
    """State of the walk: where it is, whether above the surface there, and the triangle hit (-1 for none yet)."""

    parameter: Array
    above: Array
    row: Array
    column: Array
    upper: Array


def ray_heightfield(field: dict[str, Any], pose: Pose, origin: Vec3, direction: Vec3) -> RayHit:
    """First place where a ray enters the ground: from above, or through a wall under the border."""
    ray = local_ray(pose, origin, direction)
    grid = _in_cells(field, ray)
    surface = _on_surface(field, pose, ray, grid)
    rows, columns = field["heights"].shape[:2]
    axis = _wall(*lax.stop_gradient((grid, ray, field["heights"])))
    along_u, along_v = (
        -(p - 0.5 * (count - 1) + jnp.sign(rate) * 0.5 * (count - 1)) / jnp.where(jnp.abs(rate) > PARALLEL, rate, 1.0)
        for p, rate, count in ((grid.u, grid.du, rows), (grid.v, grid.dv, columns))
    )
    zero = jnp.zeros_like(grid.y)
    outward = Vec3(jnp.where(axis == 1, -jnp.sign(grid.du), zero), zero, jnp.where(axis == 2, -jnp.sign(grid.dv), zero))
    code = jnp.where(axis > 0, 0, -1)
    wall = hit_at(pose, ray, code, jnp.where(axis == 1, along_u, along_v), outward)
    return jax.tree.map(lambda of_wall, of_surface: jnp.where(wall.hit, of_wall, of_surface), wall, surface)


def _in_cells(field: dict[str, Any], ray: LocalRay) -> _GridRay:
    cell, (rows, columns) = field["cell_size"], field["heights"].shape[:2]
    return _GridRay(
        ray.origin.x / cell + 0.5 * (rows - 1),
        ray.origin.z / cell + 0.5 * (columns - 1),
        ray.origin.y,
        ray.direction.x / cell,
        ray.direction.z / cell,
        ray.direction.y,
    )


def ray_surface(field: dict[str, Any], pose: Pose, origin: Vec3, direction: Vec3) -> RayHit:
    """First place where a ray comes from above the surface to below it; it passes through the walls."""
    ray = local_ray(pose, origin, direction)
    return _on_surface(field, pose, ray, _in_cells(field, ray))


def _on_surface(field: dict[str, Any], pose: Pose, ray: LocalRay, grid: _GridRay) -> RayHit:
    """Where a ray comes from above the surface to below it.

    Along the ray the surface is straight between the places where the ray passes a grid line or a diagonal (J. Amanatides
    and A. Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing", 1987). The height over the surface is carried from one
    such place to the next, so that no ray slips between two triangles. The walk is a search; the hit is then computed,
    differentiably, from the triangle found. Heights have shape (row, column, shape, world).
    """
    heights, cell = field["heights"], field["cell_size"]
    walk = _search(*lax.stop_gradient((grid, ray, heights, cell)))
    height, slope_u, slope_v = _plane(heights, walk.row, walk.column, walk.upper)
    gap = grid.y - (height + slope_u * (grid.u - walk.row) + slope_v * (grid.v - walk.column))
    rate = grid.dy - slope_u * grid.du - slope_v * grid.dv
    # A ray that came from above descends against the plane, if only by round-off.
    code = jnp.where(walk.row >= 0, 0, -1)
    usable = (code >= 0) & (rate < -PARALLEL)
    parameter = jnp.where(usable, -gap / jnp.where(usable, rate, -1.0), lax.stop_gradient(walk.parameter))
    normal = Vec3(-slope_u / cell, jnp.ones_like(slope_u), -slope_v / cell)
    normal = normal / norm(normal)
    return hit_at(pose, ray, code, parameter, normal.map(lambda c: jnp.where(code >= 0, c, 0.0)))


def _wall(grid: _GridRay, ray: LocalRay, heights: Array) -> Array:
    """Whether a ray comes from outside through a wall: 1 for one at an end of x, 2 of z, 0 for none."""
    rows, columns = heights.shape[:2]
    enter_u, leave_u = slab(grid.u - 0.5 * (rows - 1), grid.du, 0.5 * (rows - 1))
    enter_v, leave_v = slab(grid.v - 0.5 * (columns - 1), grid.dv, 0.5 * (columns - 1))
    enter = jnp.maximum(enter_u, enter_v)
    comes_in = (enter >= ray.begin) & (enter <= jnp.minimum(leave_u, leave_v))
    at = jnp.where(comes_in, enter, ray.begin)
    below = ~_above(grid, heights, at, *_triangle(grid, at, rows, columns))
    return settle_code(jnp.where(comes_in & below, jnp.where(enter_u > enter_v, 1.0, 2.0), 0.0).astype(enter.dtype))


def _above(grid: _GridRay, heights: Array, parameter: Array, row: Array, column: Array, upper: Array) -> Array:
    """Whether a ray is not below the plane of a triangle, at a parameter."""
    height, slope_u, slope_v = _plane(heights, row, column, upper)
    u, v = grid.u + parameter * grid.du, grid.v + parameter * grid.dv
    return grid.y + parameter * grid.dy >= height + slope_u * (u - row) + slope_v * (v - column)


def _search(grid: _GridRay, ray: LocalRay, heights: Array, cell: Array) -> _Walk:
    rows, columns = heights.shape[:2]
    low, high = heights.min((0, 1)), heights.max((0, 1))
    # The walk begins a little above the highest point, so that the highest point too is met from above.
    margin = 1e-3 * (high - low + jnp.abs(high) + jnp.abs(low) + cell)
    sides = [
        slab(grid.u - 0.5 * (rows - 1), grid.du, 0.5 * (rows - 1)),
        slab(grid.v - 0.5 * (columns - 1), grid.dv, 0.5 * (columns - 1)),
        slab(grid.y - 0.5 * (high + low), grid.dy, 0.5 * (high - low) + margin),
    ]
    start, end = ray.begin, far(ray.begin)
    for enter, leave in sides:
        start, end = jnp.maximum(start, enter), jnp.minimum(end, leave)
    start, end = settle(start), settle(end)
    none = jnp.full(start.shape, -1, jnp.int32)

    def turn(_: Array, walk: _Walk) -> _Walk:
        here = walk.parameter
        following = jnp.minimum(jnp.minimum(_next(grid.u, grid.du, here), _next(grid.v, grid.dv, here)), end)
        following = settle(jnp.minimum(following, _next(grid.u - grid.v, grid.du - grid.dv, here)))
        middle = 0.5 * (here + following)
        row, column, upper = _triangle(grid, middle, rows, columns)
        first = walk.parameter == start
        above = jnp.where(first, _above(grid, heights, here, row, column, upper), walk.above)
        below = settle((~_above(grid, heights, following, row, column, upper)).astype(here.dtype)) > 0.5
        found = above & below & (walk.row < 0) & (here < end)
        return _Walk(
            jnp.where(walk.row < 0, following, here),
            ~below,
            jnp.where(found, row, walk.row),
            jnp.where(found, column, walk.column),
            jnp.where(found, upper, walk.upper),
        )

    initial = _Walk(start, jnp.zeros(start.shape, bool), none, none, none)
    # A straight line passes at most so many rows, columns and diagonals.
    return lax.fori_loop(0, 2 * (rows + columns), turn, initial)


def _next(coordinate: Array, rate: Array, parameter: Array) -> Array:
    """Parameter at which a coordinate next takes a whole value."""
    moving = jnp.abs(rate) > PARALLEL
    here = coordinate + parameter * rate
    slack = 8.0 * jnp.finfo(here.dtype).eps * (1.0 + jnp.abs(here) + jnp.abs(coordinate))
    line = jnp.where(rate > 0, jnp.floor(here + slack) + 1.0, jnp.ceil(here - slack) - 1.0)
    return jnp.where(moving, (line - coordinate) / jnp.where(moving, rate, 1.0), far(here))


def _triangle(grid: _GridRay, parameter: Array, rows: int, columns: int) -> tuple[Array, Array, Array]:
    """Row and column of the cell at a parameter, and whether the point lies in its half with the larger column."""
    u, v = grid.u + parameter * grid.du, grid.v + parameter * grid.dv
    row = jnp.clip(jnp.floor(u), 0, rows - 2)
    column = jnp.clip(jnp.floor(v), 0, columns - 2)
    upper = settle((v - column > u - row).astype(u.dtype))
    return settle(row).astype(jnp.int32), settle(column).astype(jnp.int32), upper.astype(jnp.int32)


def _plane(heights: Array, row: Array, column: Array, upper: Array) -> tuple[Array, Array, Array]:
    """Height [m] at the cell's first corner and rise per row and per column of one of its two triangles."""

    def at(down: Any, right: Any) -> Array:
        return gather_heights(heights, row + down, column + right)

    corner, opposite = at(0, 0), at(1, 1)
    third = at(1 - upper, upper)
    is_upper = upper == 1
    slope_u = jnp.where(is_upper, opposite - third, third - corner)
    slope_v = jnp.where(is_upper, third - corner, opposite - third)
    return corner, slope_u, slope_v
