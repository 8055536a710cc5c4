"""Analytic pairs against float64 oracles without shared code: bounded least squares for gaps, plain SAT for depths."""

import itertools
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from mathota_jax.collision.pairs import PAIRS
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, normalize, to_matrix
from mathota_jax.spatial.vector import Vec3
from tests.marks import QUICK_AND_SLOW_PRECISION

# The pairs of the first four kinds; others in test_closed_pairs, test_convex, test_face_manifold and test_queries.
POSE_COUNT = 256
SIZES = {"radius": (0.2, 0.6), "half_height": (0.3, 1.0), "half_extents": (0.2, 1.0)}
PARAMETERS = {
    "plane": ("normal", "offset"),
    "sphere": ("radius",),
    "capsule": ("radius", "half_height"),
    "box": ("half_extents",),
}
PAIR_NAMES = [pair for pair in PAIRS if set(pair) <= set(PARAMETERS)]
IDS = ["_".join(pair) for pair in PAIR_NAMES]
FACE_MARGIN = 1e-3  # box faces are preferred to edges by this share of the size (design rule)
EDGE_SHARE = 0.05  # ... and of the depth


# ---- scenes: natural arrays in NumPy, one pose a row -------------------------------------------------------------


def random_scene(pair, count=POSE_COUNT, scale=1.0):
    """Poses from deep overlap to clear separation, all features facing each other in turn."""
    rng = np.random.default_rng(zlib.crc32("_".join(pair).encode()))
    scene = {}
    for side, kind in zip("ab", pair, strict=True):
        shape = {}
        for name in PARAMETERS[kind]:
            if name in SIZES:
                shape[name] = rng.uniform(*SIZES[name], (count, 3) if name == "half_extents" else count)
            elif name == "normal":
                normal = rng.normal(size=(count, 3))
                shape[name] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
            else:
                shape[name] = rng.normal(size=count) * 0.3
        scene[side] = shape
        scene["q" + side] = Rotation.random(count, random_state=rng).as_quat()[:, [3, 0, 1, 2]]
        scene["p" + side] = rng.normal(size=(count, 3))
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    anchor = scene["pa"]
    if pair[0] == "plane":
        anchor = scene["a"]["normal"] * scene["a"]["offset"][:, None]
    scene["pb"] = anchor + direction * rng.uniform(0.0, 2.2, (count, 1)) * scale
    return scene


def rows(vectors, dtype):
    return Vec3(*(jnp.asarray(vectors[None, :, k], dtype) for k in range(3)))


def to_engine(scene, dtype):
    """Worlds-last arguments (shape a, position, quaternion, shape b, position, quaternion)."""

    def shape(parameters):
        return {
            name: rows(value, dtype) if value.ndim == 2 else jnp.asarray(value[None], dtype)
            for name, value in parameters.items()
        }

    def quaternion(q):
        return Quaternion(*(jnp.asarray(q[None, :, k], dtype) for k in range(4)))

    return (
        shape(scene["a"]), rows(scene["pa"], dtype), quaternion(scene["qa"]),
        shape(scene["b"]), rows(scene["pb"], dtype), quaternion(scene["qb"]),
    )  # fmt: skip


def call(pair, a, pa, qa, b, pb, qb):
    pose_a, pose_b = Pose(pa, to_matrix(normalize(qa))), Pose(pb, to_matrix(normalize(qb)))
    return PAIRS[pair].function(a, pose_a, b, pose_b)


def separation_of(pair, *arguments):
    """Deepest active separation, shape (1, W)."""
    manifold = call(pair, *arguments)
    best = manifold.points[0].separation
    for point in manifold.points[1:]:
        best = jnp.where(point.active & (point.separation < best), point.separation, best)
    return best


_compiled = {}


def compiled(function, pair):
    key = (function, pair, jax.config.jax_enable_x64)
    if key not in _compiled:
        _compiled[key] = jax.jit(lambda *arguments: function(pair, *arguments))
    return _compiled[key]


