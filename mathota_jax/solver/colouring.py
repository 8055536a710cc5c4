"""Turns for constraints that are known only in the step: an edge colouring by rounds of local minima.

Source: M. T. Jones and P. E. Plassmann, "A parallel graph coloring heuristic", SIAM J. Sci. Comput. 14 (1993): in each
round every edge whose number is the least at both of its ends takes the first colour that is free at both. The result is
that of the greedy colouring in the order of the numbers, whatever the number of edges handled side by side.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.spatial.indexing import gather

BITS = 31
"""Colours in one word of a set; the sign bit stays clear."""


def edge_colours(
    ends: tuple[Array, Array], priority: Array, active: Array, node_count: int, colour_count: int
) -> Array:
    """Colours (edge, world) such that edges with a common node differ; `colour_count` where no colour was left.

    Args:
      ends: (edge, world) nodes of each edge; a node `node_count` is none.
      priority: (edge, world) int32, different for all active edges of a world, non-negative.
      active: (edge, world) edges to be coloured; the others get `colour_count`.
      node_count: number of nodes.
      colour_count: number of colours.
    """
    worlds = priority.shape[-1]
    lanes = jnp.arange(worlds)
    word_count = -(-colour_count // BITS)
    last = jnp.iinfo(jnp.int32).max
    full = (1 << BITS) - 1
    usable = [full if colour_count >= BITS * (word + 1) else (1 << (colour_count - BITS * word)) - 1
              for word in range(word_count)]  # fmt: skip

    def one_round(state: tuple) -> tuple:
        waiting, colour, used = state
        number = jnp.where(waiting, priority, last)
        least = jnp.full((node_count + 1, worlds), last, jnp.int32)
        for end in ends:
            least = least.at[end, lanes].min(number)
        least = least.at[node_count].set(last)
        chosen = waiting
        for end in ends:
            chosen &= (gather(least, end) == number) | (end == node_count)
        first_free, words = jnp.full_like(colour, colour_count), []
        for word in reversed(range(word_count)):
            taken = gather(used[word], ends[0]) | gather(used[word], ends[1])
            free = ~taken & usable[word]
            lowest = lax.population_count((free & -free) - 1) + BITS * word
            first_free = jnp.where(free != 0, lowest, first_free)
            words.append((word, taken))
        colour = jnp.where(chosen, first_free, colour)
        new_used = list(used)
        for word, _ in words:
            mine = chosen & (first_free >= BITS * word) & (first_free < jnp.minimum(BITS * (word + 1), colour_count))
            bit = jnp.where(mine, 1 << jnp.clip(first_free - BITS * word, 0, BITS - 1), 0)
            for end in ends:
                old = gather(new_used[word], end)
                place = jnp.where(mine & (end < node_count), end, node_count + 1)
                new_used[word] = new_used[word].at[place, lanes].set(old | bit, mode="drop")
        return waiting & ~chosen, colour, tuple(new_used)

    start = (
        active,
        jnp.full(priority.shape, colour_count, jnp.int32),
        tuple(jnp.zeros((node_count + 1, worlds), jnp.int32) for _ in range(word_count)),
    )
    return lax.while_loop(lambda state: state[0].any(), one_round, start)[1]
