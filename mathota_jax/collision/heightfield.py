"""Convex shapes against a heightfield: contacts of faces, ridges and peaks of the ground under the body.

The ground is not convex; near each contact it is. A contact is a local extremum: a direction ``up`` in which the body
is parted best from a face, a ridge or a peak, where `up` belongs to the normals of that feature (the face's normal, the
arc between the normals of the two faces of a ridge, the cone between those around a peak). So an edge inside of flat
ground has no contact of its own, and no ghost normal.

- Faces: the point of the body that is extreme against the face's normal.
- Ridges: a search along the arc of normals by bisection; only the support function of the body is needed.
- Peaks: the closed-form distance of a point from the body.
- In the ground all three go by the height of the ground over the body's underside instead of the distance. Over each
  triangle it is a concave function, so its highest value is at one of these places; the nearest way out need not be.
- The points on which the body would stand on a plane, each against the triangle under it: they span the base.
- Beside the field: the points nearest to the wall under its border, instead of what would lift the body over it.

The deepest of all these and up to three that differ most from it are kept.

Source: the Gauss map of features, as in D. Gregorius, "The Separating Axis Test between Convex Polyhedra" (GDC 2013).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.collision.candidates import LEAN, LEAN_SHARE, best_candidate, depth_tolerance, pick
from mathota_jax.collision.convex.support import SUPPORT
from mathota_jax.collision.height_grid import (
    DOWN,
    SEAM,
    Window,
    grid_window,
    ground_at,
    height_over,
    listed,
    margin,
    peak_cones,
    triangles,
)
from mathota_jax.collision.heightfield_ridges import looks_up, ridge_contacts
from mathota_jax.collision.heightfield_walls import LEVEL, Wall, along_wall, depth_under, inside_border, nearest_wall
from mathota_jax.collision.manifold import ContactPoint, Manifold
from mathota_jax.collision.rays import RAYS
from mathota_jax.geometry.bounds import bounding_radius
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.settle import compute_once, settle
from mathota_jax.spatial.spread import greatest
from mathota_jax.spatial.vector import Mat3, Vec3, cross, dot, norm, where

FLAT = 1e-5
"""A grid point must stand out of its neighbours' plane by this share of a cell to be a peak."""
LEANING = 0.02
"""Sine by which a direction may look into the ground at a grid point of a ridge or a rim. Under a body that lies flat on a
ridge it does so at all points but the highest: with that alone the body would rock on one point after the other, and what
lies on a plateau that is smaller would have no corner below it."""
MERGE = 1e-3
"""Contacts closer than this share of the body's size, normals included, are one."""
HEIGHT_WEIGHT = 10.0
"""A contact higher than the deepest one must widen the base by this many times the height (see `plane_polyhedron`)."""
NEAR, TOUCHING = 0.004, 0.01
"""What is at most this share of the body's size above the deepest contact comes before all that is higher, where that
contact is closer to the ground than the second share. A place that a corner some mm above the ground takes from a point that
bears the body lets it fall for a step: of plates of 0.3 m on bumps of 1 cm 50 of 96 never came to rest without this, 5 do
not with it. A body that is still falling needs what spans it: without the second share the deepest overlap of boxes that
land at 2 m/s grew from 13 to 35 mm."""
WALL_FEATURES = 1024
"""More than the features of a plane with any shape."""
ABSENT = 1e6
"""Separation, in units of the body's size, where there is no ground."""


class Kind(NamedTuple):
    """What is known of a convex kind.

    Attributes:
        name: Key of `SUPPORT`.
        point_distance: Pair function of a sphere with the kind.
        flat_contacts: Pair function of a plane with the kind; None for the kinds that are an inflated core, whose ends
            are tested against every face.
    """

    name: str
    point_distance: Callable[..., Manifold]
    flat_contacts: Callable[..., Manifold] | None = None


class Candidates(NamedTuple):
    """Possible contacts, components (candidate, pair, world), in the frame of the field from the body's centre on.

    `ground` is the point on the ground, `up` the unit normal out of it.
    """

    ground: Vec3
    up: Vec3
    separation: Array
    feature: Array
    valid: Array