class Result:
    """A manifold as float64 NumPy arrays: normal (W, 3), position (W, P, 3), others (W, P)."""

    def __init__(self, pair, scene, dtype):
        count = len(scene["pb"])
        padded = jax.tree.map(lambda rows: np.resize(rows, (POSE_COUNT, *rows.shape[1:])), scene)  # one compilation
        manifold = compiled(call, pair)(*to_engine(padded, dtype))

        def full(array):
            return np.broadcast_to(np.asarray(array), (1, POSE_COUNT))[0, :count]

        self.normal = np.stack([full(c) for c in manifold.normal], -1).astype(float)
        self.position = np.stack([np.stack([full(c) for c in p.position], -1) for p in manifold.points], 1).astype(
            float
        )
        self.separation = np.stack([full(p.separation) for p in manifold.points], 1).astype(float)
        self.feature = np.stack([full(p.feature) for p in manifold.points], 1)
        self.active = np.stack([full(p.active) for p in manifold.points], 1)
        self.point_types = {p.separation.dtype for p in manifold.points} | {manifold.normal.x.dtype}
        self.feature_types = {p.feature.dtype for p in manifold.points}
        self.deepest = np.where(self.active, self.separation, np.inf).min(1)


# ---- oracles -----------------------------------------------------------------------------------------------------


def matrix(q):
    return Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()


def core(kind, shape, position, rotation):
    """Core of a round shape as centre, generators (columns, coefficients in [-1, 1]) and radius."""
    if kind == "sphere":
        return position, np.zeros((3, 0)), shape["radius"]
    if kind == "capsule":
        return position, rotation[:, 1:2] * shape["half_height"], shape["radius"]
    return position, rotation * shape["half_extents"], 0.0


def zonotope_depth(offset, generators):
    """Signed distance of the origin inside a zonotope: its facet normals are cross products of two generators."""
    best = -np.inf
    for first, second in itertools.combinations(generators.T, 2):
        axis = np.cross(first, second)
        length = np.linalg.norm(axis)
        if length > 1e-9 * np.linalg.norm(first) * np.linalg.norm(second):
            axis = axis / length
            best = max(best, abs(axis @ offset) - np.abs(axis @ generators).sum())
    return best


def oracle(pair, scene, index):
    """Exact signed distance of one pose."""
    sides = []
    for side, kind in zip("ab", pair, strict=True):
        shape = {name: value[index] for name, value in scene[side].items()}
        if kind != "plane":
            sides.append(core(kind, shape, scene["p" + side][index], matrix(scene["q" + side][index])))
    center, generators, radius = sides[-1]
    if pair[0] == "plane":
        normal, offset = scene["a"]["normal"][index], scene["a"]["offset"][index]
        return normal @ center - offset - np.abs(normal @ generators).sum() - radius
    other, other_generators, other_radius = sides[0]
    offset, spread, radii = center - other, np.hstack([generators, other_generators]), radius + other_radius
    if spread.shape[1] == 0:
        return np.linalg.norm(offset) - radii
    gap = np.sqrt(2 * lsq_linear(spread, -offset, (-1, 1), method="bvls", tol=1e-15).cost)
    if gap > 1e-7 or spread.shape[1] < 3:
        return gap - radii
    return zonotope_depth(offset, spread) - radii


def contact_size(pair, scene):
    """The length that scales tolerances: extent of the smaller body."""
    extents = []
    for side, kind in zip("ab", pair, strict=True):
        if kind != "plane":
            shape = scene[side]
            extents.append(
                shape["half_extents"].max(1) if kind == "box" else shape["radius"] + shape.get("half_height", 0.0)
            )
    return np.min(extents, axis=0)


_oracles = {}


def oracles(pair):
    if pair not in _oracles:
        scene = random_scene(pair)
        _oracles[pair] = (scene, np.array([oracle(pair, scene, k) for k in range(POSE_COUNT)]))
    return _oracles[pair]


def preference(pair, size, truth):
    """Allowance for the face preference of boxes: over-deep at most, never when clearly apart."""
    if "box" not in pair or pair[0] in ("plane", "sphere"):
        return np.zeros_like(truth)
    depth = np.maximum(-truth, 0.0)
    allowance = (2 * FACE_MARGIN * size + EDGE_SHARE * depth) / (1 - EDGE_SHARE)
    return np.where(truth > 2e-2 * size, 0.0, allowance)


