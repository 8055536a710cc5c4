"""The general manifold from exact normals: oracles by separating axes, supports and polygon intersection in NumPy."""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation

from mathota_jax.collision.face_manifold import face_manifold, witness_feature
from mathota_jax.collision.pairs.box_box import box_box
from mathota_jax.collision.pairs.convex import convex_pair, convex_point_count
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, normalize, to_matrix
from mathota_jax.spatial.vector import Vec3
from tests.hulls import BOX_CORNERS, hull, point_to_hull
from tests.marks import QUICK_AND_SLOW_PRECISION, QUICK_IN_FLOAT64, slow_but

COUNT = 64
HEXAGON = np.array([[np.cos(a), y, np.sin(a)] for a in np.arange(6) * np.pi / 3 + 0.2 for y in (-1, 1)]) * 0.5
KINDS = ("capsule", "box", "cylinder", "cone", "polyhedron")


class Contact(NamedTuple):
    """What the distance query hands to the manifold."""

    normal: Vec3
    separation: jax.Array
    point_a: Vec3
    point_b: Vec3


# ---- shapes in NumPy: (kind, parameters); the rows of a scene share them -------------------------------------------


def box(*half):
    return "box", {"half_extents": np.array(half, float)}


def polyhedron(points):
    vertices, faces = hull(points)
    return "polyhedron", {"vertices": vertices, "faces": faces}


def cylindrical(kind, radius=0.5, half_height=0.5):
    return kind, {"radius": radius, "half_height": half_height}


def support(shape, direction):
    """Farthest point of a shape along a direction, both in its own frame."""
    kind, parameters = shape
    if kind == "box":
        return np.where(direction >= 0, 1.0, -1.0) * parameters["half_extents"]
    if kind == "polyhedron":
        return parameters["vertices"][np.argmax(parameters["vertices"] @ direction)]
    radius, half = parameters["radius"], parameters["half_height"]
    lateral = direction * [1, 0, 1]
    length = np.linalg.norm(lateral)
    rim = lateral / length * radius if length > 0 else np.zeros(3)
    up = np.array([0.0, 1.0, 0.0])
    if kind == "capsule":
        return np.copysign(half, direction[1]) * up + radius * direction / np.linalg.norm(direction)
    if kind == "cylinder":
        return np.copysign(half, direction[1]) * up + rim
    ends = [1.5 * half * up, rim - 0.5 * half * up]
    return max(ends, key=lambda p: p @ direction)


# ---- the engine ----------------------------------------------------------------------------------------------------


def rows(values, dtype):
    return Vec3(*(jnp.asarray(values[None, :, k], dtype) for k in range(3)))


def quaternion(rotation, dtype):
    return Quaternion(*(jnp.asarray(rotation.as_quat()[None, :, k], dtype) for k in (3, 0, 1, 2)))


def engine(shape, dtype):
    """Floating parameters of a shape that all worlds share."""
    found = {}
    for name, value in shape[1].items():
        if name == "vertices":
            found[name] = Vec3(*(jnp.asarray(value[:, None, None, k], dtype) for k in range(3)))
        elif name == "half_extents":
            found[name] = Vec3(*(jnp.full((1, 1), v, dtype) for v in value))
        elif name != "faces":
            found[name] = jnp.full((1, 1), value, dtype)
    return found


def call(shape_a, shape_b, a, pa, qa, b, pb, qb, contact):
    with_faces = [
        dict(parameters, faces=shape[1]["faces"][None]) if shape[0] == "polyhedron" else parameters
        for shape, parameters in ((shape_a, a), (shape_b, b))
    ]
    pose_a, pose_b = Pose(pa, to_matrix(normalize(qa))), Pose(pb, to_matrix(normalize(qb)))
    return face_manifold(shape_a[0], with_faces[0], pose_a, shape_b[0], with_faces[1], pose_b, contact)


def engine_arguments(scene, dtype):
    contact = scene["contact"]
    return (
        engine(scene["a"], dtype), rows(scene["pa"], dtype), quaternion(scene["ra"], dtype),
        engine(scene["b"], dtype), rows(scene["pb"], dtype), quaternion(scene["rb"], dtype),
        Contact(
            rows(contact["normal"], dtype), jnp.asarray(contact["separation"][None], dtype),
            rows(contact["point_a"], dtype), rows(contact["point_b"], dtype),
        ),
    )  # fmt: skip


PLATES = {"box": box(2.0, 0.5, 2.0), "polyhedron": polyhedron(BOX_CORNERS * [2.0, 0.5, 2.0])}

_compiled = {}


