"""Closed-form pairs with cylinders, cones and polyhedra against float64 oracles: dense search over directions for the
round shapes (a signed distance is the largest gap over all directions), enumeration of features for polyhedra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from mathota_jax.collision.pairs.plane_box import plane_box
from mathota_jax.collision.pairs.plane_cone import plane_cone
from mathota_jax.collision.pairs.plane_cylinder import plane_cylinder
from mathota_jax.collision.pairs.plane_polyhedron import plane_polyhedron
from mathota_jax.collision.pairs.sphere_box import sphere_box
from mathota_jax.collision.pairs.sphere_cone import sphere_cone
from mathota_jax.collision.pairs.sphere_cylinder import sphere_cylinder
from mathota_jax.collision.pairs.sphere_polyhedron import sphere_polyhedron
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, normalize, to_matrix
from mathota_jax.spatial.vector import Vec3
from tests.hulls import BOX_CORNERS, hull, point_to_hull
from tests.marks import QUICK_AND_SLOW_PRECISION

FUNCTIONS = {
    ("plane", "cylinder"): plane_cylinder,
    ("plane", "cone"): plane_cone,
    ("plane", "polyhedron"): plane_polyhedron,
    ("sphere", "cylinder"): sphere_cylinder,
    ("sphere", "cone"): sphere_cone,
    ("sphere", "polyhedron"): sphere_polyhedron,
    ("plane", "box"): plane_box,
    ("sphere", "box"): sphere_box,
}
PAIRS = [pair for pair in FUNCTIONS if pair[1] != "box"]
IDS = ["_".join(pair) for pair in PAIRS]
COUNT = 256


# ---- scenes: one pair, one pose a row; polyhedra share their vertices between the rows -----------------------------


def shapes(pair, rng, count, scale=1.0):
    """Parameters of both shapes in natural arrays."""
    first = {"offset": rng.normal(size=count) * 0.3} if pair[0] == "plane" else {"radius": rng.uniform(0.2, 0.6, count)}
    if pair[0] == "plane":
        normal = rng.normal(size=(count, 3))
        first["normal"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    if pair[1] == "polyhedron":
        points = rng.normal(size=(16, 3))
        vertices, faces = hull(points / np.linalg.norm(points, axis=1, keepdims=True) * [0.9, 0.6, 0.4] * scale)
        return first, {"vertices": vertices, "faces": faces}
    return first, {"radius": rng.uniform(0.2, 0.8, count) * scale, "half_height": rng.uniform(0.2, 0.8, count) * scale}


def random_scene(pair, count=COUNT, seed=1):
    rng = np.random.default_rng(seed)
    first, second = shapes(pair, rng, count)
    anchor = first["normal"] * first["offset"][:, None] if pair[0] == "plane" else rng.normal(size=(count, 3))
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return {
        "a": first,
        "b": second,
        "pa": anchor if pair[0] == "sphere" else np.zeros((count, 3)),
        "pb": anchor + direction * rng.uniform(0.0, 1.8, (count, 1)),
        "q": Rotation.random(count, random_state=rng).as_quat()[:, [3, 0, 1, 2]],
    }


def rows(values, dtype):
    return Vec3(*(jnp.asarray(values[None, :, k], dtype) for k in range(3)))


def engine(parameters, dtype):
    """Worlds-last floating parameters of a shape (the faces are a constant, see `call`)."""
    found = {}
    for name, value in parameters.items():
        if name == "vertices":
            found[name] = Vec3(*(jnp.asarray(value[:, None, None, k], dtype) for k in range(3)))
        elif name != "faces":
            found[name] = rows(value, dtype) if value.ndim == 2 else jnp.asarray(value[None], dtype)
    return found


def arguments(scene, dtype):
    q = Quaternion(*(jnp.asarray(scene["q"][None, :, k], dtype) for k in range(4)))
    return engine(scene["a"], dtype), rows(scene["pa"], dtype), engine(scene["b"], dtype), rows(scene["pb"], dtype), q


def call(pair, faces, a, pa, b, pb, q):
    if faces is not None:
        b = dict(b, faces=faces[None])
    return FUNCTIONS[pair](a, Pose(pa), b, Pose(pb, to_matrix(normalize(q))))


def separation_of(pair, faces, *values):
    manifold = call(pair, faces, *values)
    best = manifold.points[0].separation
    for point in manifold.points[1:]:
        best = jnp.where(point.active & (point.separation < best), point.separation, best)
    return best


class Result:
    """A manifold as float64 NumPy arrays: normal (W, 3), position (W, P, 3), others (W, P)."""

    def __init__(self, pair, scene, dtype):
        manifold = jax.jit(lambda *x: call(pair, scene["b"].get("faces"), *x))(*arguments(scene, dtype))
        shape = (1, len(scene["pb"]))

        def full(array):
            return np.broadcast_to(np.asarray(array), shape)[0]

        self.normal = np.stack([full(c) for c in manifold.normal], -1).astype(float)
        positions = [np.stack([full(c) for c in p.position], -1) for p in manifold.points]
        self.position = np.stack(positions, 1).astype(float)
        self.separation = np.stack([full(p.separation) for p in manifold.points], 1).astype(float)
        self.feature = np.stack([full(p.feature) for p in manifold.points], 1)
        self.active = np.stack([full(p.active) for p in manifold.points], 1)
        self.deepest = np.where(self.active, self.separation, np.inf).min(1)
        assert {p.separation.dtype for p in manifold.points} | {manifold.normal.x.dtype} == {dtype}
        assert {p.feature.dtype for p in manifold.points} == {np.dtype("int32")}

    def features(self):
        return [tuple(sorted(f[a])) for f, a in zip(self.feature, self.active, strict=True)]


def turned(quaternion):
    return Rotation.from_quat(quaternion[..., [1, 2, 3, 0]])


# ---- oracles -----------------------------------------------------------------------------------------------------


def profile(kind, radius, half_height):
    """Corners (distance from the axis, height) whose turn about the axis has the shape as its hull."""
    if kind == "cylinder":
        return np.array([[radius, -half_height], [radius, half_height]])
    return np.array([[radius, -0.5 * half_height], [0.0, 1.5 * half_height]])


def round_distance(point, corners):
    """Signed distance of a point (distance from the axis, height) to a turned profile: the largest gap over directions."""

    def gap(angle):
        direction = np.array([np.cos(angle), np.sin(angle)])
        return direction @ point - (corners @ direction).max()

    grid = np.linspace(-np.pi / 2, np.pi / 2, 721)
    best = max(range(len(grid)), key=lambda k: gap(grid[k]))
    bounds = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    fine = minimize_scalar(lambda angle: -gap(angle), bounds=bounds, method="bounded", options={"xatol": 1e-13})
    # Kinks: normals of the flat parts of the profile.
    edge = corners[1] - corners[0]
    return max(-fine.fun, gap(np.pi / 2), gap(-np.pi / 2), gap(np.arctan2(-edge[0], edge[1])))


def oracle(pair, scene, index):
    shape, rotation = scene["b"], turned(scene["q"][index])
    if pair[0] == "plane":
        normal = scene["a"]["normal"][index]
        height = normal @ scene["pb"][index] - scene["a"]["offset"][index]
        local = rotation.inv().apply(normal)
        if pair[1] == "polyhedron":
            return height + (shape["vertices"] @ local).min()
        corners = profile(pair[1], shape["radius"][index], shape["half_height"][index])
        angles = np.linspace(0, 2 * np.pi, 7)[:-1] + np.arctan2(local[2], local[0])  # one of them is the lowest
        rim = np.stack([np.cos(angles), np.sin(angles)])
        return height + min((r * (local[[0, 2]] @ rim)).min() + y * local[1] for r, y in corners)
    local = rotation.inv().apply(scene["pa"][index] - scene["pb"][index])
    radius = scene["a"]["radius"][index]
    if pair[1] == "polyhedron":
        return point_to_hull(local, shape["vertices"], shape["faces"]) - radius
    corners = profile(pair[1], shape["radius"][index], shape["half_height"][index])
    return round_distance(np.array([np.hypot(local[0], local[2]), local[1]]), corners) - radius


_truths = {}


def known(pair):
    """The random scene of a pair and its truth, computed once."""
    if pair not in _truths:
        scene = random_scene(pair)
        _truths[pair] = scene, np.array([oracle(pair, scene, k) for k in range(COUNT)])
    return _truths[pair]


# ---- tests -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pair", PAIRS, ids=IDS)
def test_separation_against_oracle(pair, precision):
    scene, truth = known(pair)
    assert 0.1 < (truth < 0).mean() < 0.95  # both regimes are there
    result = Result(pair, scene, precision)
    np.testing.assert_allclose(result.deepest, truth, atol=1e-9 if precision == np.float64 else 3e-6)
    np.testing.assert_allclose(np.linalg.norm(result.normal, axis=1), 1.0, atol=1e-5)
    assert np.isfinite(result.position).all()


@pytest.mark.parametrize("pair", PAIRS, ids=IDS)
def test_moving_along_the_normal_separates(pair, float64):
    """The normal is the direction of the shortest way out: moving B by the depth makes the shapes touch, no more."""
    scene, truth = known(pair)
    result = Result(pair, scene, float64)
    moved = dict(scene, pb=scene["pb"] - result.normal * truth[:, None])
    rest = np.array([oracle(pair, moved, k) for k in range(0, COUNT, 4)])
    np.testing.assert_allclose(rest, 0.0, atol=1e-8)


@pytest.mark.parametrize("pair", PAIRS, ids=IDS)
def test_points_lie_midway_between_the_surfaces(pair, float64):
    """Each active point, moved by half the gap, is on the surface of B; the other way on that of A."""
    scene, _ = known(pair)
    result = Result(pair, scene, float64)
    for index in range(0, COUNT, 4):
        for slot in np.flatnonzero(result.active[index]):
            half_gap = 0.5 * result.separation[index, slot] * result.normal[index]
            on_a, on_b = result.position[index, slot] - half_gap, result.position[index, slot] + half_gap
            if pair[0] == "plane":
                distance = scene["a"]["normal"][index] @ on_a - scene["a"]["offset"][index]
            else:
                distance = np.linalg.norm(on_a - scene["pa"][index]) - scene["a"]["radius"][index]
            assert abs(distance) < 1e-9
            point = dict(scene)
            point["pa"] = np.broadcast_to(on_b, scene["pa"].shape)
            point["a"] = {"radius": np.zeros(COUNT)}
            assert abs(oracle(("sphere", pair[1]), point, index)) < 1e-8


@pytest.mark.parametrize("pair", PAIRS, ids=IDS)
def test_rigid_motion_invariance(pair, float64):
    scene, _ = known(pair)
    turn, shift = Rotation.from_rotvec([0.3, -1.1, 0.7]), np.array([0.4, -2.0, 1.3])
    moved = dict(scene, q=(turn * turned(scene["q"])).as_quat()[:, [3, 0, 1, 2]])
    moved["pa"], moved["pb"] = turn.apply(scene["pa"]) + shift, turn.apply(scene["pb"]) + shift
    if pair[0] == "plane":
        normal = turn.apply(scene["a"]["normal"])
        moved["a"] = {"normal": normal, "offset": scene["a"]["offset"] + normal @ shift}
    before, after = Result(pair, scene, float64), Result(pair, moved, float64)
    np.testing.assert_allclose(after.normal, turn.apply(before.normal), atol=1e-9)
    np.testing.assert_allclose(after.separation, before.separation, atol=1e-9)
    np.testing.assert_array_equal(after.feature, before.feature)
    points = turn.apply(before.position.reshape(-1, 3)).reshape(before.position.shape) + shift
    np.testing.assert_allclose(after.position, points, atol=1e-9)


@pytest.mark.parametrize("pair", PAIRS, ids=IDS)
def test_derivative_against_central_differences(pair, float64):
    """Separation with respect to both poses and every size, vertices included."""
    scene, _ = known(pair)
    values = list(arguments(scene, float64))
    faces = scene["b"].get("faces")
    value = jax.jit(lambda *x: separation_of(pair, faces, *x))
    gradient = jax.jit(jax.grad(lambda *x: separation_of(pair, faces, *x).sum(), argnums=tuple(range(5))))(*values)
    here, step, compared = np.asarray(value(*values)), 1e-6, 0
    for index in range(5):
        leaves, tree = jax.tree.flatten(values[index])
        for leaf, derivative in enumerate(jax.tree.leaves(gradient[index])):
            assert np.isfinite(derivative).all()
            shared = leaves[leaf].shape[0] != 1 or leaves[leaf].shape[-1] == 1  # vertices: one at a time
            for row in range(leaves[leaf].shape[0]) if shared else [...]:
                sides = []
                for sign in (-1, 1):
                    changed = list(values)
                    moved = list(leaves)
                    moved[leaf] = leaves[leaf].at[row].add(sign * step)
                    changed[index] = jax.tree.unflatten(tree, moved)
                    sides.append(np.asarray(value(*changed)))
                smooth = np.abs(sides[0] + sides[1] - 2 * here) < 1e-9  # no change of feature within the step
                assert smooth.mean() > 0.9
                difference = (sides[1] - sides[0]) / (2 * step)
                if shared:
                    if smooth.all():
                        assert abs(difference.sum() - np.asarray(derivative)[row].sum()) < 1e-5
                        compared += 1
                else:
                    error = np.abs(difference - np.asarray(derivative))[smooth]
                    assert np.quantile(error, 0.99) < 1e-6
                    compared += 1
    assert compared >= 12


def fixed_scene(pair, offsets, turns, size=0.5, points=None):
    count = len(offsets)
    full = np.full(count, size)
    b = {"radius": full, "half_height": full, "half_extents": np.full((count, 3), size)}
    b = {name: b[name] for name in {"box": ("half_extents",)}.get(pair[1], ("radius", "half_height"))}
    if pair[1] == "polyhedron":
        vertices, faces = hull(BOX_CORNERS * size if points is None else points)
        b = {"vertices": vertices, "faces": faces}
    plane = {"normal": np.tile([0.0, 1.0, 0.0], (count, 1)), "offset": np.zeros(count)}
    return {
        "a": plane if pair[0] == "plane" else {"radius": full},
        "b": b,
        "pa": np.zeros((count, 3)),
        "pb": np.array(offsets, float),
        "q": np.array([turn.as_quat()[[3, 0, 1, 2]] for turn in turns]),
    }


DEGENERATE_OFFSETS = [
    (0, 0, 0), (1e-9, 0, 0), (0, 0.5, 0), (0, -0.5, 0), (0.5, 0, 0), (0.5, 0.5, 0), (0.5, -0.5, 0), (0.5, 0.25, 0),
    (0, 0.25, 0), (0, -0.75, 0), (0, -1, 0), (0, 1, 0), (0.5, 0.5, 0.5), (1, 1, 1), (0, 1e-12, 0), (0, 0.125, 0),
]  # fmt: skip
DEGENERATE_TURNS = [Rotation.identity()] + [
    Rotation.from_rotvec(angle * np.eye(3)[k]) for angle in (1e-12, 1e-6, np.pi / 2, np.pi) for k in (0, 2)
]


@pytest.mark.parametrize("pair", PAIRS, ids=IDS)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_degenerate_poses_stay_finite_and_right(pair, precision):
    """Centre on the axis, on the rim, at the apex, on a face, an edge or a corner; axes upright and lying."""
    table = [(o, t) for o in DEGENERATE_OFFSETS for t in DEGENERATE_TURNS]
    scene = fixed_scene(pair, [o for o, _ in table], [t for _, t in table])
    result = Result(pair, scene, precision)
    truth = np.array([oracle(pair, scene, k) for k in range(len(table))])
    # A tilt of 1e-12 is below that at which the deepest rim point counts; 1e-6 is above.
    np.testing.assert_allclose(result.deepest, truth, atol=1e-8 if precision == np.float64 else 2e-6)
    np.testing.assert_allclose(np.linalg.norm(result.normal, axis=1), 1.0, atol=1e-5)

    def everything(*values):
        manifold = call(pair, scene["b"].get("faces"), *values)
        fields = (manifold.normal, [(p.position, p.separation) for p in manifold.points])
        return sum(jnp.sum(x) for x in jax.tree.leaves(fields))

    values = arguments(scene, precision)
    gradient = jax.jit(jax.grad(everything, argnums=tuple(range(5))))(*values)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient))
    if precision == np.float64:
        slope = jax.jit(lambda *x: jax.jvp(jax.grad(everything, argnums=3), x, x)[1])(*values)
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(slope))


@pytest.mark.parametrize("first", ["plane", "sphere"])
def test_polyhedral_box_is_a_box(first, precision):
    """The corners of a box as a polyhedron give the manifold of the box."""
    rng = np.random.default_rng(4)
    turns = [Rotation.from_rotvec(0.08 * rng.uniform(-1, 1, 3)) for _ in range(64)]
    if first == "sphere":
        turns = list(Rotation.random(64, random_state=rng))
    offsets = rng.normal(size=(64, 3)) * 0.4 + [0, 0.5, 0]
    ours = Result((first, "polyhedron"), fixed_scene((first, "polyhedron"), offsets, turns), precision)
    box = Result((first, "box"), fixed_scene((first, "box"), offsets, turns), precision)
    tolerance = 1e-6 if precision == np.float64 else 1e-5
    np.testing.assert_allclose(ours.normal, box.normal, atol=tolerance)
    assert (ours.active == box.active).all()
    for mine, other in zip(ours.position, box.position, strict=True):
        gaps = np.linalg.norm(mine[:, None] - other[None], axis=-1)
        assert gaps.min(0).max() < tolerance
        assert gaps.min(1).max() < tolerance


def support_holds_the_centre(result, index, center=(0.0, 0.0)):
    """Whether the ground point below the centre is inside the hull of the active contacts, and its area."""
    points = result.position[index][result.active[index]][:, [0, 2]]
    found = ConvexHull(points)
    return (found.equations[:, :2] @ np.asarray(center) + found.equations[:, 2] < 0).all(), found.volume


HEXAGON = np.array([[np.cos(a), y, np.sin(a)] for a in np.arange(6) * np.pi / 3 for y in (-1, 1)]) * 0.5
STANDING = [
    (("plane", "cylinder"), None, 0.5, 2 * 0.5**2),
    (("plane", "cone"), None, 0.25, 2 * 0.5**2),
    (("plane", "polyhedron"), None, 0.5, 1.0),
    (("plane", "polyhedron"), HEXAGON, 0.5, 0.43),
]


@pytest.mark.parametrize(("pair", "points", "height", "area"), STANDING, ids=["cylinder", "cone", "box", "hexagon"])
@pytest.mark.parametrize("tilt", [0.0, 1e-8, 1e-7, 1e-6, 1e-3])
def test_standing_shapes_have_four_points(pair, points, height, area, tilt, precision):
    rng = np.random.default_rng(5)
    turns = [Rotation.from_rotvec(tilt * rng.normal(size=3)) for _ in range(32)]
    scene = fixed_scene(pair, np.tile([0, height - 1e-3, 0], (32, 1)), turns, points=points)
    result = Result(pair, scene, precision)
    assert result.active.all()
    for index in range(32):
        inside, found = support_holds_the_centre(result, index)
        assert inside
        assert found > 0.99 * area
    np.testing.assert_allclose(result.separation, -1e-3, atol=1e-6 + 2 * tilt)


@pytest.mark.parametrize("pair", [("plane", "cylinder"), ("plane", "cone")], ids=str)
@pytest.mark.parametrize("tilt", [0.0, 1e-7, 1e-3])
def test_lying_shapes_touch_along_the_generator(pair, tilt, precision):
    rng = np.random.default_rng(6)
    lean = 0.0 if pair[1] == "cylinder" else np.arctan2(0.5, 1.0)  # the cone's side lies flat
    turns = [
        Rotation.from_rotvec(tilt * rng.normal(size=3))
        * Rotation.from_rotvec([np.pi / 2 + lean, 0, 0])
        * Rotation.from_rotvec([0, roll, 0])
        for roll in rng.uniform(0, 6, 32)
    ]
    scene = fixed_scene(pair, np.zeros((32, 3)), turns)
    result = Result(pair, scene, precision)
    assert (result.active.sum(1) == 2).all()
    gaps = result.separation[result.active].reshape(32, 2)
    np.testing.assert_allclose(gaps[:, 0], gaps[:, 1], atol=1e-6 + 4 * tilt)
    ends = result.position[result.active].reshape(32, 2, 3)
    length = 1.0 if pair[1] == "cylinder" else np.hypot(0.5, 1.0)
    np.testing.assert_allclose(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), length, atol=4e-3)


@pytest.mark.parametrize("pair", [("plane", "cylinder"), ("plane", "cone")], ids=str)
def test_rolling_moves_the_points_continuously(pair, float64):
    """A rim that rolls round: the set of points moves by at most the turn, whichever quadrant is lowest."""
    angles = np.linspace(0, 2 * np.pi, 721)
    turns = [Rotation.from_rotvec(0.1 * np.array([np.cos(a), 0, np.sin(a)])) for a in angles]
    result = Result(pair, fixed_scene(pair, np.zeros((721, 3)), turns), float64)
    assert result.active.all()
    for before, after in zip(result.position[:-1], result.position[1:], strict=True):
        gaps = np.linalg.norm(before[:, None] - after[None], axis=-1)
        assert gaps.min(1).max() < 1.2 * 0.5 * (angles[1] - angles[0])
        assert gaps.min(0).max() < 1.2 * 0.5 * (angles[1] - angles[0])


@pytest.mark.parametrize(("pair", "points", "height", "area"), STANDING, ids=["cylinder", "cone", "box", "hexagon"])
def test_features_persist_in_a_tremor(pair, points, height, area, precision):
    rng = np.random.default_rng(7)
    tremor = 1e-6 if precision == np.float32 else 1e-8
    turns = [Rotation.from_rotvec(tremor * rng.normal(size=3)) for _ in range(256)]
    result = Result(pair, fixed_scene(pair, np.tile([0, height, 0], (256, 1)), turns, points=points), precision)
    features = result.features()
    assert len(set(features[0])) == 4
    assert sum(f == features[0] for f in features) >= 0.99 * len(features)
    # ... and the points that bear these ids stay where they are: within the quarter turn of their quadrant.
    order = np.argsort(result.feature, axis=1)
    points = np.take_along_axis(result.position, order[..., None], axis=1)
    assert np.linalg.norm(points - points[:1], axis=-1).max() < (1e-4 if pair[1] == "polyhedron" else 0.8)


def test_single_precision_tremor_does_not_spin_the_rim():
    with jax.enable_x64(False):
        rng = np.random.default_rng(8)
        turns = [Rotation.from_rotvec(5e-7 * rng.normal(size=3)) for _ in range(256)]
        pair = ("plane", "cylinder")
        result = Result(pair, fixed_scene(pair, np.tile([0, 0.5, 0], (256, 1)), turns), np.dtype("float32"))
        order = np.argsort(result.feature, axis=1)
        points = np.take_along_axis(result.position, order[..., None], axis=1)
        assert np.linalg.norm(points - points[:1], axis=-1).max() < 1e-2


def test_polyhedra_of_different_sizes_share_a_call(float64):
    """Padding (repeated vertices and faces) is without effect; vertices may differ from world to world."""
    rng = np.random.default_rng(9)
    big, box = hull(rng.normal(size=(12, 3))), hull(BOX_CORNERS * 0.4)
    vertex_count, face_count = max(len(big[0]), 8), max(len(big[1]), 6)
    width = max(big[1].shape[1], 4)

    def padded(vertices, faces):
        vertices = np.r_[vertices, np.repeat(vertices[:1], vertex_count - len(vertices), axis=0)]
        faces = np.c_[faces, np.repeat(faces[:, -1:], width - faces.shape[1], axis=1)]
        return vertices, np.r_[faces, np.repeat(faces[:1], face_count - len(faces), axis=0)]

    tables = [padded(*big), padded(*box)]
    turns = Rotation.random(16, random_state=rng).as_quat()[:, [3, 0, 1, 2]]
    centers = rng.normal(size=(16, 3))
    q = Quaternion(*(jnp.asarray(np.tile(turns[:, k], (2, 1))) for k in range(4)))
    at = Vec3(*(jnp.asarray(np.tile(centers[:, k], (2, 1))) for k in range(3)))
    origin = Pose(Vec3(*(jnp.zeros((2, 16)) for _ in range(3))))
    stacked = np.stack([t[0] for t in tables], 1)
    vertices = Vec3(*(jnp.asarray(np.broadcast_to(stacked[..., k, None], (vertex_count, 2, 16))) for k in range(3)))
    polyhedra = {"vertices": vertices, "faces": np.stack([t[1] for t in tables])}
    for first, a in (
        ("sphere", {"radius": jnp.full((2, 1), 0.3)}),
        (
            "plane",
            {"normal": Vec3(jnp.zeros((2, 1)), jnp.ones((2, 1)), jnp.zeros((2, 1))), "offset": jnp.zeros((2, 1))},
        ),
    ):
        pair = (first, "polyhedron")
        together = FUNCTIONS[pair](a, origin, polyhedra, Pose(at, to_matrix(q)))
        for row, (own_vertices, own_faces) in enumerate((big, box)):
            scene = {"b": {"vertices": own_vertices, "faces": own_faces}, "pa": np.zeros((16, 3)), "pb": centers}
            scene |= {"q": turns, "a": {"radius": np.full(16, 0.3)}}
            if first == "plane":
                scene["a"] = {"normal": np.tile([0.0, 1.0, 0.0], (16, 1)), "offset": np.zeros(16)}
            alone = Result(pair, scene, float64)
            for slot, point in enumerate(together.points):
                active = np.asarray(point.active)[row]
                np.testing.assert_array_equal(active, alone.active[:, slot])
                np.testing.assert_allclose(
                    np.asarray(point.separation)[row][active], alone.separation[active, slot], atol=1e-12
                )
