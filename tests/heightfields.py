"""Poses of convex shapes at a heightfield, and the manifolds that the engine finds there, in natural arrays."""

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax.collision.height_grid import window_size
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.geometry import SHAPES
from mathota_jax.geometry.hull import padded_faces
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, to_matrix
from mathota_jax.spatial.vector import Vec3
from tests.hulls import hull

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
    """Parameters of heightfields, heights (rows, columns) of one for all worlds or (rows, columns, 1, world)."""
    heights = jnp.asarray(heights)
    return {
        "heights": heights.reshape(*heights.shape, *(1,) * (4 - heights.ndim)),
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
