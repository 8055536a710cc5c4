"""Lengths of steps against the eigenvalues of what the points of a manifold do to each other."""

import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax.constraints.effective_mass import (
    NORMAL_RELAXATION,
    TANGENT_RELAXATION,
    meeting,
    normal_bound,
    tangent_bound,
)

POINTS, WORLDS = 4, 50
SUBSETS = [(1, 1, 1, 1), (1, 0, 0, 0), (0, 1, 0, 1), (1, 1, 0, 1)]


def of_a_body(seed):
    """Rows (row, point, component, world) along three axes at points of a plane, and their responses."""
    rng = np.random.default_rng(seed)
    arms = rng.normal(size=(POINTS, 3, WORLDS))
    arms[:, 1] = arms[0, 1]
    jacobian = np.zeros((3, POINTS, 6, WORLDS))
    for row, axis in enumerate(np.eye(3)[[1, 0, 2]]):
        jacobian[row, :, :3] = axis[:, None]
        jacobian[row, :, 3:] = np.cross(arms, axis[None, :, None], axis=1)
    mass = np.concatenate([np.ones((3, WORLDS)), rng.uniform(1.0, 20.0, (3, WORLDS))])
    return jacobian, jacobian * mass


def entries(rows):
    """As `Entries`, of the only side."""
    return [[[jnp.asarray(component)[None] for component in np.moveaxis(row, 1, 0)] for row in rows]]


def largest(jacobian, response, lengths):
    """Largest eigenvalues (world,) of the rows (row, point) of a manifold, each times its length of a step."""
    matrix = np.einsum("aicw,bjcw->waibj", jacobian, response)
    root = np.sqrt(lengths)  # (point, world)
    scaled = matrix * root.T[:, None, :, None, None] * root.T[:, None, None, None, :]
    size = jacobian.shape[0] * POINTS
    return np.linalg.eigvalsh(scaled.reshape(WORLDS, size, size)).max(1)


@pytest.mark.parametrize("bound", ["normal", "tangent"])
@pytest.mark.parametrize("subset", SUBSETS)
def test_steps_do_not_overshoot(float64, subset, bound):
    """Of the points that meet not at all but for the relaxation; where the others are pressed, too, by as much again."""
    rows, find, relaxed = {
        "normal": ([0], normal_bound, NORMAL_RELAXATION),
        "tangent": ([1, 2], tangent_bound, TANGENT_RELAXATION),
    }[bound]
    jacobian, response = of_a_body(3)
    active = jnp.ones((1, POINTS, WORLDS))
    meets = active * np.array(subset)[:, None]
    found = np.asarray(find((entries(jacobian), entries(response)), POINTS, active, meets))[0]
    here = np.flatnonzero(subset)
    alone = np.where(np.array(subset)[:, None] > 0, 1 / found, 0.0)
    most = largest(jacobian[rows], response[rows], alone)
    assert most.max() <= relaxed + 1e-9
    assert largest(jacobian[rows], response[rows], 1 / found).max() <= 2 * relaxed + 1e-9
    if len(here) == 1:
        np.testing.assert_allclose(most, 1.0 if bound == "normal" else relaxed, rtol=1e-9)


def test_where_no_point_meets_all_do(float64):
    active = jnp.asarray([[1.0, 1.0, 1.0, 0.0]] * 2).T[None]
    lowest = jnp.asarray([[-1.0, 1.0, 0.0, -1.0], [1.0, 2.0, 3.0, -1.0]]).T[None]
    np.testing.assert_array_equal(meeting(4, active, lowest)[0].T, [[1, 0, 1, 0], [1, 1, 1, 0]])