def signed_distance_to(kind, shape, position, rotation, point):
    """Signed distance of a world point, negative inside."""
    if kind == "plane":
        return shape["normal"] @ point - shape["offset"]
    local = rotation.T @ (point - position)
    if kind == "sphere":
        return np.linalg.norm(local) - shape["radius"]
    if kind == "capsule":
        local[1] -= np.clip(local[1], -shape["half_height"], shape["half_height"])
        return np.linalg.norm(local) - shape["radius"]
    excess = np.abs(local) - shape["half_extents"]
    return np.linalg.norm(np.maximum(excess, 0)) + min(excess.max(), 0.0)


# ---- tests -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pair", PAIR_NAMES, ids=IDS)
def test_separation_against_oracle(pair, precision):
    scene, truth = oracles(pair)
    assert 0.1 < (truth < 0).mean() < 0.95  # both regimes are there
    result, size = Result(pair, scene, precision), contact_size(pair, scene)
    tolerance = (1e-9 if precision == np.float64 else 5e-6) * (1 + size)
    error = result.deepest - truth
    if pair != ("capsule", "box"):  # capsules: a face contact is read off the face plane within 0.01 rad of it
        assert np.all(error <= tolerance)
    assert np.all(error <= tolerance + 1e-4 * np.abs(truth + size))
    assert np.all(error >= -tolerance - preference(pair, size, truth))


@pytest.mark.parametrize("pair", PAIR_NAMES, ids=IDS)
def test_touching_poses(pair, precision):
    """B moved along the normal until the shapes touch: the gap must be that, whatever the features."""
    scene, truth = oracles(pair)
    result, size = Result(pair, scene, precision), contact_size(pair, scene)
    direct = np.abs(result.deepest - truth) < 1e-5  # the normal is that of the true distance
    assert direct.mean() > 0.75
    gap = 1e-3 * size
    moved = dict(scene, pb=scene["pb"] + result.normal * (gap - truth)[:, None])
    expected = np.array([oracle(pair, moved, k) for k in np.flatnonzero(direct)])
    measured = Result(pair, moved, precision).deepest[direct]
    np.testing.assert_allclose(expected, gap[direct], atol=2e-5)
    allowance = preference(pair, size, np.zeros_like(truth))[direct] if "box" in pair else 0.0
    assert np.all(measured - expected < 2e-5)
    assert np.all(measured - expected > -2e-5 - allowance)


@pytest.mark.parametrize("pair", PAIR_NAMES, ids=IDS)
def test_witness_points_lie_on_the_shapes(pair, precision):
    scene, _ = oracles(pair)
    result, size = Result(pair, scene, precision), contact_size(pair, scene)
    np.testing.assert_allclose(np.linalg.norm(result.normal, axis=1), 1.0, atol=1e-5)
    assert result.position.shape[1] == PAIRS[pair].point_count
    assert result.point_types == {precision}
    assert result.feature_types == {np.dtype("int32")}
    assert np.isfinite(result.position).all()
    assert np.isfinite(result.separation).all()
    for index in range(0, POSE_COUNT, 3):
        poses = {
            side: (
                {name: value[index] for name, value in scene[side].items()},
                scene["p" + side][index],
                matrix(scene["q" + side][index]),
            )
            for side in "ab"
        }
        slots = np.flatnonzero(result.active[index])
        if "capsule" in pair:  # the second point of a tilted capsule lies under its skin
            slots = [slots[np.argmin(result.separation[index, slots])]]
        for slot in slots:
            half_gap = 0.5 * result.separation[index, slot] * result.normal[index]
            for side, kind, sign in (("a", pair[0], -1.0), ("b", pair[1], 1.0)):
                point = result.position[index, slot] + sign * half_gap
                # Slack: the clipping rectangle is widened by 1e-3 of the size.
                tolerance = 1e-5 + (2.5e-3 * size[index] if pair[1] == "box" and pair[0] in ("capsule", "box") else 0)
                assert abs(signed_distance_to(kind, *poses[side], point)) < tolerance, (index, slot, side)