def heightfield_contacts(known: Kind, a: dict[str, Any], pose_a: Pose, b: dict[str, Any], pose_b: Pose) -> Manifold:
    """Up to four contacts of a convex shape with a heightfield, the deepest first.

    Every point has its own normal; that of the manifold is the deepest one's. Where there is no ground under the body and
    no wall beside it no point is active.

    Args:
        known: Kind of A.
        a: Parameters of A.
        pose_a: Pose of A; a sphere needs no rotation.
        b: "heights" (row, column, pair, world), "cell_size" (pair, world) and "window", an int: how many cells along
            each side are tested (see `window_size`).
        pose_b: Pose of the heightfield.
    """
    kind = known.name
    assert pose_b.rotation is not None
    center = pose_b.point_to_local(pose_a.position)
    rotation = _relative(pose_a.rotation, pose_b.rotation, center)
    center, rotation = compute_once((center, rotation), center.x)
    window = grid_window(b, center, b["window"])
    size = lax.stop_gradient(bounding_radius(kind, a)) + jnp.zeros_like(center.x)

    wall = nearest_wall(kind, a, rotation, window, size)
    ridges, at_border = _ridges(kind, a, rotation, window, size, wall)
    upper = _joined([*_face_contacts(kind, a, rotation, window), ridges, _peaks(known, a, rotation, window, wall)])
    # What lies deeper than the wall would lift a body over the border that comes in from beside.
    lifts = wall.beside & (lax.stop_gradient(upper.separation) < -wall.way - MERGE * size)
    upper = upper._replace(valid=upper.valid & ~lifts)
    if known.flat_contacts is None:
        base = _wall_cores(kind, a, rotation, window, wall, size)
    else:
        base = _base(known.flat_contacts, a, rotation, window, upper, wall, size)
    candidates = _joined([upper, base])
    # The same holds for an edge of a wall, near it; in between the body lies on both.
    overlap = jnp.where(ridges.valid & at_border, -lax.stop_gradient(ridges.separation), 0.0)
    way_out = greatest(overlap)
    way_out = jnp.where(way_out > 0, way_out + LEVEL * size, ABSENT * size)
    remains = lax.stop_gradient(candidates.separation) > -way_out
    remains |= inside_border(window, lax.stop_gradient(candidates.ground)) > way_out
    candidates = candidates._replace(valid=candidates.valid & (settle(remains.astype(size.dtype)) > 0.5))
    chosen = _reduced(candidates, size, base.separation.shape[0])
    return _manifold(candidates, chosen, size, pose_a, pose_b)


def _relative(rotation_a: Mat3 | None, rotation_b: Mat3, like: Vec3) -> Mat3:
    """Field from body; a sphere is never turned."""
    if rotation_a is None:
        one, zero = jnp.ones_like(like.x), jnp.zeros_like(like.x)
        return Mat3(Vec3(one, zero, zero), Vec3(zero, one, zero), Vec3(zero, zero, one))
    return Mat3(*(rotation_b.apply_transposed(column) for column in rotation_a))


def _inflation(kind: str, a: dict[str, Any]) -> Any:
    inflation = SUPPORT[kind].inflation
    return 0.0 if inflation is None else inflation(a)


def _face_contacts(kind: str, a: dict[str, Any], rotation: Mat3, window: Window) -> list[Candidates]:
    """Core points of the body against the triangles they are over (or, inside the ground, under)."""
    faces = triangles(window)
    if SUPPORT[kind].inflation is not None:
        cores = _core_ends(kind, a, rotation, jnp.zeros_like(faces.normal.x))
    else:
        local = rotation.apply_transposed(-faces.normal)
        code = SUPPORT[kind].code(*lax.stop_gradient((a, local)))
        cores = [rotation.apply(SUPPORT[kind].point(a, code, local))]
    cell = window.field["cell_size"]
    found = []
    for index, core in enumerate(cores):
        height = height_over(faces.normal, faces.corner, core)
        foot = core - faces.normal * height
        frozen = lax.stop_gradient((core, foot, height, faces.corner, cell))
        valid = settle(_over_face(*frozen, faces.is_upper).astype(height.dtype)) > 0.5
        feature = 2 * faces.number + index
        found.append(Candidates(foot, faces.normal, height - _inflation(kind, a), feature, valid))
    return found


