"""The cells of a heightfield near a body: points, triangles and edges of a window of fixed size.

Everything is given in the frame of the heightfield (Y up) relative to the body's centre, which keeps float32 exact on
large grids. Grid arrays have the shape ``(row, column, pair, world)``, lists ``(item, pair, world)``.
"""

from __future__ import annotations

import functools
import math
import operator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.spatial.settle import settle
from mathota_jax.spatial.vector import Vec3, dot, normalize

NEIGHBOURS = ((1, 0), (1, 1), (0, 1), (-1, 0), (-1, -1), (0, -1))
"""Grid points that share an edge with a grid point, as offsets (row, column); the last three opposite to the first."""
SEAM = 1e-5
"""Triangles, and walls, overlap by this share of a cell, so that no point falls between them."""
DOWN = 4.0
"""By how many sizes of the body upright edges end below its centre."""


def window_size(reach: float, cell_size: float) -> int:
    """Cells along each side of a window that covers the projection of a body of radius `reach` [m], wherever it is."""
    return math.ceil(2.0 * reach / cell_size) + 1


class Window(NamedTuple):
    """Part of a heightfield.

    Attributes:
        field: Parameters of the heightfield.
        center: Centre of the body in the frame of the field [m].
        row, column: int32 (pair, world), grid indices of the first point.
        points: Grid points [m].
        lower, upper: Unit normals of the two triangles of each cell; the lower one has the corner ``(i + 1, j)``.
    """

    field: dict[str, Any]
    center: Vec3
    row: Array
    column: Array
    points: Vec3
    lower: Vec3
    upper: Vec3


class Triangles(NamedTuple):
    """Triangles, lower ones first: normal, first corner, whether it is an upper one (NumPy) and a stable id."""

    normal: Vec3
    corner: Vec3
    is_upper: np.ndarray
    number: Array


class Edges(NamedTuple):
    """Edges with the normals on either side, such that ``cross(minus, plus)`` runs along convex ones.

    Beyond the border of the grid the ground drops vertically. `exists` is False where the window, not the grid, ends;
    `upright` (edge, 1, 1) are those below the four corners.
    """

    start: Vec3
    span: Vec3
    minus: Vec3
    plus: Vec3
    exists: Array
    number: Array
    upright: np.ndarray


def gather_heights(heights: Array, row: Array, column: Array) -> Array:
    """Heights (..., pair, world) at the grid points of the given indices, which are held within the grid."""
    rows, columns = heights.shape[:2]
    index = jnp.clip(row, 0, rows - 1) * columns + jnp.clip(column, 0, columns - 1)
    flat = heights.reshape(rows * columns, *heights.shape[2:])
    if flat.shape[1:] == (1, 1):
        return flat[:, 0, 0][index]
    shape = jnp.broadcast_shapes(index.shape, flat.shape[1:])
    *_, element, world = jnp.indices(shape, sparse=True)
    index = jnp.broadcast_to(index, shape)
    return flat[index, jnp.minimum(element, flat.shape[1] - 1), jnp.minimum(world, flat.shape[2] - 1)]


def grid_window(field: dict[str, Any], center: Vec3, count: int) -> Window:
    """The window of `count` x `count` cells around the projection of a body, moved into the grid at its border."""
    heights, cell = field["heights"], field["cell_size"]
    rows, columns = heights.shape[:2]
    across = min(count, rows - 1), min(count, columns - 1)

    def first(along: Array, points: int, cells: int) -> Array:
        middle = along / cell + 0.5 * (points - 1)
        index = jnp.clip(jnp.floor(middle - 0.5 * cells + 0.5), 0, points - 1 - cells)
        return settle(index).astype(jnp.int32)

    row, column = first(center.x, rows, across[0]), first(center.z, columns, across[1])
    down = row + np.arange(across[0] + 1, dtype=np.int32).reshape(-1, 1, 1, 1)
    right = column + np.arange(across[1] + 1, dtype=np.int32).reshape(-1, 1, 1)
    number = center.x.dtype
    x = (down.astype(number) - 0.5 * (rows - 1)) * cell - center.x
    y = gather_heights(heights, down, right) - center.y
    z = (right.astype(number) - 0.5 * (columns - 1)) * cell - center.z
    shape = jnp.broadcast_shapes(x.shape, y.shape, z.shape)
    points = Vec3(*(jnp.broadcast_to(component, shape) for component in (x, y, z)))
    y = points.y
    corner, beyond, beside, opposite = y[:-1, :-1], y[1:, :-1], y[:-1, 1:], y[1:, 1:]
    lower = triangle_normal(beyond - corner, opposite - beyond, cell)
    upper = triangle_normal(opposite - beside, beside - corner, cell)
    return Window(field, center, row, column, points, lower, upper)


def triangle_normal(rise_row: Array, rise_column: Array, cell: Any) -> Vec3:
    """Upward unit normal of a triangle that rises so much per row and per column."""
    return normalize(Vec3(-rise_row, cell + 0.0 * rise_row, -rise_column))


