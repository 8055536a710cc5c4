"""General convex distance against an independent float64 oracle: cutting planes with SciPy's NNLS and Qhull."""

import itertools
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from mathota_jax.collision.convex import SUPPORT, convex_distance, support
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, normalize, to_matrix
from mathota_jax.spatial.vector import Vec3

KINDS = ("sphere", "capsule", "box", "cylinder", "cone", "polyhedron")
ROUND, FLAT = ("sphere", "capsule"), ("box", "polyhedron")
PAIRS = list(itertools.combinations_with_replacement(KINDS, 2))
QUICK = [("box", "polyhedron"), ("cylinder", "cone")]
"""Pairs of the normal suite; the slow one runs them all."""
VERTICES = 12
NORMAL_COUNT, SLOW_COUNT = 40, 952
"""Poses of one class: the slow sweep has 21 classes x 952 poses, 20,000 in all, in each precision."""


def every_pair(*quick):
    return [pytest.param(pair, id="_".join(pair), marks=() if pair in quick else pytest.mark.slow) for pair in PAIRS]


# ---- scenes: natural arrays in NumPy, one pose a row -------------------------------------------------------------


def random_shape(kind, rng, count):
    if kind == "box":
        return {"half_extents": rng.uniform(0.2, 1.0, (count, 3))}
    if kind == "polyhedron":
        points = rng.normal(size=(count, VERTICES, 3))
        return {
            "vertices": points / np.linalg.norm(points, axis=2, keepdims=True) * rng.uniform(0.3, 1.0, (count, 1, 3))
        }
    names = ("radius",) if kind == "sphere" else ("radius", "half_height")
    return {name: rng.uniform(0.2, 1.0, count) for name in names}


def stretched(shape, kind, form):
    """The same shapes as needles along y, plates across y or small by 1:1000."""
    if form == "small":
        return {name: value * 1e-3 for name, value in shape.items()}
    thin, flat = form == "needle", form == "plate"
    factors = np.array([1e-3 if thin else 1.0, 1e-3 if flat else 1.0, 1e-3 if thin else 1.0])
    result = {}
    for name, value in shape.items():
        if value.ndim > 1:
            result[name] = value * factors
        else:
            across = name == "radius" or kind in ROUND
            result[name] = value * (1e-3 if (thin and name == "radius") or (flat and not across) else 1.0)
    return result


def random_scene(pair, count, forms=("", ""), reach=2.0):
    rng = np.random.default_rng(zlib.crc32("_".join((*pair, *forms)).encode()))
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    scene = {
        side: stretched(random_shape(kind, rng, count), kind, f)
        for side, kind, f in zip("ab", pair, forms, strict=True)
    }
    scene["pa"] = rng.normal(size=(count, 3)) * 0.1
    scene["pb"] = scene["pa"] + direction * rng.uniform(0.0, reach, (count, 1))
    for side in "ab":
        scene["q" + side] = Rotation.random(count, random_state=rng).as_quat()[:, [3, 0, 1, 2]]
    return scene


def rounded(scene, dtype):
    """The scene as the engine sees it in this precision."""
    return jax.tree.map(lambda x: np.asarray(x, dtype).astype(float), scene)


def to_engine(scene, dtype):
    def vector(rows):
        return Vec3(
            *(
                jnp.asarray(rows[..., k].T[..., None, :] if rows.ndim == 3 else rows[None, :, k], dtype)
                for k in range(3)
            )
        )

    def shape(parameters):
        return {n: vector(v) if v.ndim > 1 else jnp.asarray(v[None], dtype) for n, v in parameters.items()}

    def quaternion(q):
        return Quaternion(*(jnp.asarray(q[None, :, k], dtype) for k in range(4)))

    return (
        shape(scene["a"]), vector(scene["pa"]), quaternion(scene["qa"]),
        shape(scene["b"]), vector(scene["pb"]), quaternion(scene["qb"]),
    )  # fmt: skip


def call(pair, a, pa, qa, b, pb, qb):
    pose_a, pose_b = Pose(pa, to_matrix(normalize(qa))), Pose(pb, to_matrix(normalize(qb)))
    return convex_distance(pair[0], a, pose_a, pair[1], b, pose_b)


