"""Random pairs of convex shapes, and their exact distance in float64: cutting planes with SciPy's NNLS and Qhull.

Independent of the engine: NumPy and the support functions of this file only.
"""

import itertools
import zlib

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from mathota_jax.collision.convex import convex_distance
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, normalize, to_matrix
from mathota_jax.spatial.vector import Vec3
from tests.hulls import BOX_CORNERS, hull
from tests.round_oracle import round_distance

KINDS = ("sphere", "capsule", "box", "cylinder", "cone", "polyhedron")
ROUND, FLAT = ("sphere", "capsule"), ("box", "polyhedron")
PAIRS = list(itertools.combinations_with_replacement(KINDS, 2))
VERTICES = 12
CORNERS = np.random.default_rng(5).normal(size=(VERTICES, 3))
CORNERS /= np.linalg.norm(CORNERS, axis=1, keepdims=True)
CORNER_FACES, CUBE_FACES = hull(CORNERS)[1], hull(BOX_CORNERS)[1]


# ---- scenes: natural arrays in NumPy, one pose a row -------------------------------------------------------------


def random_shape(kind, rng, count):
    if kind == "box":
        return {"half_extents": rng.uniform(0.2, 1.0, (count, 3))}
    if kind == "polyhedron":
        # Linear maps of one hull: all poses have the same faces, as all worlds of a scene do.
        maps = Rotation.random(count, random_state=rng).as_matrix() * rng.uniform(0.3, 1.0, (count, 1, 3))
        return {"vertices": CORNERS @ (maps @ Rotation.random(count, random_state=rng).as_matrix()).swapaxes(1, 2)}
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
    return convex_distance(pair[0], with_faces(a), pose_a, pair[1], with_faces(b), pose_b)


def with_faces(shape):
    """The parameters as pair functions take them: polyhedra are `CORNERS`, mapped, or cubes whose first corner repeats."""
    if "vertices" not in shape:
        return shape
    return {**shape, "faces": (CORNER_FACES if shape["vertices"].x.shape[0] == VERTICES else CUBE_FACES)[None]}


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
        self.pair = pair
        self.scene = jax.tree.map(lambda rows: rows[index : index + 1], scene)
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
    Spheres and capsules: in closed form, for the cutting planes lose digits where the cores all but meet.
    """
    if {kind for kind, *_ in placed.sides} <= set(ROUND):
        separations, normals = round_distance(placed.pair, placed.scene)
        return separations[0], normals[0]
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
    # Q12: Qhull gives up on a facet a hundred of its round-offs (1e-17 m) wide, which is nothing beside the tolerance.
    hull = ConvexHull(np.array(points), incremental=True, qhull_options="Qt Q12")
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
