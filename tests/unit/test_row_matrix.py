"""The two forms of a matrix of rows have the same products, against those of the dense matrices in NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax.solver.row_matrix import Points

TURNS, ROWS, CONSTRAINTS, TOGETHER, WORLDS = 2, 3, 2, 4, 5


def points(sides, turns):
    """Rows at random points of bodies of random inertia; with the inverse of mass and inertia of each side in NumPy."""
    rng = np.random.default_rng(sides)
    packed = rng.normal(size=(TURNS, ROWS, 3 + 3 * sides * turns, CONSTRAINTS * TOGETHER, WORLDS))
    inertias, inverses = [], []
    for _ in range(sides):
        root = rng.normal(size=(TURNS, CONSTRAINTS, WORLDS, 3, 3))
        inverse = root @ np.swapaxes(root, -1, -2) + np.eye(3)
        mass = rng.uniform(0.5, 2.0, (TURNS, CONSTRAINTS, WORLDS))
        entries = [
            mass,
            *(inverse[..., k, k] for k in range(3)),
            *(inverse[..., i, j] for i, j in ((1, 2), (0, 2), (0, 1))),
        ]
        inertias.append(jnp.asarray(np.stack(entries, axis=1)))
        full = np.zeros((TURNS, CONSTRAINTS, WORLDS, 6, 6))
        full[..., :3, :3], full[..., 3:, 3:] = mass[..., None, None] * np.eye(3), inverse
        inverses.append(full)
    return Points(jnp.asarray(packed), tuple(inertias)), packed, inverses


@pytest.mark.parametrize("turns", [True, False], ids=["turning", "not turning"])
@pytest.mark.parametrize("sides", [1, 2])
def test_entries_multiply_to_the_response_of_each_row(sides, turns, float64):
    matrix, packed, inverses = points(sides, turns)
    expected = 0.0
    for side, (sign, inverse) in enumerate(zip((-1.0, 1.0)[-sides:], inverses, strict=True)):
        own = slice(3 + 3 * side, 6 + 3 * side)
        angular = packed[:, :, own] if turns else np.zeros_like(packed[:, :, :3])
        jacobian = np.concatenate([sign * packed[:, :, :3], angular], axis=2)
        of_columns = np.repeat(inverse, TOGETHER, axis=1)
        expected = expected + np.einsum("tracw,tcwab,tsbcw->trscw", jacobian, of_columns, jacobian)
    for form in (matrix, matrix.dense()):
        jacobian, response = form.entries()
        for row in range(ROWS):
            for other in range(ROWS):
                found = sum(
                    a * b
                    for j, r in zip(jacobian, response, strict=True)
                    for a, b in zip(j[row], r[other], strict=True)
                )
                np.testing.assert_allclose(found, expected[:, row, other], rtol=1e-12, atol=1e-12)
