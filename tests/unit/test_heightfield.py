"""Convex shapes against heightfields: float64 oracles, the plane as the limit of flat ground, derivatives, scenes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mathota_jax.collision.height_grid import window_size
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.collision.pairs.plane_box import plane_box
from mathota_jax.collision.pairs.plane_capsule import plane_capsule
from mathota_jax.collision.pairs.plane_cone import plane_cone
from mathota_jax.collision.pairs.plane_cylinder import plane_cylinder
from mathota_jax.collision.pairs.plane_polyhedron import plane_polyhedron
from mathota_jax.collision.pairs.plane_sphere import plane_sphere
from mathota_jax.geometry import SHAPES
from mathota_jax.geometry.hull import padded_faces
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, to_matrix
from mathota_jax.spatial.vector import Vec3
from tests.hulls import hull

FUNCTIONS = {
    "sphere": plane_sphere,
    "capsule": plane_capsule,
    "box": plane_box,
    "cylinder": plane_cylinder,
    "cone": plane_cone,
    "polyhedron": plane_polyhedron,
}
KINDS = list(FUNCTIONS)
STONE = np.random.default_rng(7).normal(size=(12, 3)) * [0.25, 0.2, 0.3]
STONE, STONE_FACES = hull(STONE)
SIZES = {
    "sphere": {"radius": np.array(0.3)},
    "capsule": {"radius": np.array(0.15), "half_height": np.array(0.35)},
    "box": {"half_extents": np.array([0.3, 0.15, 0.25])},
    "cylinder": {"radius": np.array(0.25), "half_height": np.array(0.2)},
    "cone": {"radius": np.array(0.3), "half_height": np.array(0.2)},
    "polyhedron": {"vertices": STONE},
}
CELL = 0.25
REACH = {kind: float(SHAPES[kind].reach_of(sizes)) for kind, sizes in SIZES.items()}


def vec(values):
    """Natural (..., 3) as a Vec3 of components (1, ...)."""
    return Vec3(*(jnp.asarray(values)[None, ..., axis] for axis in range(3)))


def place(position, orientation):
    q = jnp.asarray(orientation)
    return Pose(vec(position), to_matrix(Quaternion(*(q[None, ..., k] for k in range(4)))))


def shape_of(kind, sizes):
    """Parameters of one shape for pair functions."""
    if kind == "polyhedron":
        vertices = jnp.asarray(sizes["vertices"])
        return {
            "vertices": Vec3(*(vertices[:, axis, None, None] for axis in range(3))),
            "faces": padded_faces([STONE_FACES]),
        }
    return {
        name: Vec3(*(jnp.asarray(v)[k].reshape(1, 1) for k in range(3))) if np.ndim(v) else jnp.reshape(v, (1, 1))
        for name, v in sizes.items()
    }


def field_of(heights, cell=CELL, reach=0.5):
    """Parameters of one heightfield, heights (rows, columns)."""
    return {
        "heights": jnp.asarray(heights)[:, :, None, None],
        "cell_size": jnp.reshape(cell, (1, 1)),
        "window": window_size(reach, float(CELL)),
    }


UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def run(kind, heights, position, orientation, field_pose=None, sizes=None, cell=CELL):
    """Manifolds of many poses (world, 3), (world, 4); natural NumPy arrays with the points first."""
    field_pose = (np.zeros(3), UPRIGHT) if field_pose is None else field_pose
    position, orientation = np.atleast_2d(position), np.atleast_2d(orientation)

    def function(position, orientation):
        pose = place(position, orientation)
        return PAIRS[kind, "heightfield"].function(
            shape_of(kind, SIZES[kind] if sizes is None else sizes),
            Pose(pose.position) if kind == "sphere" else pose,
            field_of(heights, cell, REACH[kind]),
            place(field_pose[0][None], field_pose[1][None]),
        )

    return natural(jax.jit(function)(position, orientation), len(position))


def natural(found, count):
    def full(x):
        return np.broadcast_to(np.asarray(x), (1, count))[0]

    def vector(v):
        return np.stack([full(c) for c in v], -1)

    return {
        "normal": np.stack([vector(p.normal if p.normal is not None else found.normal) for p in found.points]),
        "position": np.stack([vector(p.position) for p in found.points]),
        **{
            name: np.stack([full(getattr(p, name)) for p in found.points])
            for name in ("separation", "feature", "active")
        },
    }


def poses(count, seed, spread=0.5, height=(0.0, 0.6)):
    rng = np.random.default_rng(seed)
    position = np.stack(
        [rng.uniform(-spread, spread, count), rng.uniform(*height, count), rng.uniform(-spread, spread, count)], -1
    )
    return position, Rotation.random(count, random_state=rng).as_quat()[:, [3, 0, 1, 2]]


# ---- flat and inclined ground equals the plane --------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.3, -0.2)], ids=["flat", "inclined"])
def test_even_ground_is_a_plane(kind, slope, float64, gate):
    rows, columns = 13, 15
    along = (np.arange(rows) - 6.0) * CELL
    across = (np.arange(columns) - 7.0) * CELL
    heights = slope[0] * along[:, None] + slope[1] * across
    normal = np.array([-slope[0], 1.0, -slope[1]])
    normal /= np.linalg.norm(normal)
    position, orientation = poses(200, 3)
    position[:, 1] += slope[0] * position[:, 0] + slope[1] * position[:, 2]
    found = run(kind, heights, position, orientation)

    pose = place(position, orientation)
    plane = {"normal": Vec3(*(jnp.full((1, 1), n) for n in normal)), "offset": jnp.zeros((1, 1))}
    truth = natural(FUNCTIONS[kind](plane, None, shape_of(kind, SIZES[kind]), pose), 200)

    used = found["active"]
    assert used[0].all()
    gate("normal", np.abs(found["normal"] + normal)[used], 1e-13)
    worst = 0.0
    for world in range(200):
        ours = found["position"][used[:, world], world], found["separation"][used[:, world], world]
        theirs = (
            truth["position"][truth["active"][:, world], world],
            truth["separation"][truth["active"][:, world], world],
        )
        assert len(ours[0]) == len(theirs[0])
        for point, gap in zip(*theirs, strict=True):
            worst = max(worst, np.min(np.linalg.norm(ours[0] - point, axis=1) + np.abs(ours[1] - gap)))
    gate("points", worst, 1e-12)