_compiled = {}


def compiled(pair):
    key = (pair, jax.config.jax_enable_x64)
    if key not in _compiled:
        _compiled[key] = jax.jit(lambda *arguments: call(pair, *arguments))
    return _compiled[key]


class Result:
    """A contact as float64 NumPy rows."""

    def __init__(self, pair, scene, dtype):
        contact = compiled(pair)(*to_engine(scene, dtype))

        def rows(vector):
            return np.stack([np.asarray(c, float)[0] for c in vector], -1)

        self.normal, self.point_a, self.point_b = (rows(v) for v in (contact.normal, contact.point_a, contact.point_b))
        self.separation = np.asarray(contact.separation, float)[0]
        self.converged, self.feature = np.asarray(contact.converged)[0], np.asarray(contact.feature)[0]
        self.types = {contact.separation.dtype, contact.normal.x.dtype, contact.point_a.x.dtype}


# ---- oracle ------------------------------------------------------------------------------------------------------


def extreme_point(kind, shape, direction):
    """Core point of a shape furthest along a direction, in its own frame."""
    x, y, z = direction
    if kind == "sphere":
        return np.zeros(3)
    if kind == "box":
        return np.where(direction >= 0, 1, -1) * shape["half_extents"]
    if kind == "polyhedron":
        return shape["vertices"][np.argmax(shape["vertices"] @ direction)]
    height, radius, across = shape["half_height"], shape["radius"], np.hypot(x, z)
    end = np.array([0, height if y >= 0 else -height, 0])
    if kind == "capsule":
        return end
    rim = np.array([x, 0, z]) * (radius / across) if across > 0 else np.zeros(3)
    if kind == "cylinder":
        return end + rim
    apex, base = np.array([0, 1.5 * height, 0]), rim - np.array([0, 0.5 * height, 0])
    return apex if apex @ direction > base @ direction else base


class Placed:
    """One pose of a pair: the difference B - A through its support function, in NumPy only."""

    def __init__(self, pair, scene, index):
        self.sides = []
        for side, kind in zip("ab", pair, strict=True):
            shape = {name: value[index] for name, value in scene[side].items()}
            rotation = Rotation.from_quat(scene["q" + side][index][[1, 2, 3, 0]]).as_matrix()
            self.sides.append((kind, shape, scene["p" + side][index], rotation))
        self.radii = [shape["radius"] if kind in ROUND else 0.0 for kind, shape, _, _ in self.sides]

    def extreme(self, side, direction):
        """Point of the core of a side (0 or 1) furthest along a world direction."""
        kind, shape, position, rotation = self.sides[side]
        return position + rotation @ extreme_point(kind, shape, rotation.T @ direction)

    def least(self, normal):
        """Point of B - A (cores) least along the normal."""
        return self.extreme(1, -normal) - self.extreme(0, normal)

    def reach(self, normal):
        """Separation along a unit normal: a lower bound of the signed distance, attained by the true normal."""
        return normal @ self.least(normal) - sum(self.radii)

    def seeds(self):
        """Points of B - A to start from: all differences of vertices of polytopes, else some support points."""
        corners = []
        for kind, shape, position, rotation in self.sides:
            if kind not in (*FLAT, *ROUND):
                return [self.least(d) for d in np.random.default_rng(1).normal(size=(64, 3))]
            local = {
                "sphere": lambda: np.zeros((1, 3)),
                "capsule": lambda: np.array([[0, 1, 0], [0, -1, 0]]) * shape["half_height"],  # noqa: B023
                "box": lambda: np.array(list(itertools.product((-1, 1), repeat=3))) * shape["half_extents"],  # noqa: B023
                "polyhedron": lambda: shape["vertices"],  # noqa: B023
            }[kind]()
            corners.append(position + local @ rotation.T)
        return list((corners[1][:, None] - corners[0][None]).reshape(-1, 3))

    def size(self):
        directions = np.random.default_rng(0).normal(size=(50, 3))
        extents = [
            max(np.linalg.norm(self.extreme(s, d) - self.sides[s][2]) for d in directions) + self.radii[s]
            for s in (0, 1)
        ]
        return max(extents)