class Result:
    """A manifold as float64 NumPy arrays: position (W, P, 3), others (W, P)."""

    def __init__(self, scene, dtype, manifold=None):
        if manifold is None:
            key = (*(str(scene[side][0]) + str(scene[side][1].get("faces")) for side in "ab"), len(scene["pb"]), dtype)
            if key not in _compiled:
                shapes = scene["a"], scene["b"]
                _compiled[key] = jax.jit(lambda *x: call(*shapes, *x))
            manifold = _compiled[key](*engine_arguments(scene, dtype))
        shape = (1, len(scene["pb"]))

        def full(array):
            return np.broadcast_to(np.asarray(array), shape)[0]

        positions = [np.stack([full(c) for c in p.position], -1) for p in manifold.points]
        self.position = np.stack(positions, 1).astype(float)
        self.separation = np.stack([full(p.separation) for p in manifold.points], 1).astype(float)
        self.feature = np.stack([full(p.feature) for p in manifold.points], 1)
        self.active = np.stack([full(p.active) for p in manifold.points], 1)
        self.deepest = np.where(self.active, self.separation, np.inf).min(1)
        assert {p.separation.dtype for p in manifold.points} == {dtype}
        assert {p.feature.dtype for p in manifold.points} == {np.dtype("int32")}
        assert np.isfinite(self.position).all()
        assert np.isfinite(self.separation).all()

    def features(self):
        return [tuple(sorted(f[a])) for f, a in zip(self.feature, self.active, strict=True)]


# ---- a shape on a plate: the normal is that of the plate's upper face, the deepest point the support ----------------


def resting(shape, plate, turns, lateral, penetration=1e-3, still=False):
    """`shape`, turned by each of `turns`, over the upper face of a plate which is turned and placed at random (or still)."""
    rng = np.random.default_rng(0)
    count = len(turns)
    plate_turn = Rotation.random(count, random_state=rng)
    plate_turn = Rotation.concatenate([plate_turn[0]] * count) if still else plate_turn
    plate_at = rng.normal(size=(count, 3))
    deepest = np.array([turn.apply(support(shape, turn.inv().apply([0, -1, 0]))) for turn in turns])
    above = np.zeros((count, 3))
    above[:, [0, 2]] = lateral
    penetration = np.broadcast_to(penetration, count)
    above[:, 1] = 0.5 - penetration - deepest[:, 1]
    rotation = plate_turn * Rotation.concatenate(turns)
    at = plate_at + plate_turn.apply(above)
    up = plate_turn.apply([0.0, 1.0, 0.0])
    on_shape = at + plate_turn.apply(deepest)
    on_plate = on_shape + up * penetration[:, None]
    gap = -penetration
    if KINDS.index(shape[0]) >= KINDS.index(plate[0]):  # the plate is body A
        contact = {"normal": up, "separation": gap, "point_a": on_plate, "point_b": on_shape}
        return {"a": plate, "pa": plate_at, "ra": plate_turn, "b": shape, "pb": at, "rb": rotation, "contact": contact}
    contact = {"normal": -up, "separation": gap, "point_a": on_shape, "point_b": on_plate}
    return {"a": shape, "pa": at, "ra": rotation, "b": plate, "pb": plate_at, "rb": plate_turn, "contact": contact}


def seen_from_plate(scene, result):
    """Positions in the frame of the plate."""
    side = "b" if scene["b"][0] in PLATES and scene["b"] is PLATES[scene["b"][0]] else "a"
    turn, at = scene["r" + side], scene["p" + side]
    return np.stack([turn.inv().apply(p - at) for p in result.position.swapaxes(0, 1)], 1)


LYING = Rotation.from_rotvec([np.pi / 2, 0, 0])
CONE_LYING = Rotation.from_rotvec([np.pi / 2 + np.arctan2(0.5, 1.0), 0, 0])
UPRIGHT = Rotation.identity()
# shape, its turn on the plate, contacts, area of their hull (points) or distance between them
POSES = {
    "box": (box(0.5, 0.3, 0.4), UPRIGHT, 4, 0.8),
    "polyhedral box": (polyhedron(BOX_CORNERS * [0.5, 0.3, 0.4]), UPRIGHT, 4, 0.8),
    "hexagonal prism": (polyhedron(HEXAGON), UPRIGHT, 4, 0.43),
    "cylinder": (cylindrical("cylinder"), UPRIGHT, 4, 0.5),
    "cylinder on its side": (cylindrical("cylinder"), LYING, 2, 1.0),
    "cone": (cylindrical("cone"), UPRIGHT, 4, 0.5),
    "cone on its side": (cylindrical("cone"), CONE_LYING, 2, np.hypot(0.5, 1.0)),
    "cone on its apex": (cylindrical("cone"), Rotation.from_rotvec([np.pi, 0, 0]), 1, 0.0),
    "capsule": (cylindrical("capsule", 0.3), LYING, 2, 1.0),
    "capsule on its end": (cylindrical("capsule", 0.3), UPRIGHT, 1, 0.0),
}


