"""Signed distance of any convex shapes in float64, many poses at once: a search over all directions that can separate.

The separation along a unit direction is a lower bound of the signed distance, and the distance is the greatest of them.
It is taken at directions all over the sphere, then climbed from the highest local maxima by nested golden sections, which
need no derivative and follow the ridges where pieces of a shape tie. Uses heights of the shapes along directions alone.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

DIRECTIONS = 1000
NEIGHBOURS = 8
STARTS = 6
"""Local maxima that are climbed, and as many special directions: of faces and axes."""
ROUNDS = ((0.3, 18), (0.05, 22), (0.005, 34))
"""Half width [rad] of the windows of the climb, and sections in each of its two directions."""
BLOCK = 2500
"""Poses at a time."""
GOLDEN = (5**0.5 - 1) / 2


def height(kind, shape, x, y, z):
    """Largest product of a point of a shape with a local direction; sizes and directions by pose in the last axis."""
    if kind == "plane":
        return jnp.zeros_like(x)  # along its own normal: there is no other
    if kind == "box":
        return sum(abs(d) * h for d, h in zip((x, y, z), shape["half_extents"], strict=True))
    if kind == "polyhedron":
        a, b, c = shape["vertices"]
        found = a[0] * x + b[0] * y + c[0] * z
        for k in range(1, len(a)):
            found = jnp.maximum(found, a[k] * x + b[k] * y + c[k] * z)
        return found
    radius = shape["radius"]
    if kind in ("sphere", "capsule"):
        along = 0.0 if kind == "sphere" else abs(y) * shape["half_height"]
        return along + radius * jnp.sqrt(x * x + y * y + z * z)
    across = radius * jnp.sqrt(x * x + z * z)
    if kind == "cylinder":
        return abs(y) * shape["half_height"] + across
    return jnp.maximum(1.5 * shape["half_height"] * y, across - 0.5 * shape["half_height"] * y)


def extent(kind, shape):
    """Largest distance [m] of a point of each shape from its origin."""
    if kind == "box":
        return np.linalg.norm(shape["half_extents"], axis=1)
    if kind == "polyhedron":
        return np.linalg.norm(shape["vertices"], axis=2).max(1)
    radius, half = shape["radius"], shape.get("half_height", 0.0)
    if kind in ("sphere", "capsule"):
        return radius + half
    return np.hypot(radius, half) if kind == "cylinder" else np.maximum(1.5 * half, np.hypot(radius, 0.5 * half))


def direction_distance(pair, scene):
    """Signed distances [m] and unit normals from A to B, one a pose."""
    count = len(scene["pa"])
    sphere = _sphere(DIRECTIONS)
    neighbours = cKDTree(sphere).query(sphere, NEIGHBOURS + 1)[1][:, 1:]
    with jax.enable_x64(True):
        blocks = [_prepared(pair, scene, slice(k, k + BLOCK)) for k in range(0, count, BLOCK)]
        found = [_best(pair, *block, sphere, neighbours) for block in blocks]
        return np.concatenate([f[0] for f in found]), np.concatenate([f[1].T for f in found])


def separation_along(pair, scene, normals):
    """Separation [m] along a unit direction (rows) of each pose: a lower bound of the signed distance."""
    with jax.enable_x64(True):
        shapes, _ = _prepared(pair, scene, slice(None))
        return np.asarray(_reach(pair, shapes, normals.T))


def plane_distance(pair, scene):
    """Signed distances [m] and unit normals of the half spaces below y = 0 of their frames and the second shapes."""
    normals = Rotation.from_quat(scene["qa"][:, [1, 2, 3, 0]]).apply([0.0, 1.0, 0.0])
    return separation_along(pair, scene, normals), normals


def _prepared(pair, scene, rows):
    """Sizes with the poses last, rotations, B - A; special directions: axes of both, normals to pairs of them."""
    turns = [Rotation.from_quat(scene["q" + side][rows][:, [1, 2, 3, 0]]).as_matrix() for side in "ab"]
    sizes = [
        {n: v[rows] if v.ndim == 1 else np.moveaxis(v[rows], 0, -1) for n, v in scene[side].items()} for side in "ab"
    ]
    sizes = [{n: v.swapaxes(0, 1) if n == "vertices" else v for n, v in shape.items()} for shape in sizes]
    axes = [turn.transpose(2, 0, 1) for turn in turns]
    across = [np.cross(u, v) for u in axes[0] for v in axes[1]]
    special = np.concatenate([axes[0], axes[1], across])
    special = special / np.maximum(np.linalg.norm(special, axis=2, keepdims=True), 1e-300)
    shapes = (*sizes, *(np.moveaxis(turn, 0, -1) for turn in turns), (scene["pb"] - scene["pa"])[rows].T)
    return shapes, np.concatenate([special, -special]).transpose(2, 0, 1)


def _reach(pair, shapes, direction):
    a, b, turn_a, turn_b, between = shapes
    x, y, z = direction
    into = [[t[0, k] * x + t[1, k] * y + t[2, k] * z for k in range(3)] for t in (turn_a, turn_b)]
    gap = between[0] * x + between[1] * y + between[2] * z
    return gap - height(pair[0], a, *into[0]) - height(pair[1], b, *(-component for component in into[1]))


@partial(jax.jit, static_argnums=0)
def _best(pair, shapes, special, sphere, neighbours):
    heights = lax.map(lambda d: _reach(pair, shapes, d), jnp.asarray(sphere)[:, :, None])
    peaks = heights
    for k in range(NEIGHBOURS):
        peaks = jnp.where(heights[neighbours[:, k]] > heights, -jnp.inf, peaks)
    _, places = lax.top_k(peaks.T, STARTS)
    along = lax.map(lambda d: _reach(pair, shapes, d), special.swapaxes(0, 1))
    values, chosen = lax.top_k(along.T, STARTS)
    picked = jnp.take_along_axis(special, chosen.T[None], axis=1)
    starts = jnp.concatenate([jnp.moveaxis(jnp.asarray(sphere)[places], 2, 0).swapaxes(1, 2), picked], axis=1)
    best, normals = lax.map(lambda start: _climb(pair, shapes, start), starts.swapaxes(0, 1))
    # A special direction is exact, a climb to it is not quite.
    best = jnp.concatenate([best, values.T])
    normals = jnp.concatenate([normals, picked.swapaxes(0, 1)])
    winner = jnp.argmax(best, axis=0)[None]
    return (
        jnp.take_along_axis(best, winner, axis=0)[0],
        jnp.take_along_axis(normals, winner[:, None], axis=0)[0],
    )


def _climb(pair, shapes, start):
    """Greatest separation near a direction (3, pose), and where: windows shrink about the best seen."""

    def narrow(k, state):
        best, normal = state
        half, sections = jnp.array([r[0] for r in ROUNDS])[k], jnp.array([r[1] for r in ROUNDS])[k]
        # Any two directions across the normal.
        small = (abs(normal[0]) < 0.6).astype(best.dtype)
        first = _unit(jnp.cross(normal, jnp.stack([small, 1.0 - small, 0.0 * small]), axis=0))
        second = jnp.cross(normal, first, axis=0)

        def at(x, y):
            return _unit(normal + x * first + y * second)

        def along(x):
            value, y = _section(lambda y: (_reach(pair, shapes, at(x, y)), y), half, sections, best)
            return value, (x, y)

        value, place = _section(along, half, sections, best)
        better = value > best
        return jnp.where(better, value, best), jnp.where(better, at(*place), normal)

    return lax.fori_loop(0, len(ROUNDS), narrow, (_reach(pair, shapes, start), start))


def _section(function, half, sections, like):
    """Largest value of a function with one maximum on ``-half..half``, and what it says of the place (golden section)."""
    full = jnp.full_like(like, half)
    left, right = full * (1 - 2 * GOLDEN), full * (2 * GOLDEN - 1)
    nothing = jax.tree.map(lambda x: jnp.full(x.shape, -jnp.inf), jax.eval_shape(function, left))

    def narrow(k, state):
        low, high, left, right, at_left, at_right = state
        up = at_right[0] > at_left[0]
        started = k >= 2  # the first two turns fill in the two points
        low, high = jnp.where(started & up, left, low), jnp.where(started & ~up, right, high)
        new = jnp.where(up, low + GOLDEN * (high - low), high - GOLDEN * (high - low))
        at_new = function(jnp.where(k == 0, left, jnp.where(k == 1, right, new)))

        def pick(condition, yes, no):
            return jax.tree.map(lambda y, n: jnp.where(condition, y, n), yes, no)

        to_left, to_right = (k == 0) | (started & ~up), (k == 1) | (started & up)
        old_left, old_right = (left, at_left), (right, at_right)
        left, at_left = pick(
            to_left, (jnp.where(started, new, left), at_new), pick(to_right & started, old_right, old_left)
        )
        right, at_right = pick(
            to_right, (jnp.where(started, new, right), at_new), pick(to_left & started, old_left, old_right)
        )
        return low, high, left, right, at_left, at_right

    *_, at_left, at_right = lax.fori_loop(0, sections + 2, narrow, (-full, full, left, right, nothing, nothing))
    return jax.tree.map(lambda old, new: jnp.where(at_right[0] > at_left[0], new, old), at_left, at_right)


def _unit(vectors):
    return vectors / jnp.sqrt((vectors * vectors).sum(0))


def _sphere(count):
    """Directions spread over the sphere on a spiral."""
    rank = np.arange(count) + 0.5
    angle, y = np.pi * (1 + 5**0.5) * rank, 1 - 2 * rank / count
    across = np.sqrt(1 - y * y)
    return np.stack([across * np.cos(angle), y, across * np.sin(angle)], axis=1)