def _core_ends(kind: str, a: dict[str, Any], rotation: Mat3, zero: Array) -> list[Vec3]:
    """Centre of a sphere, ends of a capsule's axis."""
    if kind == "sphere":
        return [Vec3(zero, zero, zero)]
    half = rotation.column_y * a["half_height"]
    return [-half, half]


def _wall_cores(kind: str, a: dict[str, Any], rotation: Mat3, window: Window, wall: Wall, size: Array) -> Candidates:
    """Those against the wall."""
    ends = _core_ends(kind, a, rotation, jnp.zeros_like(size))
    core = Vec3(*(_stacked([end[axis] for end in ends], size) for axis in range(3)))
    feature = jnp.arange(len(ends), dtype=jnp.int32).reshape(-1, 1, 1)
    found = _on_wall(core, _inflation(kind, a), feature, window, wall, size)
    return found._replace(valid=found.valid & wall.beside)


def _on_wall(corner: Vec3, inflation: Any, feature: Array, window: Window, wall: Wall, size: Array) -> Candidates:
    """Points of the body (candidate, pair, world) against the wall, those under the border."""
    height = dot(wall.up, corner) - wall.offset
    foot = corner - wall.up * height
    under = depth_under(window, corner) > 0
    valid = settle((under & along_wall(window, lax.stop_gradient(foot))).astype(height.dtype)) > 0.5
    number = 9 * _grid_count(window) + WALL_FEATURES * (wall.number + 1) + feature
    up = wall.up.map(lambda c: jnp.broadcast_to(c, height.shape))
    return Candidates(foot, up, height - inflation, number, valid)


def _over_face(core: Vec3, foot: Vec3, height: Array, corner: Vec3, cell: Any, is_upper: Any) -> Array:
    """Whether a triangle is nearest to a point above it or is straight over one in the ground."""
    return margin(where(height >= 0, foot, core), corner, is_upper, cell) >= -SEAM


def _ridges(
    kind: str, a: dict[str, Any], rotation: Mat3, window: Window, size: Array, wall: Wall
) -> tuple[Candidates, Array]:
    """Contacts of ridges, and which of them are those of the border."""
    ridge = ridge_contacts(kind, a, rotation, window, size, wall)
    number, separation = 4 * _grid_count(window) + ridge.number, ridge.separation - _inflation(kind, a)
    return Candidates(ridge.ground, ridge.up, separation, number, ridge.valid), ridge.at_border


def _grid_count(window: Window) -> int:
    rows, columns = window.field["heights"].shape[:2]
    return rows * columns


def _peaks(known: Kind, a: dict[str, Any], rotation: Mat3, window: Window, wall: Wall) -> Candidates:
    """Grid points against the body, where the direction looks out of the ground."""
    ways, complete, at_border, number = peak_cones(window)
    points = window.points.map(listed)
    zero = jnp.zeros_like(points.x[0])
    body = Pose(Vec3(zero, zero, zero), rotation)

    def distance(point: Vec3) -> tuple[Vec3, Array]:
        found = known.point_distance({"radius": jnp.zeros((1, 1), zero.dtype)}, Pose(point), a, body)
        return found.normal, found.points[0].separation

    up, separation = jax.vmap(distance)(points)
    cell = lax.stop_gradient(window.field["cell_size"])
    slack = jnp.where(_bends_down(ways, cell), LEANING, -FLAT) * cell

    def looks_out(up: Vec3) -> Array:
        direction = lax.stop_gradient(up)
        found = complete & looks_up(direction, at_border, wall.level)
        for way, present in ways:
            found &= ~present | (dot(direction, lax.stop_gradient(way)) < slack)
        return found

    valid = looks_out(up)
    if known.flat_contacts is not None:  # the core of the others is too thin for a point to be in it
        outward, rise, overlaps = _lifts_over(known.name, a, body, points)
        # At a wall the nearest way out comes first.
        overlaps &= ~at_border | (~wall.beside & ~valid)
        overlaps = settle(overlaps.astype(rise.dtype)) > 0.5
        up, separation = where(overlaps, outward, up), jnp.where(overlaps, -rise * outward.y, separation)
        valid = jnp.where(overlaps, looks_out(outward), valid)
    valid = settle(valid.astype(separation.dtype)) > 0.5
    return Candidates(points, up, separation, 8 * _grid_count(window) + number, valid)


