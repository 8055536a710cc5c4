"""Both forms of the matrix of rows, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax.solver.delassus import Factored, Whole

ROWS, COORDINATES, WORLDS = 35, 5, 2
SOFT, LEFT = np.array([1, 4]), np.array([0, 2, 3, *range(5, ROWS)])


@pytest.fixture
def forms(float64):
    """Both forms of one matrix, and it (world, row, row)."""
    generator = np.random.default_rng(0)
    factor = generator.normal(size=(ROWS, COORDINATES, WORLDS))
    weights = np.diag(generator.uniform(0.5, 2.0, COORDINATES))
    rates = np.einsum("rcw,cd->rdw", factor, weights)
    matrix = np.einsum("rcw,scw->rsw", rates, factor)
    return (Whole(jnp.asarray(matrix)), Factored(jnp.asarray(rates), jnp.asarray(factor))), matrix


def test_products(forms, gate):
    found, matrix = forms
    impulses = np.random.default_rng(1).normal(size=(ROWS, WORLDS))
    for form in found:
        assert form.count == ROWS
        gate("all rows", form.times(jnp.asarray(impulses)) - np.einsum("rsw,sw->rw", matrix, impulses), 1e-12)
        some = np.einsum("rsw,sw->rw", matrix[:, SOFT], impulses[SOFT])
        gate("some rows", form.times(jnp.asarray(impulses[SOFT]), SOFT) - some, 1e-12)


def test_parts(forms, gate):
    found, matrix = forms
    for form in found:
        gate("whole", form.whole() - matrix, 1e-12)
        gate("part", form.part(LEFT, SOFT) - matrix[LEFT][:, SOFT], 1e-12)
        gate("diagonal", form.diagonal(7) - np.array([matrix[row, row] for row in range(7)]), 1e-12)
        gate("chosen", form.chosen(SOFT).whole() - matrix[SOFT][:, SOFT], 1e-12)
        blocks = np.stack([matrix[k : k + 6, k : k + 6] for k in (5, 11, 17)])
        gate("blocks", form.blocks(5, 3, 6) - blocks, 1e-12)


def test_rows_that_give_way(forms, gate):
    """With as much as makes the rates of the soft rows their impulses, the rest feels ``A - B (1 + C)^-1 B^T``."""
    found, matrix = forms
    for form in found:
        soft, across = matrix[SOFT][:, SOFT], matrix[LEFT][:, SOFT]
        given_way = np.stack(
            [np.linalg.solve(soft[..., w] + np.eye(len(SOFT)), across[..., w].T) for w in range(WORLDS)], axis=-1
        )
        truth = matrix[LEFT][:, LEFT] - np.einsum("rsw,stw->rtw", across, given_way)
        gate("without", form.without(SOFT, LEFT, jnp.asarray(given_way)).whole() - truth, 1e-12)


def test_turns_of_sweeps(forms, gate):
    """Rates of the rows of a turn after impulses of another, by what the sweeps are given; two points of three rows."""
    found, matrix = forms
    first, size = 5, 6
    impulse = np.random.default_rng(2).normal(size=(3, 2, WORLDS))
    of_rows = impulse.swapaxes(0, 1).reshape(size, WORLDS)  # point by point
    for form in found:
        turns = form.turns(first, 4, 2, 3)
        second, third = (jax.tree.map(lambda x, turn=turn: x[turn], turns) for turn in (1, 2))
        (change,) = second.changes(jnp.asarray(impulse), 2)
        # The sweeps gather the velocity of the only block once for all columns of a constraint.
        velocity = jnp.broadcast_to(change, (change.shape[0], 2, WORLDS)) if isinstance(form, Factored) else change
        rates = np.asarray(third.rates([velocity])).swapaxes(0, 1).reshape(size, WORLDS)
        truth = np.einsum("rsw,sw->rw", matrix[first + 12 : first + 18, first + 6 : first + 12], of_rows)
        gate("rates", rates - truth, 1e-12)
