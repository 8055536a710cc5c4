"""The dense linear system in the velocities that a linearised law of the rows leads to.

With impulses ``P(J u + b)`` whose derivative by the error is H, the velocities ``u = u_free + M^-1 J^T P`` change by the
matrix ``G = 1 - M^-1 J^T H J``. It has one row for each component of a velocity block, however many rows act on them.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver import dense
from mathota_jax.solver.rows import Rows, map_turns
from mathota_jax.solver.slopes import Slopes
from mathota_jax.spatial import counter
from mathota_jax.spatial.settle import compute_once, materialize
from mathota_jax.spatial.spread import add_scaled


def solve_once(rows: tuple[Rows, ...], by_error: tuple[Array, ...], right_side: Array) -> Array:
    """``G^-1`` times (component, block, world); `by_error` is (turn, row, row', column, world) for each group.

    The right side is one more column of the matrix, which elimination permutes and reduces with the others: to turn pivots
    into a permutation takes longer than to eliminate.
    """
    weighted = [[_weigh(matrix, side) for side in group.jacobian] for group, matrix in zip(rows, by_error, strict=True)]
    # Joined with the worlds last, and stored: within the kernel that makes it, a transposition reads one number at a time.
    total = _nothing(rows, max(side.shape[-1] for sides in weighted for side in sides))
    for group, sides in zip(rows, compute_once(weighted, rows[0].bias), strict=True):
        total = _add(group, total, sides)
    columns = jnp.concatenate([_system(rows, total).swapaxes(0, 1), _vector(right_side)[None]])
    lu = lax.linalg.lu(materialize(columns).transpose(2, 1, 0))[0]
    found = lax.linalg.triangular_solve(lu[..., :-1], lu[..., -1:], left_side=True, lower=False)
    return _velocity(found[..., 0].T, right_side)


class Inverse(NamedTuple):
    """``G^-1``, (n, n, world), for many right sides."""

    matrix: Array

    def solve(self, right_side: Array) -> Array:
        """``G^-1`` times (component, block, world)."""
        return _velocity(add_scaled(self.matrix, _vector(right_side)), right_side)

    def solve_back(self, right_side: Array) -> Array:
        """Its transpose times the same."""
        return _velocity(add_scaled(self.matrix.swapaxes(0, 1), _vector(right_side)), right_side)


def inverse(rows: tuple[Rows, ...], slopes: tuple[Slopes, ...], answer: Callable[[Slopes, Array], Array]) -> Inverse:
    """``G^-1``; the answers by the slopes of each group are the products (turn, row, column, world) of H with errors."""

    def weighted(part: Rows, slope: Slopes) -> list[Array]:
        sides = [jax.vmap(functools.partial(answer, slope), 2, 2)(side) for side in part.jacobian]
        return compute_once(sides, part.bias)  # each goes into the products with all sides

    known = jax.tree.leaves((slopes, [group.response for group in rows]))
    total = _nothing(rows, max(leaf.shape[-1] for leaf in known))
    for group, slope in zip(rows, slopes, strict=True):
        if group.places is None:
            total = _add(group, total, weighted(group, slope))
        else:
            products = map_turns(lambda part, slope: _products(part, weighted(part, slope)), group, slope)
            total = _add_turn_by_turn(group, total, products)
    return Inverse(compute_once(dense.inverse(_system(rows, total), rows[0].response[0].shape[2]), rows[0].bias))


def _vector(velocity: Array) -> Array:
    """(n, world) of (component, block, world), with the block as the slower index."""
    return velocity.swapaxes(0, 1).reshape(-1, velocity.shape[-1])


def _velocity(vector: Array, like: Array) -> Array:
    """(component, block, world) of (n, world)."""
    return vector.reshape(like.shape[1], like.shape[0], -1).swapaxes(0, 1)


def _nothing(rows: tuple[Rows, ...], worlds: int) -> Array:
    """(block and block', component, component', world) to add to."""
    count, components = rows[0].table.block_count, rows[0].response[0].shape[2]
    return jnp.zeros((count * count, components, components, worlds), rows[0].bias.dtype)


def _system(rows: tuple[Rows, ...], total: Array) -> Array:
    """``G``, (n, n, world), from ``M^-1 J^T H J``."""
    count, components, worlds = rows[0].table.block_count, *total.shape[2:]
    system = total.reshape(count, count, components, components, worlds).swapaxes(1, 2)
    size = count * components
    return jnp.eye(size, dtype=total.dtype)[..., None] - system.reshape(size, size, worlds)


def _add(group: Rows, total: Array, weighted: Sequence[Array]) -> Array:
    """Adds the responses of a group times its ``H J``, by side."""
    blocks = _blocks(group)
    for receiver, response in zip(blocks, group.response, strict=True):
        for source, jacobian in zip(blocks, weighted, strict=True):
            total = _scatter(group, total, receiver, source, response, jacobian)
    return total


def _blocks(group: Rows) -> tuple[Any, ...]:
    if group.places is not None:
        return group.places.blocks
    return tuple(jnp.asarray(side, jnp.int32)[:, :: group.table.together, None] for side in group.table.blocks)


def _weigh(matrix: Array, jacobian: Array) -> Array:
    """``H J``: (turn, row, component, column, world)."""
    terms = [matrix[:, :, row, None] * jacobian[:, None, row] for row in range(jacobian.shape[1])]
    return functools.reduce(jnp.add, terms)


def _product(group: Rows, response: Array, jacobian: Array) -> Array:
    """``M^-1 J^T`` of a side times ``H J`` of a side, (turn, constraint, component, component', world)."""
    together = group.table.together
    of_points = [
        functools.reduce(
            jnp.add,
            [
                response[:, row, :, None, point::together] * jacobian[:, row, None, :, point::together]
                for row in range(jacobian.shape[1])
            ],
        )
        for point in range(together)
    ]
    product = functools.reduce(jnp.add, of_points)
    return jnp.moveaxis(compute_once(product, product), 3, 1)


def _scatter(group: Rows, total: Array, receiver: Array, source: Array, response: Array, jacobian: Array) -> Array:
    """Adds the products of the constraints (turn, constraint) at their pairs of blocks."""
    count, worlds = group.table.block_count, total.shape[-1]
    product = _product(group, response, jacobian)
    product = product.reshape(-1, *product.shape[2:])
    index = _pair_of_blocks(count, receiver, source)
    if group.places is None:
        return total.at[index.reshape(-1)].add(product, mode="drop")
    index = index.reshape(-1, index.shape[-1])
    return jax.vmap(lambda t, i, p: t.at[i].add(p, mode="drop"), (-1, -1, -1), -1)(
        total,
        jnp.broadcast_to(index, (index.shape[0], worlds)),
        jnp.broadcast_to(product, (*product.shape[:-1], worlds)),
    )


def _pair_of_blocks(count: int, receiver: Array, source: Array) -> Array:
    """Number of a pair of blocks; one that does not exist where one of them does not."""
    return jnp.where((receiver < count) & (source < count), receiver * count + source, count * count)


def _products(group: Rows, weighted: Sequence[Array]) -> Array:
    """`_product` of all pairs of sides, (turn, constraint, pair of sides, component, component', world)."""
    sides = itertools.product(group.response, weighted)
    return jnp.stack([_product(group, response, jacobian) for response, jacobian in sides], axis=2)


def _add_turn_by_turn(group: Rows, total: Array, products: Array) -> Array:
    """Adds the products of the turns in use, in all worlds at once, at the places of each."""
    assert group.places is not None
    pairs = itertools.product(group.places.blocks, group.places.blocks)
    index = jnp.stack([_pair_of_blocks(group.table.block_count, *pair) for pair in pairs], axis=2)
    lanes = jnp.arange(total.shape[-1])
    index = jnp.broadcast_to(index, (*index.shape[:-1], len(lanes)))
    products = jnp.broadcast_to(products, (*products.shape[:-1], len(lanes)))

    def of_turn(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        turn, total = carry
        places, product = counter.row((index, products), turn)
        change = jnp.moveaxis(product, -1, 2)  # what the worlds are scattered by comes first
        return counter.following(turn), total.at[places, :, :, lanes].add(change, mode="drop")

    turns = index.shape[0] if group.places.turns is None else group.places.turns
    return lax.fori_loop(0, turns, of_turn, (counter.start(), total))[1]
