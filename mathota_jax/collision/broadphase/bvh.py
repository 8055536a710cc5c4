"""Bounding volume hierarchy over the static shapes (guide 5.4): moving shapes descend a tree of boxes.

The tree is complete and implicit: leaf k is the k-th static shape along a Morton curve through the box centers, node m has
the children 2 m and 2 m + 1. It is built anew in each pass, which costs one sort of the static shapes: poses and sizes are
traced, so nothing about them may be assumed. Moving shapes meet one another by sort and sweep.

Source: C. Lauterbach et al., "Fast BVH Construction on GPUs", Eurographics 2009 (Morton order); traversal without a stack
by the numbering of the nodes.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.collision.broadphase.pair_list import (
    Admissible,
    Enumerate,
    PairList,
    Visit,
    collect,
)
from mathota_jax.collision.broadphase.ranges import sort_shapes
from mathota_jax.collision.broadphase.sort_and_sweep import sweep
from mathota_jax.collision.broadphase.volumes import Bounds, finite_bounds
from mathota_jax.spatial.indexing import gather, take
from mathota_jax.spatial.settle import settle, settle_code
from mathota_jax.spatial.vector import Vec3

MORTON_BITS = 10


def bvh(bounds: Bounds, admissible: Admissible, capacity: int) -> PairList:
    """Candidate pairs by a hierarchy of the static shapes; see `candidate_pairs`."""
    bounds, bad = finite_bounds(bounds)
    static = np.asarray(admissible.static)
    enumerators = [sweep(bounds, bad, np.flatnonzero(~static))] if not static.all() else []
    if static.any() and not static.all():
        enumerators.append(_descend(bounds, bad, np.flatnonzero(static), np.flatnonzero(~static)))
    return collect(enumerators, bounds, bad, admissible, capacity, ordered=False)


def _descend(bounds: Bounds, bad: Array, members: np.ndarray, seekers: np.ndarray) -> Enumerate:
    """Enumerates the pairs of a seeker and a member whose boxes overlap."""
    member_low, member_high = take((bounds.low, bounds.high), members)
    low, high, order = _tree(member_low, member_high, take(bad, members))
    leaf_count = low.x.shape[0] // 2
    worlds = order.shape[-1]
    own_low, own_high = take((bounds.low, bounds.high), seekers)
    seeking = ~take(bad, seekers)
    shapes = jnp.broadcast_to(jnp.asarray(seekers, jnp.int32)[:, None], seeking.shape)
    member_shapes = jnp.asarray(members, jnp.int32)

    def enumerate_pairs(visit: Visit, carry: tuple) -> tuple:
        def body(state: tuple) -> tuple:
            node, carry = state
            meets = node > 0
            for axis in range(3):
                meets &= gather(low[axis], node) <= own_high[axis]
                meets &= gather(high[axis], node) >= own_low[axis]
            meets = settle(jnp.where(meets, 1.0, 0.0)) > 0
            is_leaf = node >= leaf_count
            leaf = jnp.clip(node - leaf_count, 0, len(members) - 1)
            carry = visit(carry, shapes, member_shapes[gather(order, leaf)], meets & is_leaf)
            return jnp.where(meets & ~is_leaf, 2 * node, _next_subtree(node)), carry

        start = jnp.where(seeking, 1, 0)
        state = (jnp.broadcast_to(start, (len(seekers), worlds)), carry)
        return lax.while_loop(lambda state: (state[0] > 0).any(), body, state)[1]

    return enumerate_pairs


def _next_subtree(node: Array) -> Array:
    """The node that follows in pre-order when the subtree of `node` is left out; 0 after the last one."""
    following = node + 1
    lowest_bit = following & -following
    climbed = following >> lax.population_count(lowest_bit - 1)  # a right child's successor is that of its parent
    return jnp.where(climbed <= 1, 0, climbed)


def _tree(low: Vec3, high: Vec3, bad: Array) -> tuple[Vec3, Vec3, Array]:
    """Boxes (node, world) of the nodes, node 0 unused, and the members in the order of the leaves."""
    order = sort_shapes(_morton_codes(low, high, bad))[1]
    count = order.shape[0]
    padding = (1 << (count - 1).bit_length()) - count

    def nodes(values: Array, combine, empty: float) -> Array:
        leaves = jnp.where(gather(bad, order), empty, gather(values, order))
        levels = [jnp.concatenate([leaves, jnp.full((padding, leaves.shape[-1]), empty, leaves.dtype)])]
        while levels[0].shape[0] > 1:
            pairs = levels[0].reshape(-1, 2, leaves.shape[-1])
            levels.insert(0, combine(pairs[:, 0], pairs[:, 1]))
        return jnp.concatenate([jnp.full_like(levels[0], empty), *levels])

    largest = float(jnp.finfo(low.x.dtype).max)
    return (
        low.map(lambda x: nodes(x, jnp.minimum, largest)),
        high.map(lambda x: nodes(x, jnp.maximum, -largest)),
        order,
    )


def _morton_codes(low: Vec3, high: Vec3, bad: Array) -> Array:
    """Places of the box centers along a Z curve through the box of all of them: bits of x, y, z interleaved."""
    code = jnp.zeros(low.x.shape, jnp.int32)
    for axis in range(3):
        center = 0.5 * low[axis] + 0.5 * high[axis]
        smallest, largest = jnp.where(bad, jnp.inf, center).min(0), jnp.where(bad, -jnp.inf, center).max(0)
        width = jnp.where(largest > smallest, largest - smallest, 1.0)
        scaled = jnp.where(bad, 0.0, center - jnp.where(jnp.isfinite(smallest), smallest, 0.0)) / width
        cell = settle_code(jnp.floor(jnp.clip(scaled, 0.0, 1.0) * (2**MORTON_BITS - 1)))
        for bit in range(MORTON_BITS):
            code = code | (((cell >> bit) & 1) << (3 * bit + axis))
    return code
