"""Bodies in rough ground: what is in the body is found, however it lies, and is pushed out."""

import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.heightfields import CELL, REACH, SIZES, STONE, STONE_FACES, run
from tests.marks import slow_but
from tests.unit.test_heightfield import KINDS, grid_points, surface

ROWS, COLUMNS = 25, 26


def ground(name):
    """Heights of up to a cell and slopes beyond 45 degrees."""
    rng = np.random.default_rng(5)
    if name == "steps":
        return np.round(rng.uniform(-0.8, 0.8, (ROWS, COLUMNS))) * 0.9 * CELL
    return rng.normal(size=(ROWS, COLUMNS)) * 0.4 * CELL


@functools.cache
def stone_planes():
    corners = np.array([STONE[list(face[:3])] for face in STONE_FACES])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return normal, (normal * corners[:, 0]).sum(1)


def depth_in(kind, points):
    """How far points (..., 3) in the body's frame are inside of it; negative outside. Closed forms."""
    size = SIZES[kind]
    x, y, z = np.moveaxis(points, -1, 0)
    across = np.hypot(x, z)
    if kind == "sphere":
        return size["radius"] - np.linalg.norm(points, axis=-1)
    if kind == "capsule":
        return size["radius"] - np.hypot(across, np.maximum(np.abs(y) - size["half_height"], 0.0))
    if kind == "box":
        return (size["half_extents"] - np.abs(points)).min(-1)
    if kind == "polyhedron":
        normal, offset = stone_planes()
        return (offset - points @ normal.T).min(-1)
    radius, half = size["radius"], size["half_height"]
    if kind == "cylinder":
        return np.minimum(radius - across, half - np.abs(y))
    return np.minimum(y + 0.5 * half, ((1.5 * half - y) * radius - across * 2 * half) / np.hypot(radius, 2 * half))


def samples(heights, position, reach):
    """Points of the ground within reach of a body, those of the grid and on its lines among them."""
    sides = []
    grid = grid_points(heights)
    for axis, lines in ((0, grid[:, 0, 0]), (2, grid[0, :, 2])):
        side = np.concatenate([position[axis] + np.linspace(-reach, reach, 25), lines])
        sides.append(side[(np.abs(side - position[axis]) <= reach) & (np.abs(side) <= lines[-1])])
    x, z = (side.ravel() for side in np.meshgrid(*sides, indexing="ij"))
    points = np.stack([x, np.zeros_like(x), z], -1)
    points[:, 1] = surface(heights, points)
    return points


def middle(kind):
    return STONE.mean(0) if kind == "polyhedron" else np.zeros(3)


def sunk(kind, heights, at_border, count, depth):
    """Poses, coming from above, in which the deepest sample of the ground is so deep in the body, and its depth."""
    rng = np.random.default_rng(17)
    position, orientation = rng.uniform(-1.0, 1.0, (count, 3)), Rotation.random(count, random_state=rng)
    if at_border:
        position[:, 0] = 0.5 * (ROWS - 1) * CELL + rng.uniform(-0.5, -0.01, count) * depth_in(kind, middle(kind))
    position -= orientation.apply(middle(kind))
    found = np.zeros(count)
    for world, turn in enumerate(orientation.as_matrix()):
        points = samples(heights, position[world], REACH[kind])

        def deepest(height, world=world, points=points, turn=turn):
            return depth_in(kind, (points - [position[world, 0], height, position[world, 2]]) @ turn).max()

        high = points[:, 1].max() + REACH[kind]
        while deepest(high) < depth:
            high, above = high - 0.1 * REACH[kind], high
        low = high
        for _ in range(15):
            half = 0.5 * (low + above)
            low, above = (half, above) if deepest(half) > depth else (low, half)
        position[world, 1], found[world] = low, deepest(low)
    return position, orientation.as_quat()[:, [3, 0, 1, 2]], found


@pytest.mark.parametrize("kind", slow_but(("cone", "box"), KINDS))
def test_no_overlap_is_missed(kind, float64, gate):
    """A point of the ground inside of a body by d parts them by no less than d, whichever way they are parted.

    The deepest contact may be less deep by little: it goes by heights.
    """
    count, parts = 100, []
    for name, at_border in (("steps", False), ("rough", False), ("rough", True)):
        for share in (0.02, 0.1, 0.6):
            heights, depth = ground(name), share * depth_in(kind, middle(kind))
            *poses, truth = sunk(kind, heights, at_border, count, depth)
            assert np.abs(truth / depth - 1.0).max() < 0.01
            parts.append((*poses, np.repeat(heights[..., None], count, -1), truth))
    position, orientation, heights, truth = (
        np.concatenate(part, axis) for part, axis in zip(zip(*parts, strict=True), (0, 0, 2, 0), strict=True)
    )
    found = run(kind, heights[:, :, None], position, orientation)
    deepest = np.where(found["active"], found["separation"], np.inf).min(0)
    missed = np.maximum(deepest / truth + 1.0, 0.0).reshape(3, -1)
    gate("missed share", missed[:2], 0.1)
    # At a wall the nearest way out counts where there is one.
    gate("poses at the border of which half is missed", (missed[2] > 0.5).mean(), 0.01)
    assert (-found["normal"][..., 1][found["active"]]).min() > 0