def _lifts_over(kind: str, a: dict[str, Any], body: Pose, points: Vec3) -> tuple[Vec3, Array, Array]:
    """The body's underside below grid points (point, pair, world).

    Returns:
        Its normal into the body, how far [m] the points are above it, and whether they are.
    """
    below = DOWN * lax.stop_gradient(bounding_radius(kind, a))
    zero = jnp.zeros_like(points.x[0])
    straight_up = Vec3(zero, zero + 1.0, zero)
    hit = jax.vmap(lambda point: RAYS[kind](a, body, point._replace(y=point.y - below), straight_up))(points)
    rise = below - hit.distance
    return -hit.normal, rise, hit.hit & (rise > 0)


def _bends_down(ways: list[tuple[Vec3, np.ndarray]], cell: Array) -> Array:
    """Whether the ground (point, pair, world) is bent downwards at a point, along some line through it."""
    bends = jnp.zeros((), bool)
    for (way, present), (back, behind) in zip(ways[:3], ways[3:], strict=True):
        bends = bends | (present & behind & (lax.stop_gradient(way.y + back.y) < -FLAT * cell))
    return bends


def _base(
    flat_contacts: Callable[..., Manifold],
    a: dict[str, Any],
    rotation: Mat3,
    window: Window,
    others: Candidates,
    wall: Wall,
    size: Array,
) -> Candidates:
    """The points on which the body would stand on the plane of the deepest contact, each against its own ground.

    Beside the field those that lean on the wall.
    """
    lowest = jnp.finfo(size.dtype).min
    score, code = best_candidate(jnp.where(others.valid, -others.separation, lowest))
    up = pick(others.up, code)
    none = score <= lowest
    up = where(wall.beside, wall.up, where(none, Vec3(0.0, 1.0, 0.0), up))
    zero = jnp.zeros_like(size)
    flat = flat_contacts(
        {"normal": up, "offset": zero}, Pose(Vec3(zero, zero, zero)), a, Pose(Vec3(zero, zero, zero), rotation)
    )

    half = [point.position + up * (0.5 * point.separation) for point in flat.points]
    corner = Vec3(*(_stacked([point[axis] for point in half], size) for axis in range(3)))
    feature, active = (_stacked([getattr(p, name) for p in flat.points], size) for name in ("feature", "active"))

    cell = window.field["cell_size"]
    below = ground_at(window, corner)
    height = height_over(below.normal, below.corner, corner)
    # A corner in the air has its nearest point where the perpendicular, not the plumb line, meets the ground.
    raised = settle((height > 0).astype(height.dtype)) > 0.5
    foot = corner - below.normal * jnp.where(raised, height, 0.0)
    beside = ground_at(window, lax.stop_gradient(foot))
    height = height_over(beside.normal, beside.corner, corner)
    foot = corner - beside.normal * height
    inside = margin(*lax.stop_gradient((foot, beside.corner)), beside.is_upper, lax.stop_gradient(cell)) >= -SEAM
    valid = settle((below.exists & beside.exists & active & (inside | ~raised)).astype(height.dtype)) > 0.5
    standing = Candidates(foot, beside.normal, height, 9 * _grid_count(window) + feature, valid)
    leaning = _on_wall(corner, 0.0, feature, window, wall, size)
    leaning = leaning._replace(valid=leaning.valid & active)
    return jax.tree.map(lambda on_wall, on_ground: jnp.where(wall.beside, on_wall, on_ground), leaning, standing)


def _stacked(values: list[Array], like: Array) -> Array:
    """(candidate, pair, world)."""
    return jnp.stack([jnp.broadcast_to(value, like.shape) for value in values])


