"""Connected components against SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mathota_jax.bodies import Edges
from mathota_jax.dynamics.islands import any_in_island, island_labels


def smallest_members(first, second, active, count):
    """For each node the smallest node of its component."""
    kept = active.astype(bool)
    graph = coo_matrix((np.ones(kept.sum()), (first[kept], second[kept])), shape=(count, count))
    _, component = connected_components(graph, directed=False)
    return np.array([np.flatnonzero(component == component[node])[0] for node in range(count)])


@pytest.mark.parametrize(("count", "edges"), [(1, 1), (7, 5), (40, 25), (40, 60), (200, 199)])
def test_random_graphs(count, edges):
    rng = np.random.default_rng(count + edges)
    worlds = 16
    first, second = rng.integers(0, count, (2, edges, worlds))
    active = rng.random((edges, worlds)) < 0.8
    labels = np.asarray(island_labels(Edges(*map(jnp.asarray, (first, second, active))), count, worlds))
    for world in range(worlds):
        truth = smallest_members(first[:, world], second[:, world], active[:, world], count)
        np.testing.assert_array_equal(labels[:, world], truth)


@pytest.mark.parametrize("order", ["ascending", "descending", "shuffled"])
def test_long_chain_is_one_island(order):
    """The slowest graph for labels that move one edge a round: the number of rounds must not bound what is found."""
    count = 1000
    names = {
        "ascending": np.arange(count),
        "descending": np.arange(count)[::-1],
        "shuffled": np.random.default_rng(0).permutation(count),
    }[order]
    chain = Edges(*(jnp.asarray(x)[:, None] for x in (names[:-1].copy(), names[1:].copy(), np.ones(count - 1, bool))))
    assert not np.any(island_labels(chain, count, 1))
    cut = chain._replace(active=chain.active.at[499].set(False))
    assert len(np.unique(island_labels(cut, count, 1))) == 2


def test_no_edges_leave_every_body_alone():
    none = jnp.zeros((0, 1), jnp.int32)
    labels = island_labels(Edges(none, none, none > 0), 3, 2)
    np.testing.assert_array_equal(labels, [[0, 0], [1, 1], [2, 2]])


def test_a_property_of_one_body_is_one_of_its_island():
    labels = jnp.array([[0, 0], [1, 0], [1, 2], [3, 2]])
    values = jnp.array([[False, False], [False, True], [True, False], [False, False]])
    expected = [[False, True], [True, True], [True, False], [False, False]]
    np.testing.assert_array_equal(any_in_island(labels, values), expected)
