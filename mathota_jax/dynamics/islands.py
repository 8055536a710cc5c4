"""Islands: bodies that are connected through touching contacts and joints (guide 12.2)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.bodies import Edges
from mathota_jax.spatial.indexing import gather


def island_labels(edges: Edges, body_count: int, worlds: int) -> Array:
    """Connected components: (body, world) int32, the smallest handle of the island that each body belongs to.

    Each round hooks the label of either end of every edge to the smaller of the two and then halves the paths to the
    roots ("pointer jumping"; Y. Shiloach and U. Vishkin, "An O(log n) parallel connectivity algorithm", J. Algorithms 3,
    1982). Labels are handles of bodies of the same island and only ever fall, so the rounds end; when a round changes
    nothing, both ends of every edge have one label, which is its own: the components. Integers alone, so no derivative.
    """
    lanes = jnp.arange(worlds)
    shape = (edges.active.shape[0], worlds)
    first, second, active = (jnp.broadcast_to(part, shape) for part in edges)
    # An absent edge joins a body to itself.
    second = jnp.where(active, second, first)

    def one_round(state: tuple[Array, Array]) -> tuple[Array, Array]:
        labels, _ = state
        ends = gather(labels, first), gather(labels, second)
        lower = jnp.minimum(*ends)
        new = labels
        for end in ends:
            new = new.at[end, lanes].min(lower)
        new = gather(new, new)
        return new, (new != labels).any()

    labels = jnp.broadcast_to(jnp.arange(body_count, dtype=jnp.int32)[:, None], (body_count, worlds))
    return lax.while_loop(lambda state: state[1], one_round, (labels, jnp.asarray(True)))[0]


def any_in_island(labels: Array, values: Array) -> Array:
    """(body, world) whether `values` (body, world) holds for any body of the island of each body."""
    lanes = jnp.arange(labels.shape[-1])
    values = jnp.broadcast_to(values, labels.shape)
    return gather(jnp.zeros(labels.shape, bool).at[labels, lanes].max(values), labels)
