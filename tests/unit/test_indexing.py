"""Gathers of several arrays at once against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax.spatial.indexing import gather_together

ROWS, PLACES, WORLDS = 4, 6, 3


@pytest.mark.parametrize("worlds", [1, WORLDS])
def test_entries_by_row(worlds):
    """Arrays with any axes in front, of all worlds or shared; and their derivative, which adds up what is taken twice."""
    rng = np.random.default_rng(worlds)
    index = rng.integers(0, ROWS, (PLACES, WORLDS)).astype(np.int32)
    tree = {"a": rng.normal(size=(5, ROWS, worlds)), "b": rng.normal(size=(2, 3, ROWS, 1))}
    tree = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)

    def expected(values):
        full = np.broadcast_to(values, (*values.shape[:-1], WORLDS))
        return np.stack([full[..., index[:, w], w] for w in range(WORLDS)], axis=-1)

    found, back = jax.vjp(lambda tree: gather_together(tree, jnp.asarray(index)), tree)
    for name, values in tree.items():
        np.testing.assert_array_equal(found[name], expected(np.asarray(values)))
    (counts,) = back(jax.tree.map(jnp.ones_like, found))
    taken = np.stack([(index == row).sum(0) for row in range(ROWS)])
    np.testing.assert_array_equal(counts["a"][0], taken if worlds > 1 else taken.sum(1, keepdims=True))
    np.testing.assert_array_equal(counts["b"][1, 2], taken.sum(1, keepdims=True))


def test_what_all_rows_share_is_given_once():
    """As `take` gives what one body has in common for all its shapes."""
    index = np.array([[1], [0], [2]], np.int32)
    rows, shared = jnp.arange(3.0)[:, None], jnp.full((1, 1), 7.0)
    found = gather_together((rows, shared), jnp.asarray(index))
    np.testing.assert_array_equal(found[0], [[1.0], [0.0], [2.0]])
    np.testing.assert_array_equal(found[1], np.full((3, 1), 7.0))


def test_rows_of_arrays_of_one_shape():
    rng = np.random.default_rng(0)
    index = rng.integers(0, ROWS, (PLACES, WORLDS)).astype(np.int32)
    tree = [jnp.asarray(rng.normal(size=(ROWS, worlds)), jnp.float32) for worlds in (1, WORLDS)]
    for found, values in zip(gather_together(tree, jnp.asarray(index)), tree, strict=True):
        full = np.broadcast_to(values, (ROWS, WORLDS))
        np.testing.assert_array_equal(found, np.take_along_axis(full, index, axis=0))
