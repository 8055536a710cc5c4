"""Signed distance of two boxes against cutting planes in float64, and where faces and edges tie."""

import itertools

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mathota_jax.collision.pairs import PAIRS
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import to_matrix
from tests.benchmarks.pose_sweep import gate, kinds_of_pose, sweep
from tests.convex_oracle import Placed, distance_to, oracle, rounded, to_engine

PAIR = ("box", "box")
COUNT = 24


@jax.jit
def compiled(a, position_a, orientation_a, b, position_b, orientation_b):
    distance = PAIRS[PAIR].distance
    assert distance is not None
    return distance(a, Pose(position_a, to_matrix(orientation_a)), b, Pose(position_b, to_matrix(orientation_b)))


def check(scene, truths, sizes, dtype):
    """Separation, normal (by the separation along it) and surface points within the gate."""
    found = compiled(*to_engine(scene, dtype))
    normal, point_a, point_b = (np.stack(v, -1)[0].astype(float) for v in found[1:4])
    separation = np.asarray(found.separation)[0].astype(float)
    tolerance = gate(PAIR, dtype) * sizes
    np.testing.assert_array_less(np.abs(separation - truths), tolerance)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=8 * np.finfo(dtype).eps)
    unit = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    for index, size in enumerate(sizes):
        placed = Placed(PAIR, scene, index)
        assert abs(placed.reach(unit[index]) - truths[index]) < tolerance[index]
        assert abs(distance_to(placed, 0, point_a[index])) < tolerance[index]
        assert abs(distance_to(placed, 1, point_b[index])) < tolerance[index]
        gap = point_b[index] - point_a[index] - separation[index] * normal[index]
        assert np.abs(gap).max() < 64 * np.finfo(dtype).eps * size


@pytest.mark.parametrize("kind", kinds_of_pose())
def test_random_poses(kind, precision):
    """Needles, plates, ratios of 1000, gaps and overlaps of any size."""
    poses = sweep(PAIR, kind, COUNT, np.dtype(precision))
    check(poses.scene, poses.truths, poses.sizes, np.dtype(precision))


def tied_scene():
    """Faces parallel to faces, edges to faces and to edges; over, beside and across each other, apart and overlapping."""
    extents = [
        ((1.0, 0.2, 0.3), (0.3, 0.2, 1.0)),
        ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
        ((1.0, 0.5, 1.0), (0.2, 0.3, 0.2)),
    ]
    turns = Rotation.from_euler("yz", [(0, 0), (45, 0), (30, 0), (90, 0), (0, 45), (10, 45), (0, 30)], degrees=True)
    offsets = [(0, 1), (0.3, 1), (0.9, 1), (1.1, 1), (0.3, -0.2)]
    rows = list(itertools.product(extents, range(len(turns)), offsets, (0.02, 1e-4, -1e-4, -0.02)))
    count = len(rows)
    scene = {
        "a": {"half_extents": np.array([row[0][0] for row in rows])},
        "b": {"half_extents": np.array([row[0][1] for row in rows])},
        "pa": np.zeros((count, 3)),
        "qa": np.tile((1.0, 0.0, 0.0, 0.0), (count, 1)),
        "pb": np.zeros((count, 3)),
        "qb": turns.as_quat()[[row[1] for row in rows]][:, [3, 0, 1, 2]],
    }
    for index, ((half_a, half_b), turn, (aside, across), gap) in enumerate(rows):
        height = half_a[1] + np.abs(turns[turn].as_matrix()[1]) @ half_b + gap
        scene["pb"][index] = aside, height, 0.4 * aside * across
    # Turned as a whole, each in its own way: round-off decides ties by chance, and not twice in the same way.
    whole = Rotation.random(count, rng=np.random.default_rng(5))
    scene["pb"] = whole.apply(scene["pb"])
    for name in ("qa", "qb"):
        scene[name] = (whole * Rotation.from_quat(scene[name][:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    return scene


def test_ties(precision):
    """The witness points lie on both boxes although every point of a face is deepest."""
    dtype = np.dtype(precision)
    scene = rounded(tied_scene(), dtype)
    placed = [Placed(PAIR, scene, index) for index in range(len(scene["pb"]))]
    check(scene, np.array([oracle(p)[0] for p in placed]), np.array([p.size() for p in placed]), dtype)