@pytest.mark.parametrize("pair", PAIR_NAMES, ids=IDS)
def test_rigid_motion_invariance(pair, float64):
    scene, _ = oracles(pair)
    turn, shift = Rotation.from_rotvec([0.3, -1.1, 0.7]), np.array([0.4, -2.0, 1.3])

    def quaternions(q):
        return (turn * Rotation.from_quat(q[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]

    moved = dict(scene)
    for side in "ab":
        moved["p" + side], moved["q" + side] = turn.apply(scene["p" + side]) + shift, quaternions(scene["q" + side])
    if pair[0] == "plane":
        normal = turn.apply(scene["a"]["normal"])
        moved["a"] = {"normal": normal, "offset": scene["a"]["offset"] + normal @ shift}
    before, after = Result(pair, scene, float64), Result(pair, moved, float64)
    np.testing.assert_allclose(after.normal, turn.apply(before.normal), atol=1e-9)
    np.testing.assert_allclose(after.deepest, before.deepest, atol=1e-9)
    np.testing.assert_array_equal(after.feature * after.active, before.feature * before.active)
    points = turn.apply(before.position.reshape(-1, 3)).reshape(before.position.shape) + shift
    np.testing.assert_allclose((after.position - points) * after.active[..., None], 0.0, atol=1e-9)


@pytest.mark.parametrize("kind", ["sphere", "capsule", "box"])
def test_swapping_the_bodies_mirrors_the_contact(kind, float64):
    pair = (kind, kind)
    scene, truth = oracles(pair)
    swapped = {
        "a": scene["b"],
        "b": scene["a"],
        "pa": scene["pb"],
        "pb": scene["pa"],
        "qa": scene["qb"],
        "qb": scene["qa"],
    }
    result, mirror = Result(pair, scene, float64), Result(pair, swapped, float64)
    allowance = preference(pair, contact_size(pair, scene), truth)
    assert np.all(np.abs(result.deepest - mirror.deepest) <= 1e-9 + allowance)
    same = np.abs(result.deepest - mirror.deepest) < 1e-9
    assert same.mean() > 0.7
    np.testing.assert_allclose(mirror.normal[same], -result.normal[same], atol=1e-7)


def perturbations(arguments):
    """Unit changes of the pose of either body, as (index of the argument, component)."""
    return (
        [(1, k) for k in range(3)]
        + [(4, k) for k in range(3)]
        + [(2, k) for k in range(4)]
        + [(5, k) for k in range(4)]
    )


@pytest.mark.parametrize("pair", PAIR_NAMES, ids=IDS)
def test_derivative_against_central_differences(pair, float64):
    scene, _ = oracles(pair)
    arguments = list(to_engine(scene, float64))
    gradient = jax.jit(jax.grad(lambda *x: separation_of(pair, *x).sum(), argnums=(0, 1, 2, 3, 4, 5)))(*arguments)
    value = compiled(separation_of, pair)
    step, compared = 1e-6, 0

    def check(index, leaf, derivative):
        nonlocal compared
        leaves, tree = jax.tree.flatten(arguments[index])
        sides = []
        for sign in (-1, 1):
            moved = list(leaves)
            moved[leaf] = moved[leaf] + sign * step
            changed = list(arguments)
            changed[index] = jax.tree.unflatten(tree, moved)
            sides.append(np.asarray(value(*changed)))
        here = np.asarray(value(*arguments))
        smooth = np.abs(sides[0] + sides[1] - 2 * here) < 1e-9  # no change of feature within the step
        assert smooth.mean() > 0.9
        assert np.isfinite(derivative).all()
        error = np.abs((sides[1] - sides[0]) / (2 * step) - np.asarray(derivative))
        assert np.quantile(error[smooth], 0.99) < 1e-6
        compared += 1

    for index in range(6):
        for leaf, derivative in enumerate(jax.tree.leaves(gradient[index])):
            check(index, leaf, derivative)
    assert compared >= 15


def fixed_scene(pair, offsets, rotations_a, rotations_b, size=0.5):
    """One row for every given offset and pair of rotations; all sizes equal."""
    count = len(offsets)
    values = {
        "radius": np.full(count, size),
        "half_height": np.full(count, size),
        "half_extents": np.full((count, 3), size),
    }
    values["normal"], values["offset"] = np.tile([0.0, 1.0, 0.0], (count, 1)), np.zeros(count)
    return {
        "a": {name: values[name] for name in PARAMETERS[pair[0]]},
        "b": {name: values[name] for name in PARAMETERS[pair[1]]},
        "pa": np.zeros((count, 3)),
        "pb": np.array(offsets, float),
        "qa": np.array([r.as_quat()[[3, 0, 1, 2]] for r in rotations_a]),
        "qb": np.array([r.as_quat()[[3, 0, 1, 2]] for r in rotations_b]),
    }


@pytest.mark.parametrize("pair", PAIR_NAMES, ids=IDS)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_degenerate_poses_stay_finite_and_right(pair, precision):
    """Coincident centres, parallel and crossing axes, exact touch of faces, edges and corners, tilts to nothing."""
    turns = [Rotation.identity()]
    turns += [
        Rotation.from_rotvec(angle * np.eye(3)[k])
        for angle in (1e-12, 1e-6, 1e-3, np.pi / 4, np.pi / 2)
        for k in (0, 2)
    ]
    offsets = [(0, 0, 0), (1e-9, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (1, 1, 1), (0, 1.5, 0), (0.5, 0, 0), (0, 2, 0)]
    table = list(itertools.product(offsets, turns))
    scene = fixed_scene(pair, [o for o, _ in table], [Rotation.identity()] * len(table), [t for _, t in table])
    result, size = Result(pair, scene, precision), 0.5
    np.testing.assert_allclose(np.linalg.norm(result.normal, axis=1), 1.0, atol=1e-5)
    truth = np.array([oracle(pair, scene, k) for k in range(len(table))])
    tolerance = 1e-6 if precision == np.float64 else 1e-5
    assert np.all(result.deepest - truth < tolerance + (1e-4 if pair == ("capsule", "box") else 0.0))
    allowance = preference(pair, np.full(len(table), size), np.minimum(truth, 0.0)) * np.ones(len(table))
    assert np.all(result.deepest - truth > -tolerance - allowance)

    def everything(*arguments):
        manifold = call(pair, *arguments)
        return sum(
            jnp.sum(x)
            for x in jax.tree.leaves((manifold.normal, [(p.position, p.separation) for p in manifold.points]))
        )

    gradient = jax.jit(jax.grad(everything, argnums=tuple(range(6))))(*to_engine(scene, precision))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient))


def active_features(result):
    return [tuple(sorted(f[a])) for f, a in zip(result.feature, result.active, strict=True)]


def stack_scene(count, tilt, shift, seed=0, turn=0.0, half_b=0.5):
    rng = np.random.default_rng(seed)
    offsets = np.array([0.0, 0.998, 0.0]) + shift * rng.normal(size=(count, 3))
    tilts = [Rotation.from_rotvec(tilt * rng.normal(size=3)) * Rotation.from_rotvec([0, turn, 0]) for _ in range(count)]
    scene = fixed_scene(("box", "box"), offsets, [Rotation.identity()] * count, tilts)
    scene["b"]["half_extents"] = np.full((count, 3), half_b)
    scene["pb"][:, 1] += half_b - 0.5
    return scene


@pytest.mark.parametrize("half_b", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("tilt", [0.0, 1e-6, 1e-3])
def test_box_stack_has_four_corners(tilt, half_b, precision):
    result = Result(("box", "box"), stack_scene(64, tilt, 1e-5, half_b=half_b), precision)
    assert result.active.all()
    side = 2 * min(half_b, 0.5)
    for points in result.position[:, :, [0, 2]]:
        assert ConvexHull(points).volume == pytest.approx(side**2, rel=1e-2)  # the area, in 2-D
    assert np.abs(result.normal - [0, 1, 0]).max() < 5e-3


@pytest.mark.parametrize(("turn", "half_b"), [(0.0, 0.5), (0.0, 0.3), (0.0, 0.8), (0.4, 0.5), (0.7, 0.45)])
def test_features_persist_in_a_resting_stack(turn, half_b, precision):
    tremor = 1e-7 if turn else 1e-6  # an octagon offers near ties, which larger tremors do tip
    result = Result(("box", "box"), stack_scene(128, tremor, 1e-5, turn=turn, half_b=half_b), precision)
    features = active_features(result)
    assert len(set(features[0])) == len(features[0]) == 4
    assert sum(f == features[0] for f in features) >= 0.99 * len(features)


def test_features_do_not_depend_on_the_reference_box(float64):
    """A small box on a large one keeps its corners' ids whichever box's face is the reference (A=0..7, B=8..15)."""
    scene = stack_scene(8, 0.0, 0.0, half_b=0.3)
    result = Result(("box", "box"), scene, float64)
    assert active_features(result)[0] == tuple(sorted(8 + x + 4 * z for x in (0, 1) for z in (0, 1)))
    swapped = {
        "a": scene["b"],
        "b": scene["a"],
        "pa": scene["pb"],
        "pb": scene["pa"],
        "qa": scene["qb"],
        "qb": scene["qa"],
    }
    mirror = Result(("box", "box"), swapped, float64)
    assert active_features(mirror)[0] == tuple(sorted(x + 4 * z for x in (0, 1) for z in (0, 1)))
    assert np.allclose(mirror.normal, -result.normal)


def test_crossed_edges_meet_in_one_point(float64):
    across = Rotation.from_rotvec([np.pi / 4, 0, 0]), Rotation.from_rotvec([0, 0, np.pi / 4])
    reach = np.sqrt(0.5)  # from the centre of a unit cube to an edge
    scene = fixed_scene(
        ("box", "box"), [(0, 2 * reach - 0.01, 0), (0, 2 * reach + 0.01, 0)], [across[0]] * 2, [across[1]] * 2
    )
    result = Result(("box", "box"), scene, float64)
    np.testing.assert_array_equal(result.active.sum(1), 1)
    np.testing.assert_allclose(result.deepest, [-0.01, 0.01], atol=1e-12)
    np.testing.assert_allclose(result.normal, [[0, 1, 0]] * 2, atol=1e-12)
    np.testing.assert_allclose(result.position[:, 0, 1], [reach - 0.005, reach + 0.005], atol=1e-12)
    assert result.feature[0, 0] == result.feature[1, 0] >= 16


@pytest.mark.parametrize("pair", [("capsule", "capsule"), ("capsule", "box")], ids=str)
@pytest.mark.parametrize("tilt", [0.0, 1e-6, 1e-3])
def test_lying_capsule_has_two_points(pair, tilt, precision):
    """A capsule along the other's axis (or a face): contacts at both ends, with steady features."""
    rng = np.random.default_rng(3)
    height = 0.99 if pair[1] == "capsule" else -0.99
    offsets = np.array([0.0, 0.0, height]) + 1e-6 * rng.normal(size=(32, 3)) + np.array([0, 0.3, 0])
    tilts = [Rotation.from_rotvec(tilt * rng.normal(size=3)) for _ in range(32)]
    scene = fixed_scene(pair, offsets, [Rotation.identity()] * 32, tilts)
    result = Result(pair, scene, precision)
    assert result.active.all()
    np.testing.assert_allclose(np.ptp(result.position[:, :, 1], axis=1), 0.7, atol=5e-3)
    assert len(set(active_features(result))) == 1
    assert len(set(active_features(result)[0])) == 2


@pytest.mark.parametrize("pair", PAIR_NAMES, ids=IDS)
def test_parameters_of_one_world_broadcast(pair, float64):
    """Sizes shared by all worlds have a world axis of 1."""
    scene = random_scene(pair)
    for side in "ab":
        scene[side] = {name: np.repeat(value[:1], POSE_COUNT, axis=0) for name, value in scene[side].items()}
    arguments = to_engine(scene, float64)
    shared = list(arguments)
    for index in (0, 3):
        shared[index] = jax.tree.map(lambda x: x[:, :1], arguments[index])
    ours, full = compiled(call, pair)(*shared), compiled(call, pair)(*arguments)
    for point, expected in zip(ours.points, full.points, strict=True):
        gaps = [np.broadcast_to(p.separation, (1, POSE_COUNT)) for p in (point, expected)]
        np.testing.assert_allclose(*gaps, atol=1e-9)