def triangles(window: Window) -> Triangles:
    """All triangles of a window."""
    cells = window.lower.x.shape[0] * window.lower.x.shape[1]
    corner = window.points.map(lambda c: listed(c[:-1, :-1]))
    number = 2 * _point_numbers(window, -1, -1)
    return Triangles(
        normal=Vec3(
            *(jnp.concatenate([listed(a), listed(b)]) for a, b in zip(window.lower, window.upper, strict=True))
        ),
        corner=corner.map(lambda c: jnp.concatenate([c, c])),
        is_upper=np.repeat([False, True], cells).reshape(-1, 1, 1),
        number=jnp.concatenate([number, number + 1]),
    )


def edges(window: Window, size: Array) -> Edges:
    """All edges of a window: along rows, along columns, diagonal, upright, for bodies of that size [m]."""
    p, lower, upper = window.points, window.lower, window.upper
    down, right = lower.x.shape[:2]
    (first_row, last_row), (first_column, last_column) = _borders(window)

    def walled(normals: Vec3, axis: int, sign: float, front: bool) -> Vec3:
        """Normals with those of the wall at one border attached."""
        side = Vec3(*(sign if k == 2 - 2 * (axis == 0) else 0.0 for k in range(3)))

        def attach(component: Array, value: Any) -> Array:
            shape = list(component.shape)
            shape[axis] = 1
            wall = jnp.full(shape, value, component.dtype)
            return jnp.concatenate([wall, component] if front else [component, wall], axis)

        return Vec3(*(attach(c, v) for c, v in zip(normals, side, strict=True)))

    def border(count: int, first: Any, last: Any) -> Any:
        index = np.arange(count + 1).reshape(-1, 1, 1)
        return ((index > 0) | first) & ((index < count) | last)

    groups = [
        (
            p.map(lambda c: c[:-1]),
            p.map(lambda c: c[1:] - c[:-1]),
            walled(upper, 1, -1.0, True),
            walled(lower, 1, 1.0, False),
            border(right, first_column, last_column)[None],
            _point_numbers(window, -1, None),
        ),
        (
            p.map(lambda c: c[:, :-1]),
            p.map(lambda c: c[:, 1:] - c[:, :-1]),
            walled(upper, 0, 1.0, False),
            walled(lower, 0, -1.0, True),
            border(down, first_row, last_row)[:, None],
            _point_numbers(window, None, -1),
        ),
        (
            p.map(lambda c: c[:-1, :-1]),
            p.map(lambda c: c[1:, 1:] - c[:-1, :-1]),
            lower,
            upper,
            jnp.ones((1, 1, 1, 1), bool),
            _point_numbers(window, -1, -1),
        ),
        _upright_edges(window, size, (first_row, last_row), (first_column, last_column)),
    ]

    def joined(values: list[Any]) -> Vec3:
        return Vec3(*(jnp.concatenate([listed(v) for v in components]) for components in zip(*values, strict=True)))

    vectors = [joined([group[k] for group in groups]) for k in range(4)]
    exists = [listed(jnp.broadcast_to(g[4], (*g[0].x.shape[:2], *g[4].shape[2:]))) for g in groups]
    shape = jnp.broadcast_shapes(*(e.shape[1:] for e in exists))
    exists = jnp.concatenate([jnp.broadcast_to(e, (e.shape[0], *shape)) for e in exists])
    numbers = jnp.concatenate([4 * group[5] + k for k, group in enumerate(groups)])
    start, span, minus, plus = vectors
    upright = np.arange(len(numbers)).reshape(-1, 1, 1) >= len(numbers) - 4
    return Edges(start, span, minus, plus, exists, numbers, upright)


def _upright_edges(window: Window, size: Array, at_rows: tuple[Any, Any], at_columns: tuple[Any, Any]) -> tuple:
    """The edges below the corners of the window, those of the grid, as `edges` lists them: (2, 2, pair, world)."""
    start = window.points.map(lambda c: c[:: len(c) - 1, :: c.shape[1] - 1])
    zero = jnp.zeros_like(start.x)
    # Down to below the body, whose centre is the origin.
    span = Vec3(zero, -jnp.maximum(start.y, 0.0) - DOWN * size, zero)
    out = np.asarray([-1.0, 1.0])
    at_x = Vec3(zero + out.reshape(2, 1, 1, 1), zero, zero)
    at_z = Vec3(zero, zero, zero + out.reshape(1, 2, 1, 1))
    # Seen from above the walls follow each other as -x, -z, +x, +z.
    x_first = np.asarray([[True, False], [False, True]]).reshape(2, 2, 1, 1)
    minus = Vec3(*(jnp.where(x_first, a, b) for a, b in zip(at_x, at_z, strict=True)))
    plus = Vec3(*(jnp.where(x_first, b, a) for a, b in zip(at_x, at_z, strict=True)))
    exists = jnp.stack([jnp.stack([row & column for column in at_columns]) for row in at_rows])
    numbers = _point_numbers(window, None, None).reshape(*window.points.x.shape[:2], *window.row.shape)
    return start, span, minus, plus, exists, listed(numbers[:: len(numbers) - 1, :: numbers.shape[1] - 1])