def oracle(placed, tolerance=1e-10):
    """Signed distance and normal: cutting planes until the bounds meet (hull of support points against its support).

    Apart: the nearest point of the hull by non-negative least squares. Overlapping: the nearest facet by Qhull, which is
    the global minimum of the depth since every facet of the true difference lies outside the hull found so far.
    """
    points = placed.seeds()
    for _ in range(500):
        rows = np.array(points)
        weights, _ = nnls(np.vstack([rows.T, np.ones(len(rows))]), np.array([0, 0, 0, 1.0]), maxiter=100000)
        nearest = weights @ rows / weights.sum()
        gap = np.linalg.norm(nearest)
        if gap < 1e-10:
            break
        normal = nearest / gap
        point = placed.least(normal)
        if normal @ point >= gap - tolerance:
            return placed.reach(normal), normal
        points.append(point)
    hull = ConvexHull(np.array(points), incremental=True)
    for _ in range(400):
        facet = np.argmax(hull.equations[:, 3])
        normal = -hull.equations[facet, :3]
        point = placed.least(normal)
        if normal @ point >= hull.equations[facet, 3] - tolerance:
            break
        hull.add_points(point[None])
    return placed.reach(normal), normal


def distance_to(placed, side, point):
    """Signed distance of a world point from a side's shape, exact outside and on the surface; negative inside."""
    kind, shape, position, rotation = placed.sides[side]
    local = rotation.T @ (point - position)
    if kind == "sphere":
        return np.linalg.norm(local) - shape["radius"]
    if kind == "box":
        excess = np.abs(local) - shape["half_extents"]
        return np.linalg.norm(np.maximum(excess, 0)) + min(excess.max(), 0)
    if kind == "polyhedron":
        return (ConvexHull(shape["vertices"]).equations @ np.append(local, 1)).max()
    height, radius, across = shape["half_height"], shape["radius"], np.hypot(local[0], local[2])
    if kind == "capsule":
        return np.hypot(across, max(abs(local[1]) - height, 0)) - radius
    if kind == "cylinder":
        excess = np.array([across - radius, abs(local[1]) - height])
        return np.linalg.norm(np.maximum(excess, 0)) + min(excess.max(), 0)
    slope = np.array([2 * height, radius]) / np.hypot(2 * height, radius)
    return max(slope @ [across, local[1] - 1.5 * height], -0.5 * height - local[1])


def check(pair, scene, dtype):
    """Every gate on value, normal and witness points of a scene."""
    scene = rounded(scene, dtype)
    result = Result(pair, scene, dtype)
    assert result.types == {dtype}
    curved = not set(pair) <= {*FLAT, *ROUND}
    share = 2e-5 if dtype == np.float32 else 1e-6 if curved else 1e-9
    tight = 1e-5 if dtype == np.float32 else 1e-6
    np.testing.assert_allclose(np.linalg.norm(result.normal, axis=1), 1.0, atol=1e-6)
    failures = []
    for index in range(len(scene["pb"])):
        placed = Placed(pair, scene, index)
        size = placed.size()
        truth, normal = oracle(placed)
        error = result.separation[index] - truth
        # Inside the valid cone of normals: the separation along ours is the distance to the gate's precision.
        angle = np.degrees(np.arccos(np.clip(result.normal[index] @ normal, -1, 1)))
        valid = angle < 0.1 or abs(placed.reach(result.normal[index]) - truth) < share * size
        witness = np.abs(
            result.point_b[index] - result.point_a[index] - result.separation[index] * result.normal[index]
        )
        on_surface = max(abs(distance_to(placed, s, p[index])) for s, p in enumerate((result.point_a, result.point_b)))
        if abs(error) > share * size or not valid or witness.max() > tight * size or on_surface > 2 * tight * size:
            failures.append((index, truth, error, angle, witness.max(), on_surface, bool(result.converged[index])))
    assert not failures, failures[:5]
    return result


