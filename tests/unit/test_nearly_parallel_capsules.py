"""Signed distance of capsules whose axes are nearly parallel, against segments in float64."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from mathota_jax import Capsule, signed_distance

COUNT = 4096
A, B = Capsule(0.3, 0.7), Capsule(0.4, 0.5)


def ends(place, rotation, half):
    """Both ends of an axis (pose, end, 3)."""
    axis = half * rotation.apply([0.0, 1.0, 0.0])
    return np.stack([place - axis, place + axis], axis=1)


def from_segment(point, segment):
    """Distance of points (pose, 3) from segments (pose, end, 3)."""
    along = segment[:, 1] - segment[:, 0]
    share = ((point - segment[:, 0]) * along).sum(-1) / (along**2).sum(-1)
    return np.linalg.norm(segment[:, 0] + np.clip(share, 0, 1)[:, None] * along - point, axis=-1)


def between(a, b):
    """Distance of two segments that do not meet: from an end to the other one, or where both lines are closest."""
    nearest = np.min([from_segment(a[:, k], b) for k in (0, 1)] + [from_segment(b[:, k], a) for k in (0, 1)], axis=0)
    u, v, w = a[:, 1] - a[:, 0], b[:, 1] - b[:, 0], b[:, 0] - a[:, 0]
    across = np.cross(u, v)
    squared = np.maximum((across**2).sum(-1), 1e-30)
    s, t = ((np.cross(w, other) * across).sum(-1) / squared for other in (v, u))
    inside = (s > 0) & (s < 1) & (t > 0) & (t < 1)
    lines = np.abs((w * across).sum(-1)) / np.sqrt(squared)
    return np.where(inside, np.minimum(lines, nearest), nearest)


def test_capsules_side_by_side(precision, gate):
    """Axes in one plane come closer towards one end, also where few digits tell them from parallel ones."""
    rng = np.random.default_rng(0)
    angles = 10.0 ** rng.uniform(-9, -1, COUNT)
    tilt = Rotation.from_rotvec(angles[:, None] * rng.normal(size=(COUNT, 3)) * (1.0, 0.0, 1.0))
    turn = Rotation.from_rotvec(rng.normal(size=(COUNT, 3)))
    # Apart by their radii to 3e-4, and shifted along the axes.
    offset = np.stack([0.7 + rng.uniform(-3e-4, 3e-4, COUNT), rng.uniform(-1, 1, COUNT), np.zeros(COUNT)], axis=1)
    sides = (np.zeros((COUNT, 3)), turn), (turn.apply(offset), turn * tilt)
    poses = [(place.astype(precision), r.as_quat(scalar_first=True).astype(precision)) for place, r in sides]
    found = jax.jit(jax.vmap(lambda a, b: signed_distance(A, a, B, b)))(*jax.tree.map(jnp.asarray, poses))

    rounded = [(place.astype(float), Rotation.from_quat(q.astype(float), scalar_first=True)) for place, q in poses]
    axes = [ends(*pose, half) for pose, half in zip(rounded, (0.7, 0.5), strict=True)]
    truth = between(*axes) - 0.7
    measured = np.asarray(found.separation, float)
    limit = {"float32": 1e-6, "float64": 1e-9}[str(precision)]
    gate("signed distance [m]", measured - truth, limit)
    assert (np.sign(measured) == np.sign(truth))[np.abs(truth) > limit].all()