def _joined(parts: list[Candidates]) -> Candidates:
    shape = jnp.broadcast_shapes(*(leaf.shape[1:] for leaf in jax.tree.leaves(parts)))

    def join(*values: Array) -> Array:
        counts = [part.separation.shape[0] for part in parts]
        full = [jnp.broadcast_to(value, (count, *shape)) for value, count in zip(values, counts, strict=True)]
        return jnp.concatenate(full)

    return jax.tree.map(join, *parts)


def _reduced(candidates: Candidates, size: Array, base_count: int) -> tuple[Array, ...]:
    """Settled numbers of up to four candidates, -1 for none; the deepest first.

    The farthest from it, the farthest from the line through both and the one that adds most to the triangle follow (guide
    7.2); of a body that touches the ground, those first that are as near. A different normal counts as a distance: in a
    valley two contacts of one point are two.
    """
    ground, up, separation, _, valid = lax.stop_gradient(candidates)
    ground, up, separation = compute_once((ground, up, separation), separation)
    number = separation.dtype
    lowest = jnp.finfo(number).min
    share = depth_tolerance(number)
    lean = dot(LEAN, ground)
    # The points of the base keep their ids from cell to cell; where others are equally deep these are taken.
    is_base = (jnp.arange(separation.shape[0]) >= separation.shape[0] - base_count).reshape(-1, 1, 1)
    score = share * lean - separation + jnp.where(is_base, 8.0 * share * size, 0.0)
    best, first = best_candidate(jnp.where(valid, score, lowest))
    first = jnp.where(best > lowest, first, -1)
    ground0, up0, depth0 = pick((ground, up, separation), first)
    rise = jnp.maximum(separation - depth0, 0.0)
    touches = 1.0 - jnp.clip(depth0 / (TOUCHING * size), 0.0, 1.0)
    # No base is wider than two sizes.
    later = 2.0 * size * touches * jnp.minimum(rise / (NEAR * size), 1.0)
    penalty = HEIGHT_WEIGHT * rise + later - LEAN_SHARE * lean

    def winner(widening: Array, usable: Array) -> Array:
        distinct = (widening > MERGE * size) & usable & valid
        score, code = best_candidate(jnp.where(distinct, widening - penalty, lowest))
        return jnp.where(score > lowest, code, -1)

    offset = ground - ground0
    turn = size * norm(up - up0)
    second = winner(norm(offset) + turn, first >= 0)
    side, up1 = pick((offset, up), second)
    beyond = _beyond(offset, side, up0)
    turn = jnp.minimum(turn, size * norm(up - up1))
    third = winner(jnp.abs(beyond) + turn, second >= 0)
    other_side, up2 = pick((offset, up), third)
    turn = jnp.minimum(turn, size * norm(up - up2))
    left = jnp.where(dot(cross(side, other_side), up0) > 0, -1.0, 1.0).astype(number)
    outside = jnp.maximum(
        left * beyond,
        jnp.maximum(left * _beyond(offset - side, other_side - side, up0), -left * _beyond(offset, other_side, up0)),
    )
    return first, second, third, winner(jnp.maximum(outside, 0.0) + turn, third >= 0)


def _beyond(offset: Vec3, side: Vec3, up: Vec3) -> Array:
    """Distance from the line along `side`, seen along `up`, positive to its left; from its start where it is a point."""
    length = norm(side)
    safe = jnp.where(length > 0, length, 1.0)
    return jnp.where(length > 0, dot(cross(side, offset), up) / safe, norm(offset))


def _manifold(candidates: Candidates, chosen: tuple[Array, ...], size: Array, pose_a: Pose, pose_b: Pose) -> Manifold:
    assert pose_b.rotation is not None
    points = []
    for code in chosen:
        ground, up, separation, feature, _ = pick(candidates._replace(valid=candidates.feature), code)
        active = code >= 0
        up = where(active, up, Vec3(0.0, 1.0, 0.0))
        separation = jnp.where(active, separation, ABSENT * size)
        middle = ground + up * jnp.where(active, 0.5 * separation, 0.0)
        position = pose_a.position + pose_b.rotation.apply(middle)
        normal = -pose_b.rotation.apply(up)
        points.append(ContactPoint(position, separation, feature, active, normal))
    return Manifold(points[0].normal, tuple(points))