@pytest.mark.parametrize("pair", every_pair(*QUICK))
def test_random_poses(pair, precision):
    result = check(pair, random_scene(pair, NORMAL_COUNT), precision)
    assert 0.1 < (result.separation < 0).mean() < 0.99  # both regimes are there
    assert result.converged.mean() > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS, ids=["_".join(pair) for pair in PAIRS])
def test_many_random_poses(pair, precision):
    check(pair, random_scene(pair, SLOW_COUNT, ("", "")), precision)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [1e-2, 1e-4, -1e-4, -1e-2])
@pytest.mark.parametrize("pair", every_pair(*QUICK))
def test_touching_and_shallow_poses(pair, gap, precision):
    scene = random_scene(pair, NORMAL_COUNT)
    for index in range(NORMAL_COUNT):
        truth, normal = oracle(Placed(pair, scene, index))
        scene["pb"][index] += (gap - truth) * normal
    result = check(pair, scene, precision)
    assert np.all((result.separation < 0) == (gap < 0))


@pytest.mark.slow
@pytest.mark.parametrize(
    "forms", [("needle", "plate"), ("plate", "plate"), ("needle", "needle"), ("small", ""), ("", "small")]
)
@pytest.mark.parametrize("pair", every_pair(*QUICK))
def test_extreme_forms(pair, forms, precision):
    check(pair, random_scene(pair, NORMAL_COUNT, forms, reach=1.0), precision)


@pytest.mark.slow
@pytest.mark.parametrize("pair", every_pair(*QUICK))
def test_nearly_coincident_centres(pair, precision):
    scene = random_scene(pair, NORMAL_COUNT)
    scene["pb"] = scene["pa"] + 1e-6 * (scene["pb"] - scene["pa"])
    check(pair, scene, precision)


@pytest.mark.parametrize("kind", KINDS)
def test_support_points_are_extreme(kind):
    with jax.enable_x64(True):
        rng = np.random.default_rng(3)
        shape, directions = random_shape(kind, rng, 200), rng.normal(size=(200, 3))
        scene = {
            "a": shape,
            "b": shape,
            "pa": directions,
            "pb": directions,
            "qa": np.eye(4)[[0] * 200],
            "qb": np.eye(4)[[0] * 200],
        }
        parameters, direction, *_ = to_engine(scene, np.float64)
        point, code = support(kind, parameters, direction)
        assert code.dtype == jnp.int32
        for index in range(200):
            expected = extreme_point(kind, {name: value[index] for name, value in shape.items()}, directions[index])
            np.testing.assert_allclose([np.broadcast_to(c, (1, 200))[0, index] for c in point], expected, atol=1e-12)
    assert set(SUPPORT) == set(KINDS)


# ---- degenerate poses --------------------------------------------------------------------------------------------


def degenerate_scene(pair):
    turns = [Rotation.identity()]
    turns += [Rotation.from_rotvec(t * np.eye(3)[k]) for t in (1e-9, 1e-3, np.pi / 4) for k in (0, 2)]
    offsets = [
        (0, 0, 0),
        (1e-9, 0, 0),
        (1, 0, 0),
        (0, 1, 0),
        (1, 1, 0),
        (1, 1, 1),
        (0, 0.95, 0),
        (0.5, 0, 0),
        (0, 2, 0),
    ]
    table = list(itertools.product(offsets, turns))
    count = len(table)
    cube = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    shapes = {
        "radius": np.full(count, 0.5), "half_height": np.full(count, 0.5), "half_extents": np.full((count, 3), 0.5),
        "vertices": np.tile(np.vstack([cube, cube[:1]]), (count, 1, 1)),  # one vertex repeated, as padding does
    }  # fmt: skip
    names = {"sphere": ("radius",), "box": ("half_extents",), "polyhedron": ("vertices",)}
    pick = lambda kind: {n: shapes[n] for n in names.get(kind, ("radius", "half_height"))}  # noqa: E731
    return {
        "a": pick(pair[0]), "b": pick(pair[1]), "pa": np.zeros((count, 3)), "pb": np.array([o for o, _ in table], float),
        "qa": np.tile([1.0, 0, 0, 0], (count, 1)), "qb": np.array([t.as_quat()[[3, 0, 1, 2]] for _, t in table]),
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("pair", every_pair(("box", "cylinder")))
def test_degenerate_poses(pair, precision):
    """Coincident centres, parallel axes, exact touch of faces, edges and corners, tilts to nothing: right and finite."""
    scene = rounded(degenerate_scene(pair), precision)
    result = Result(pair, scene, precision)
    share = 2e-5 if precision == np.float32 else 1e-6
    for index in range(0, len(scene["pb"]), 3):
        placed = Placed(pair, scene, index)
        truth, _ = oracle(placed, 1e-7)
        assert abs(result.separation[index] - truth) < share, index
        assert abs(placed.reach(result.normal[index]) - truth) < share, index

    def everything(*arguments):
        contact = call(pair, *arguments)
        return sum(
            jnp.sum(x) for x in jax.tree.leaves((contact.normal, contact.separation, contact.point_a, contact.point_b))
        )

    arguments = to_engine(scene, precision)
    gradient = jax.grad(everything, argnums=tuple(range(6)))
    tangents = jax.tree.map(jnp.ones_like, arguments)
    first, second = jax.jit(lambda *x: jax.jvp(gradient, x, tangents))(*arguments)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves((first, second)))