def peak_cones(window: Window) -> tuple[list[tuple[Vec3, np.ndarray]], Array, Array, Array]:
    """What decides whether a direction looks out of the ground at a grid point.

    Returns:
        For each of `NEIGHBOURS` the way there (point, pair, world) and whether it is in the window (point, 1, 1);
        whether the point is known with all its neighbours; whether it is at the border of the grid; its number.
    """
    count_down, count_right = window.points.x.shape[:2]
    ways = []
    down = np.arange(count_down).reshape(-1, 1)
    right = np.arange(count_right).reshape(1, -1)
    for i, j in NEIGHBOURS:
        way = window.points.map(lambda c, i=i, j=j: listed(jnp.roll(c, (-i, -j), (0, 1)) - c))
        present = (down + i >= 0) & (down + i < count_down) & (right + j >= 0) & (right + j < count_right)
        ways.append((way, present.reshape(-1, 1, 1)))
    d, r = down[..., None, None], right[..., None, None]
    (first_row, last_row), (first_column, last_column) = _borders(window)
    ends = (
        (d == 0, first_row),
        (d == count_down - 1, last_row),
        (r == 0, first_column),
        (r == count_right - 1, last_column),
    )
    known = functools.reduce(operator.and_, (~last | border for last, border in ends))
    at_border = functools.reduce(operator.or_, (last & border for last, border in ends))
    return ways, listed(known), listed(at_border), _point_numbers(window, None, None)


def _borders(window: Window) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Whether the first and the last points of a window, along rows and along columns, are those of the grid."""
    (rows, columns), (down, right) = window.field["heights"].shape[:2], window.points.x.shape[:2]
    return (window.row == 0, window.row == rows - down), (window.column == 0, window.column == columns - right)


def _point_numbers(window: Window, stop_down: int | None, stop_right: int | None) -> Array:
    """Numbers (item, pair, world) of the window's grid points, the last ones left out, in the whole grid."""
    columns = window.field["heights"].shape[1]
    down = np.arange(window.points.x.shape[0], dtype=np.int32)[:stop_down].reshape(-1, 1, 1, 1)
    right = np.arange(window.points.x.shape[1], dtype=np.int32)[:stop_right].reshape(-1, 1, 1)
    return listed((window.row + down) * columns + window.column + right)


def listed(grid: Array) -> Array:
    """(row, column, ...) as (item, ...)."""
    return grid.reshape(-1, *grid.shape[2:])


class Ground(NamedTuple):
    """The triangle under (or over) a point: unit normal, first corner, and whether there is one."""

    normal: Vec3
    corner: Vec3
    row: Array
    column: Array
    is_upper: Array
    exists: Array


def ground_at(window: Window, point: Vec3) -> Ground:
    """The triangle in the column of each point (..., pair, world); the nearest one where the grid has ended."""
    heights, cell = window.field["heights"], window.field["cell_size"]
    rows, columns = heights.shape[:2]
    x, z = lax.stop_gradient((point.x + window.center.x, point.z + window.center.z))
    u, v = x / cell + 0.5 * (rows - 1), z / cell + 0.5 * (columns - 1)
    row, column = jnp.clip(jnp.floor(u), 0, rows - 2), jnp.clip(jnp.floor(v), 0, columns - 2)
    # One number for all three choices, computed once.
    outside = (u < 0) | (v < 0) | (u > rows - 1) | (v > columns - 1)
    row, column = settle(row), settle(column)
    kind = settle(jnp.where(outside, 2.0, 0.0) + (v - column > u - row)).astype(jnp.int32)
    upper = (kind & 1) == 1
    i, j = row.astype(jnp.int32), column.astype(jnp.int32)
    corner = gather_heights(heights, i, j)
    opposite = gather_heights(heights, i + 1, j + 1)
    third = gather_heights(heights, i + jnp.where(upper, 0, 1), j + jnp.where(upper, 1, 0))
    rise_row = jnp.where(upper, opposite - third, third - corner)
    rise_column = jnp.where(upper, third - corner, opposite - third)
    at = Vec3(
        (row - 0.5 * (rows - 1)) * cell - window.center.x,
        corner - window.center.y,
        (column - 0.5 * (columns - 1)) * cell - window.center.z,
    )
    return Ground(triangle_normal(rise_row, rise_column, cell), at, i, j, upper, kind < 2)


def margin(point: Vec3, corner: Vec3, is_upper: Any, cell: Any) -> Array:
    """How far a point is inside of the sides of a triangle, seen from above, in cells; negative outside."""
    a, b = (point.x - corner.x) / cell, (point.z - corner.z) / cell
    low, high = jnp.where(is_upper, a, b), jnp.where(is_upper, b, a)
    return jnp.minimum(jnp.minimum(low, high - low), 1.0 - high)


def height_over(normal: Vec3, corner: Vec3, point: Vec3) -> Array:
    """Distance of a point from a plane."""
    return dot(normal, point - corner)