@pytest.mark.parametrize("plate", PLATES)
@pytest.mark.parametrize("name", POSES)
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_shapes_on_a_plate(name, plate, precision):
    """Number of points, exact depth, the centre of support inside, at tilts from nothing to 1e-3."""
    shape, pose, expected, extent = POSES[name]
    rng = np.random.default_rng(1)
    tilts = np.repeat([0.0, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 0.0], COUNT // 8)
    turns = [
        Rotation.from_rotvec(tilt * rng.normal(size=3)) * Rotation.from_rotvec([0, rng.uniform(0, 6), 0]) * pose
        for tilt in tilts
    ]
    scene = resting(shape, PLATES[plate], turns, rng.uniform(-0.8, 0.8, (COUNT, 2)))
    result = Result(scene, precision)
    # Points within `depth_tolerance` (2e-7 of the size in float64) of the deepest count as equally deep.
    np.testing.assert_allclose(result.deepest, -1e-3, atol=3e-7 if precision == np.float64 else 4e-6)
    points = seen_from_plate(scene, result)
    for index in range(COUNT):
        active = result.active[index]
        if expected == 1:
            near = active & (result.separation[index] < 0.05)
            assert near.sum() == 1
            continue
        assert active.sum() == expected
        assert np.all(np.abs(result.separation[index][active] + 1e-3) < 1e-5 + 6 * tilts[index])
        base = points[index][active]
        assert len(set(result.feature[index][active])) == expected
        if expected == 2:
            assert abs(np.linalg.norm(base[1] - base[0]) - extent) < 1e-3
        else:
            hulled = ConvexHull(base[:, [0, 2]])
            assert hulled.volume > 0.99 * extent
            side = "b" if scene["b"] is shape else "a"
            other = "a" if side == "b" else "b"
            center = scene["r" + other][index].inv().apply(scene["p" + side][index] - scene["p" + other][index])
            assert np.all(hulled.equations[:, :2] @ center[[0, 2]] + hulled.equations[:, 2] < 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hexagonal prism", "cylinder", "cylinder on its side", "cone", "capsule"])
def test_generic_pair_on_a_plate(name, precision):
    """The same from nothing but shapes and poses: distance search, then manifold."""
    shape, pose, expected, _ = POSES[name]
    rng = np.random.default_rng(8)
    tilts = np.repeat([0.0, 1e-8, 1e-6, 1e-4], COUNT // 4)
    turns = [
        Rotation.from_rotvec(tilt * rng.normal(size=3)) * Rotation.from_rotvec([0, rng.uniform(0, 6), 0]) * pose
        for tilt in tilts
    ]
    penetration = np.tile([1e-3, -1e-3], COUNT // 2)
    scene = resting(shape, PLATES["box"], turns, rng.uniform(-0.8, 0.8, (COUNT, 2)), penetration)
    a, pa, qa, b, pb, qb, _ = engine_arguments(scene, precision)
    kinds = scene["a"][0], scene["b"][0]

    def pair(a, pa, qa, b, pb, qb):
        if shape[0] == "polyhedron":
            b = dict(b, faces=shape[1]["faces"][None])
        return convex_pair(*kinds)(a, Pose(pa, to_matrix(normalize(qa))), b, Pose(pb, to_matrix(normalize(qb))))

    manifold = jax.jit(pair)(a, pa, qa, b, pb, qb)
    assert len(manifold.points) == convex_point_count(*kinds)
    result = Result(scene, precision, manifold)
    np.testing.assert_allclose(result.deepest, -penetration, atol=1e-6 if precision == np.float64 else 2e-5)
    assert (result.active.sum(1) == expected).all()


@pytest.mark.parametrize("name", ["box", "hexagonal prism", "cylinder", "cone", "capsule", "cylinder on its side"])
def test_overhanging_shapes_stop_at_the_edge(name, float64):
    """Over an edge of the plate no point is outside of either shape, and the patch is filled."""
    shape, pose, expected, _ = POSES[name]
    rng = np.random.default_rng(2)
    turns = [Rotation.from_rotvec([0, rng.uniform(0, 6), 0]) * pose for _ in range(COUNT)]
    scene = resting(shape, PLATES["box"], turns, np.array([1.9, 0.0]) + rng.uniform(-0.08, 0.08, (COUNT, 2)))
    result = Result(scene, float64)
    points = seen_from_plate(scene, result)
    np.testing.assert_allclose(result.deepest, -1e-3, atol=1e-9)
    for index in range(COUNT):
        base = points[index][result.active[index]]
        assert base[:, 0].max() < 2.0 + 2e-3
        assert base[:, 0].max() > 1.8
        assert 1 <= len(base) <= 4
        if expected == 4:
            assert len(base) >= 3


# ---- boxes, in all three guises ------------------------------------------------------------------------------------


def stacked_boxes(tilt, quarters, count=COUNT, seed=3, shift=0.3):
    """A unit box on another, turned about the vertical by quarters or by anything."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(count, random_state=rng)
    tilts = Rotation.from_rotvec(tilt * rng.normal(size=(count, 3)))
    yaw = rng.integers(0, 4, (count, 1)) * np.pi / 2 if quarters else rng.uniform(0, 6, (count, 1))
    yaw = Rotation.from_rotvec(np.array([0, 1, 0]) * yaw)
    pa = rng.normal(size=(count, 3))
    pb = pa + turn.apply(np.array([0, 0.99, 0]) + rng.normal(size=(count, 3)) * [shift, 0, shift])
    return {"pa": pa, "ra": turn, "pb": pb, "rb": turn * tilts * yaw}


def beside_box_box(kinds, scene):
    """Manifolds of `box_box` and, from its normal and deepest point, of the general routine; each patch seen from A."""
    dtype = np.dtype("float64")
    a = engine(box(0.5, 0.5, 0.5), dtype)
    pa, pb = rows(scene["pa"], dtype), rows(scene["pb"], dtype)
    qa, qb = quaternion(scene["ra"], dtype), quaternion(scene["rb"], dtype)
    known = jax.jit(lambda *x: box_box(a, Pose(x[0], to_matrix(x[1])), a, Pose(x[2], to_matrix(x[3]))))(pa, qa, pb, qb)
    truth = Result(scene, dtype, known)
    normal = np.stack([np.asarray(c)[0] for c in known.normal], -1)
    deepest = np.where(truth.active, truth.separation, np.inf).argmin(1)
    point, gap = truth.position[np.arange(COUNT), deepest], truth.deepest
    half_gap = 0.5 * gap[:, None] * normal
    scene["contact"] = {"normal": normal, "separation": gap, "point_a": point - half_gap, "point_b": point + half_gap}
    shapes = {"box": box(0.5, 0.5, 0.5), "polyhedron": polyhedron(BOX_CORNERS * 0.5)}
    scene["a"], scene["b"] = shapes[kinds[0]], shapes[kinds[1]]
    result = Result(scene, dtype)
    np.testing.assert_allclose(result.deepest, truth.deepest, atol=5e-6)  # box_box leans by 1e-5
    turn = scene["ra"].inv()
    return [[turn[k].apply(r.position[k][r.active[k]]) for k in range(COUNT)] for r in (result, truth)]


GUISES = [("box", "box"), ("box", "polyhedron"), ("polyhedron", "polyhedron")]


@pytest.mark.parametrize("kinds", GUISES, ids="_".join)
@pytest.mark.parametrize("tilt", [0.0, 1e-6, 1e-3])
def test_same_points_as_box_box(kinds, tilt, float64):
    for ours, theirs in zip(*beside_box_box(kinds, stacked_boxes(tilt, quarters=True)), strict=True):
        gaps = np.linalg.norm(ours[:, None] - theirs[None], axis=-1)
        assert max(gaps.min(0).max(), gaps.min(1).max()) < (1e-6 if tilt < 1e-3 else 3e-3)
        assert len(ours) == len(theirs) == 4


@pytest.mark.parametrize("kinds", GUISES, ids="_".join)
def test_as_broad_a_base_as_box_box(kinds, float64):
    """Turned boxes meet in up to eight vertices; which four are kept may differ, the base they give must not shrink."""
    patches = zip(*beside_box_box(kinds, stacked_boxes(1e-4, quarters=False)), strict=True)
    areas = np.array([[ConvexHull(points[:, [0, 2]]).volume for points in pair] for pair in patches])
    assert (areas[:, 0] > 0.8 * areas[:, 1]).all()
    assert areas[:, 0].sum() > 0.99 * areas[:, 1].sum()


# ---- random polytopes: separating axes ---------------------------------------------------------------------------


def edges_of(vertices, faces):
    pairs = {tuple(sorted(p)) for f in faces for p in itertools.pairwise([*f, f[0]]) if p[0] != p[1]}
    return np.array([vertices[j] - vertices[i] for i, j in pairs])


def overlap_contact(vertices_a, faces_a, vertices_b, faces_b):
    """Axis of least overlap of two polytopes by brute force; None if they are apart or the deepest point is not unique."""
    axes = []
    for vertices, faces in ((vertices_a, faces_a), (vertices_b, faces_b)):
        axes += [np.cross(vertices[f[1]] - vertices[f[0]], vertices[f[2]] - vertices[f[0]]) for f in faces]
    edges_a, edges_b = edges_of(vertices_a, faces_a), edges_of(vertices_b, faces_b)
    axes = np.concatenate([axes, np.cross(edges_a[:, None], edges_b).reshape(-1, 3)])
    lengths = np.linalg.norm(axes, axis=1)
    axes = axes[lengths > 1e-6] / lengths[lengths > 1e-6, None]
    axes = np.concatenate([axes, -axes])
    gaps = (vertices_b @ axes.T).min(0) - (vertices_a @ axes.T).max(0)
    best = np.argmax(gaps)
    normal, gap = axes[best], gaps[best]
    top = vertices_a[(vertices_a @ normal).max() - vertices_a @ normal < 1e-9]
    bottom = vertices_b[vertices_b @ normal - (vertices_b @ normal).min() < 1e-9]
    if gap > 0:
        return None
    if len(bottom) == 1:
        return normal, gap, bottom[0] - normal * gap, bottom[0]
    if len(top) == 1:
        return normal, gap, top[0], top[0] + normal * gap
    if len(top) > 2 or len(bottom) > 2:
        return None
    e, f, between = top[1] - top[0], bottom[1] - bottom[0], bottom[0] - top[0]
    s, _ = np.linalg.lstsq(np.stack([e, -f], 1), between - normal * gap, rcond=None)[0]
    return normal, gap, top[0] + s * e, top[0] + s * e + normal * gap


@functools.cache
def random_overlaps(count=COUNT, seed=4):
    rng = np.random.default_rng(seed)
    shapes = [polyhedron(rng.normal(size=(10, 3)) * 0.5), polyhedron(rng.normal(size=(14, 3)) * [0.6, 0.4, 0.3])]
    found = []
    while len(found) < count:
        ra, rb = Rotation.random(random_state=rng), Rotation.random(random_state=rng)
        pa = rng.normal(size=3)
        pb = pa + rng.normal(size=3) * 0.5
        vertices = [r.apply(s[1]["vertices"]) + p for r, s, p in ((ra, shapes[0], pa), (rb, shapes[1], pb))]
        contact = overlap_contact(vertices[0], shapes[0][1]["faces"], vertices[1], shapes[1][1]["faces"])
        if contact is not None and contact[1] > -0.1:
            found.append((pa, ra, pb, rb, *contact))
    names = ("pa", "ra", "pb", "rb", "normal", "separation", "point_a", "point_b")
    scene = {}
    for name, values in zip(names, zip(*found, strict=True), strict=True):
        scene[name] = Rotation.concatenate(values) if name[0] == "r" else np.array(values)
    scene["contact"] = {name: scene.pop(name) for name in names[4:]}
    return scene | {"a": shapes[0], "b": shapes[1]}


def test_random_overlapping_polyhedra(precision):
    """The deepest point is exact, none is deeper, and every point lies on both surfaces."""
    scene = random_overlaps()
    result = Result(scene, precision)
    truth, normal = scene["contact"]["separation"], scene["contact"]["normal"]
    tolerance = 1e-9 if precision == np.float64 else 2e-5
    np.testing.assert_allclose(result.deepest, truth, atol=tolerance)
    assert result.active[:, 0].all()
    several = 0
    for index in range(COUNT):
        slots = np.flatnonzero(result.active[index])
        several += len(slots) > 1
        assert (
            result.separation[index][slots].argmin() == 0
            or len(slots) == 1
            or np.isclose(result.separation[index, 0], result.separation[index][slots].min(), atol=tolerance)
        )
        assert len(set(result.feature[index][slots])) == len(slots)
        for slot in slots:
            half_gap = 0.5 * result.separation[index, slot] * normal[index]
            for side, sign in (("a", -1), ("b", 1)):
                point = result.position[index, slot] + sign * half_gap
                local = scene["r" + side][index].inv().apply(point - scene["p" + side][index])
                # Slack: the reference face is widened by 1e-3 of the size.
                assert abs(point_to_hull(local, scene[side][1]["vertices"], scene[side][1]["faces"])) < 5e-3
    assert several > COUNT / 3


def test_edge_contact_keeps_the_witness_alone(float64):
    """Crossed edges, no face near the normal: one point, the exact one."""
    shape = box(0.5, 0.5, 0.5)
    reach = np.sqrt(0.5)
    across = Rotation.from_rotvec([np.pi / 4, 0, 0]), Rotation.from_rotvec([0, 0, np.pi / 4])
    at = np.array([[0, 2 * reach + gap, 0] for gap in (-0.01, 0.01)])
    contact = {
        "normal": np.tile([0.0, 1.0, 0.0], (2, 1)), "separation": np.array([-0.01, 0.01]),
        "point_a": np.tile([0.0, reach, 0.0], (2, 1)), "point_b": np.array([[0, reach - 0.01, 0], [0, reach + 0.01, 0]]),
    }  # fmt: skip
    scene = {"a": shape, "b": shape, "pa": np.zeros((2, 3)), "pb": at, "contact": contact}
    scene["ra"], scene["rb"] = (Rotation.concatenate([r, r]) for r in across)
    result = Result(scene, float64)
    np.testing.assert_array_equal(result.active.sum(1), 1)
    np.testing.assert_allclose(result.separation[:, 0], [-0.01, 0.01])
    np.testing.assert_allclose(result.position[:, 0, 1], [reach - 0.005, reach + 0.005])
    assert set(result.feature[:, 0]) == {witness_feature("box", engine(shape, float64), "box", engine(shape, float64))}


@pytest.mark.slow
def test_patch_of_flat_prisms_against_polygon_intersection(float64):
    """Prisms face on face: the points are on the exact patch, and span at least the best quadrilateral of an n-gon."""
    rng = np.random.default_rng(5)

    def prism(corners):
        angles = np.sort(rng.uniform(0, 2 * np.pi, corners))
        ring = np.stack([np.cos(angles), np.sin(angles)], 1) * [0.6, 0.4]
        return np.array([[x, y, z] for x, z in ring for y in (-0.5, 0.5)])

    shapes = polyhedron(prism(7)), polyhedron(prism(6))
    turn = Rotation.random(COUNT, random_state=rng)
    yaw = [Rotation.from_rotvec([0, angle, 0]) for angle in rng.uniform(0, 6, COUNT)]
    offset = np.array([0, 0.99, 0]) + rng.normal(size=(COUNT, 3)) * [0.2, 0, 0.2]
    up = turn.apply([0, 1, 0])
    pa = rng.normal(size=(COUNT, 3))
    pb = pa + turn.apply(offset)
    outlines, middles = [], []
    for index in range(COUNT):
        halves = []
        for shape, rotation, shift in ((shapes[0], UPRIGHT, np.zeros(3)), (shapes[1], yaw[index], offset[index])):
            flat = (rotation.apply(shape[1]["vertices"]) + shift)[:, [0, 2]]
            halves.append(ConvexHull(flat).equations)
        halves = np.concatenate(halves)
        grid = np.stack(np.meshgrid(*[np.linspace(-0.7, 0.7, 141)] * 2), -1).reshape(-1, 2)
        depth = (grid @ halves[:, :2].T + halves[:, 2]).max(1)
        assert depth.min() < 0
        middle = grid[depth.argmin()]
        outlines.append(ConvexHull(HalfspaceIntersection(halves, middle).intersections))
        middles.append(middle)
    on_a = pa + turn.apply(np.insert(np.array(middles), 1, 0.5, axis=1))
    contact = {"normal": up, "separation": np.full(COUNT, -0.01), "point_a": on_a, "point_b": on_a - 0.01 * up}
    scene = {"a": shapes[0], "pa": pa, "ra": turn, "b": shapes[1], "pb": pb, "rb": turn * Rotation.concatenate(yaw)}
    result = Result(scene | {"contact": contact}, float64)
    np.testing.assert_allclose(result.separation, -0.01, atol=1e-9)
    for index, outline in enumerate(outlines):
        points = turn[index].inv().apply(result.position[index] - pa[index])[result.active[index]][:, [0, 2]]
        outside = (points @ outline.equations[:, :2].T + outline.equations[:, 2]).max(1)
        assert outside.max() < 2e-3
        assert outside.min() > -1e-6  # each is on the boundary
        best = outline.volume
        assert len(points) >= min(len(outline.vertices), 4) - 1
        assert ConvexHull(points).volume > 0.6 * best


# ---- segments --------------------------------------------------------------------------------------------------


def cylinders_side_by_side(angle, shift, gap=-1e-3):
    """B lies on A, turned by `angle` about the vertical and shifted along the axes (local Y = world x)."""
    count = len(shift)
    flat = Rotation.from_rotvec([0, 0, -np.pi / 2])
    turn = Rotation.from_rotvec(np.array([0, 1, 0]) * np.reshape(angle, (-1, 1)) * np.ones((count, 1)))
    pb = np.zeros((count, 3))
    pb[:, 0], pb[:, 1] = shift, 0.6 + gap
    at = np.array([[x / 2, 0.3, 0.0] for x in shift])
    up = np.tile([0.0, 1.0, 0.0], (count, 1))
    contact = {"normal": up, "separation": np.full(count, gap), "point_a": at, "point_b": at + gap * up}
    shape = cylindrical("cylinder", 0.3, 0.5)
    ra = Rotation.concatenate([flat] * count)
    return {
        "a": shape,
        "pa": np.zeros((count, 3)),
        "ra": ra,
        "b": shape,
        "pb": pb,
        "rb": turn * flat,
        "contact": contact,
    }


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_parallel_cylinders_touch_along_the_overlap(precision):
    shift = np.linspace(-0.7, 0.7, COUNT)
    result = Result(cylinders_side_by_side(1e-7, shift), precision)
    assert (result.active.sum(1) == 2).all()
    for index in range(COUNT):
        x = np.sort(result.position[index][result.active[index]][:, 0])
        np.testing.assert_allclose(x, [max(-0.5, shift[index] - 0.5), min(0.5, shift[index] + 0.5)], atol=1e-5)


def test_crossed_cylinders_touch_in_one_point(precision):
    result = Result(cylinders_side_by_side(np.linspace(0.5, np.pi - 0.5, COUNT), np.zeros(COUNT)), precision)
    assert (result.active.sum(1) == 1).all()
    np.testing.assert_allclose(result.deepest, -1e-3, atol=1e-6)
    assert np.linalg.norm(result.position[:, 0] - [0, 0.2995, 0], axis=1).max() < 0.05


# ---- continuity and features ---------------------------------------------------------------------------------------


def slid_across_the_edge(name, dtype):
    """A body in steps of 1e-3 across the edge of the plate: the manifolds, and their points in the plate's frame."""
    shape, pose, _, _ = POSES[name]
    steps = np.arange(COUNT) * 1e-3 + 1.45
    turns = [Rotation.from_rotvec([0, 0.3, 0]) * pose] * COUNT
    scene = resting(shape, PLATES["box"], turns, np.stack([steps, np.zeros(COUNT)], 1))
    result = Result(scene, dtype)
    return result, seen_from_plate(scene, result)


@pytest.mark.parametrize("name", ["box", "polyhedral box", "capsule", "cylinder on its side"])
def test_sliding_across_the_edge_moves_points_continuously(name, float64):
    """Steps of 1e-3 across the edge of the plate: the ends of the patch move by at most 1e-2 of the size."""
    result, points = slid_across_the_edge(name, float64)
    spans = []
    for index in range(COUNT):
        spans.append(np.r_[points[index][result.active[index]].min(0), points[index][result.active[index]].max(0)])
    assert np.abs(np.diff(spans, axis=0)).max() < 1e-2


@pytest.mark.parametrize("name", ["hexagonal prism", "cylinder", "cone"])
def test_sliding_many_corners_keeps_the_base(name, float64):
    """Patches of more than four vertices: whichever four are kept, the base changes little from step to step."""
    result, points = slid_across_the_edge(name, float64)
    areas = [ConvexHull(p[a][:, [0, 2]]).volume for p, a in zip(points, result.active, strict=True)]
    assert np.abs(np.diff(areas)).max() < 0.15 * max(areas)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize(
    "name",
    slow_but(
        ("box", "hexagonal prism", "cylinder"),
        ("box", "polyhedral box", "hexagonal prism", "cylinder", "cone", "capsule"),
    ),
)
def test_features_persist_in_a_tremor(name, precision):
    """A body at rest trembles by round-off: about 1e-6 rad in float32."""
    shape, pose, _, _ = POSES[name]
    tremor = 1e-6 if precision == np.float32 else 1e-8
    rng = np.random.default_rng(6)
    turns = [
        Rotation.from_rotvec(tremor * rng.normal(size=3)) * Rotation.from_rotvec([0, 0.4, 0]) * pose
        for _ in range(COUNT)
    ]
    for plate in PLATES.values():
        scene = resting(shape, plate, turns, 1e-5 * rng.normal(size=(COUNT, 2)), still=True)
        features = Result(scene, precision).features()
        common = max(set(features), key=features.count)
        assert features.count(common) >= 0.99 * len(features)


# ---- derivatives -------------------------------------------------------------------------------------------------


def plate_contact(shape_a, shape_b, a, pa, qa, b, pb, qb):
    """Contact of a box plate (A) with a shape whose deepest point is its support, differentiable in everything."""
    rotation = to_matrix(normalize(qa))
    up = rotation.column_y
    pose = Pose(pb, to_matrix(normalize(qb)))
    down = pose.rotation.apply_transposed(-up)
    if shape_b[0] == "polyhedron":
        heights = b["vertices"].x * down.x + b["vertices"].y * down.y + b["vertices"].z * down.z
        index = jnp.argmax(heights, axis=0)
        local = b["vertices"].map(
            lambda c: jnp.sum(jnp.where(jnp.arange(c.shape[0])[:, None, None] == index, c, 0.0), 0)
        )
    elif shape_b[0] == "capsule":
        sign = jnp.where(down.y > 0, 1.0, -1.0)
        local = down * b["radius"] + Vec3(0.0, sign * b["half_height"], 0.0)
    else:
        length = jnp.sqrt(down.x**2 + down.z**2)
        sign = jnp.where(down.y > 0, 1.0, -1.0)
        local = Vec3(b["radius"] * down.x / length, sign * b["half_height"], b["radius"] * down.z / length)
    point_b = pose.point_to_world(local)
    offset = point_b - pa
    gap = up.x * offset.x + up.y * offset.y + up.z * offset.z - a["half_extents"].y
    return Contact(up, gap, point_b - up * gap, point_b)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hexagonal prism", "cylinder", "cylinder on its side", "capsule"])
def test_derivative_against_central_differences(name, float64):
    """Separations and positions of all points with respect to both poses and all sizes.

    Tilts are not too small for differences: the lowest point of a rim turns by one over the tilt.
    """
    shape, pose, _, _ = POSES[name]
    rng = np.random.default_rng(7)
    turns = []
    for azimuth, tilt, yaw in rng.uniform((0, 0.04, 0), (6, 0.08, 6), (COUNT, 3)):
        axis = np.array([np.cos(azimuth), 0, np.sin(azimuth)])
        turns.append(Rotation.from_rotvec(tilt * axis) * Rotation.from_rotvec([0, yaw, 0]) * pose)
    scene = resting(shape, PLATES["box"], turns, rng.uniform(-2.2, 2.2, (COUNT, 2)))
    if shape[0] == "capsule":
        scene = scene | {
            "a": scene["b"],
            "pa": scene["pb"],
            "ra": scene["rb"],
            "b": scene["a"],
            "pb": scene["pa"],
            "rb": scene["ra"],
        }
    shapes = scene["a"], scene["b"]
    weights = rng.normal(size=(4, 4))

    def manifold(*values):
        contact = plate_contact(*shapes, *values)
        if shape[0] == "capsule":  # body A of the pair
            a, pa, qa, b, pb, qb = values
            mirrored = Contact(-contact.normal, contact.separation, contact.point_b, contact.point_a)
            return call(shapes[1], shapes[0], b, pb, qb, a, pa, qa, mirrored)
        return call(*shapes, *values, contact)

    def total(*values):
        result = manifold(*values)
        return sum(
            jnp.where(
                p.active, w[0] * p.separation + w[1] * p.position.x + w[2] * p.position.y + w[3] * p.position.z, 0.0
            )
            for p, w in zip(result.points, weights, strict=False)
        )

    values = list(engine_arguments(scene, float64)[:6])
    derivative = jax.jit(jax.grad(lambda *x: total(*x).sum(), argnums=tuple(range(6))))(*values)
    value = jax.jit(lambda *x: (total(*x), [p.feature * p.active for p in manifold(*x).points]))
    step, compared = 1e-6, 0
    _, features = value(*values)
    assert np.mean([np.asarray(p.active).mean() for p in manifold(*values).points[1:2]]) > 0.8
    for index in range(6):
        leaves, tree = jax.tree.flatten(values[index])
        for leaf, slope in enumerate(jax.tree.leaves(derivative[index])):
            assert np.isfinite(slope).all()
            for row in range(leaves[leaf].shape[0]):
                sides, same = [], np.ones((1, COUNT), bool)
                for sign in (-1, 1):
                    moved = list(leaves)
                    moved[leaf] = leaves[leaf].at[row].add(sign * step)
                    changed = list(values)
                    changed[index] = jax.tree.unflatten(tree, moved)
                    found, other = value(*changed)
                    sides.append(np.asarray(found))
                    for before, after in zip(features, other, strict=True):
                        same &= np.asarray(before == after)
                difference = (sides[1] - sides[0]) / (2 * step)
                if leaves[leaf].shape[-1] == 1:  # shared by all worlds
                    if same.all():
                        assert abs(difference.sum() - np.asarray(slope)[row].sum()) < 1e-5
                        compared += 1
                else:
                    assert same.mean() > 0.9
                    assert np.abs(difference - np.asarray(slope)[row])[same].max() < 2e-6
                    compared += 1
    assert compared >= 14


DEGENERATE = list(itertools.combinations_with_replacement(KINDS, 2))


@pytest.mark.slow
@pytest.mark.parametrize("pair", DEGENERATE, ids="_".join)
def test_no_value_or_derivative_is_ever_nan(pair):
    """Coincident centres, normals along axes, across them and along corners, zero and huge separations."""
    shapes = {
        "box": box(0.5, 0.5, 0.5), "polyhedron": polyhedron(BOX_CORNERS * 0.5),
        "capsule": cylindrical("capsule"), "cylinder": cylindrical("cylinder"), "cone": cylindrical("cone"),
    }  # fmt: skip
    normals = [(0, 1, 0), (1, 0, 0), (0, 0, -1), (1, 1, 0), (1, 1, 1), (1e-9, 1, 0), (1, 1e-9, 1e-12)]
    table = list(itertools.product(normals, [(0, 0, 0), (0, 1, 0), (1e-9, 0, 0), (100, 0, 0)], [0.0, 1e-12, np.pi / 2]))
    table = table[:: max(1, len(table) // COUNT)][:COUNT]
    count = len(table)
    normal = np.array([n for n, _, _ in table], float)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    pb = np.array([p for _, p, _ in table], float)
    identity = Rotation.concatenate([UPRIGHT] * count)
    contact = {"normal": normal, "separation": np.zeros(count), "point_a": pb / 2, "point_b": pb / 2}
    scene = {
        "a": shapes[pair[0]], "b": shapes[pair[1]], "pa": np.zeros((count, 3)), "ra": identity, "pb": pb,
        "rb": Rotation.from_rotvec([[t, 0, 0] for _, _, t in table]), "contact": contact,
    }  # fmt: skip
    with jax.enable_x64(False):
        dtype = np.dtype("float32")

        def everything(*values):
            manifold = call(scene["a"], scene["b"], *values)
            fields = [(p.position, p.separation) for p in manifold.points]
            return sum(jnp.sum(x) for x in jax.tree.leaves(fields))

        value, gradient = jax.jit(jax.value_and_grad(everything, argnums=tuple(range(7))))(
            *engine_arguments(scene, dtype)
        )
        assert np.isfinite(value)
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient))
