"""Colours of edges known only in the step: edges with a common node differ, and few colours are used."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax.solver.colouring import edge_colours

WORLDS = 3
NO_NODE_SHARE = 0.2


def coloured(ends, active, node_count, colour_count, seed=0):
    rng = np.random.default_rng(seed)
    priority = np.stack([rng.permutation(ends[0].shape[0]) for _ in range(WORLDS)], axis=1)
    arguments = (tuple(jnp.asarray(end, jnp.int32) for end in ends), jnp.asarray(priority, jnp.int32))
    compiled = jax.jit(edge_colours, static_argnums=(3, 4))
    return np.asarray(compiled(*arguments, jnp.asarray(active), node_count, colour_count)), priority


def greedy(ends, priority, active, node_count, colour_count):
    """The definition: in the order of the priorities every edge takes the first colour free at both ends."""
    used, colours = [set() for _ in range(node_count + 1)], np.full(len(priority), colour_count)
    for edge in np.argsort(priority):
        if active[edge]:
            a, b = (end[edge] for end in ends)
            free = [c for c in range(colour_count) if c not in used[a] and c not in used[b]]
            if free:
                colours[edge] = free[0]
                used[a].add(free[0])
                used[b].add(free[0])
            used[node_count] = set()
    return colours


@pytest.mark.parametrize(
    ("node_count", "edge_count", "colour_count"), [(30, 90, 40), (12, 200, 70), (12, 200, 9), (2, 5, 31)]
)
def test_colours_are_those_of_the_greedy_order(node_count, edge_count, colour_count):
    """More than one word of colours, too few colours, multigraphs, and edges with one end only."""
    rng = np.random.default_rng(node_count)
    first = rng.integers(0, node_count, (edge_count, WORLDS))
    second = (first + rng.integers(1, node_count, (edge_count, WORLDS))) % node_count
    second = np.where(rng.random(second.shape) < NO_NODE_SHARE, node_count, second)
    active = rng.random(first.shape) < 0.8
    colours, priority = coloured((first, second), active, node_count, colour_count)
    for world in range(WORLDS):
        ends = first[:, world], second[:, world]
        np.testing.assert_array_equal(
            colours[:, world], greedy(ends, priority[:, world], active[:, world], node_count, colour_count)
        )


def test_a_star_needs_a_colour_for_each_edge():
    """A hub with 64 neighbours: three words of colours, all different."""
    hub, leaves = np.zeros((64, WORLDS), int), np.tile(np.arange(1, 65)[:, None], (1, WORLDS))
    colours, _ = coloured((leaves, hub), np.ones((64, WORLDS), bool), 65, 64)
    np.testing.assert_array_equal(np.sort(colours, axis=0), np.tile(np.arange(64)[:, None], (1, WORLDS)))