# ---- derivatives -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("pair", every_pair(("cylinder", "polyhedron")))
def test_derivatives_against_central_differences(pair):
    """Separation, normal and both points by every parameter and pose component, away from changes of feature."""
    with jax.enable_x64(True):
        arguments = to_engine(random_scene(pair, NORMAL_COUNT), np.float64)

        def outputs(*x):
            contact = call(pair, *x)
            values = [contact.separation, *contact.normal, *contact.point_a, *contact.point_b]
            return jnp.stack(values), contact.feature

        value = jax.jit(outputs)
        forward = jax.jit(lambda x, t: jax.jvp(lambda *y: outputs(*y)[0], x, t)[1])
        leaves, tree = jax.tree.flatten(arguments)
        zeros = [jnp.zeros_like(leaf) for leaf in leaves]
        here, _ = value(*arguments)
        step, compared = 1e-6, 0
        for position, leaf in enumerate(leaves):
            rows = [()] if leaf.ndim == 2 else [(k,) for k in range(0, leaf.shape[0], 5)]
            for row in rows:
                change = jnp.zeros_like(leaf).at[row].set(1.0)
                sides = []
                for sign in (-1, 1):
                    moved = [*leaves[:position], leaf + sign * step * change, *leaves[position + 1 :]]
                    sides.append(value(*jax.tree.unflatten(tree, moved)))
                # No change of feature within the step: there the second difference would be of first order.
                same = np.asarray(jnp.abs(sides[0][0] + sides[1][0] - 2 * here).max(0) < 1e-9)
                assert same.mean() > 0.8
                tangents = [*zeros[:position], change, *zeros[position + 1 :]]
                derivative = forward(arguments, jax.tree.unflatten(tree, tangents))
                difference = (sides[1][0] - sides[0][0]) / (2 * step)
                error = np.asarray(jnp.abs(difference - derivative) / (1 + jnp.abs(derivative)))
                assert error[:, same].max() < 1e-6, (position, row, np.argwhere((error > 1e-6) & same)[:5])
                compared += 1
        assert compared >= 14


@pytest.mark.slow
def test_reverse_mode_agrees_with_forward():
    pair = ("cylinder", "polyhedron")
    with jax.enable_x64(True):
        arguments = to_engine(random_scene(pair, 16), np.float64)
        tangents = jax.tree.map(lambda x: jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape), arguments)
        function = lambda *x: call(pair, *x).separation.sum()  # noqa: E731
        _, forward = jax.jvp(function, arguments, tangents)
        gradient = jax.jit(jax.grad(function, argnums=tuple(range(6))))(*arguments)
        products = jax.tree.map(lambda g, t: (g * t).sum(), gradient, tangents)
        assert float(sum(jax.tree.leaves(products))) == pytest.approx(float(forward), rel=1e-9)
