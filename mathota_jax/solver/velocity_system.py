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
    products = [_products(group, sides) for group, sides in zip(rows, weighted, strict=True)]
    columns = jnp.concatenate([_system(rows, products).swapaxes(0, 1), _vector(right_side)[None]])
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

    def products(part: Rows, slope: Slopes) -> Array:
        return _products(part, [jax.vmap(functools.partial(answer, slope), 2, 2)(side) for side in part.jacobian])

    found = [map_turns(products, group, slope) for group, slope in zip(rows, slopes, strict=True)]
    return Inverse(compute_once(dense.inverse(_system(rows, found), rows[0].response[0].shape[2]), rows[0].bias))


def _vector(velocity: Array) -> Array:
    """(n, world) of (component, block, world), with the block as the slower index."""
    return velocity.swapaxes(0, 1).reshape(-1, velocity.shape[-1])


def _velocity(vector: Array, like: Array) -> Array:
    """(component, block, world) of (n, world)."""
    return vector.reshape(like.shape[1], like.shape[0], -1).swapaxes(0, 1)


def _system(rows: tuple[Rows, ...], products: Sequence[Array]) -> Array:
    """``G``, (n, n, world), from the `_products` of each group."""
    count, components = rows[0].table.block_count, rows[0].response[0].shape[2]
    worlds = max(product.shape[-1] for product in products)
    total = jnp.zeros((count * count, components, components, worlds), rows[0].bias.dtype)
    for group, product in zip(rows, products, strict=True):
        total = _scatter(group, total, product)
    system = total.reshape(count, count, components, components, worlds).swapaxes(1, 2)
    size = count * components
    return jnp.eye(size, dtype=total.dtype)[..., None] - system.reshape(size, size, worlds)


def _blocks(group: Rows) -> tuple[Any, ...]:
    if group.places is not None:
        return group.places.blocks
    return tuple(jnp.asarray(side, jnp.int32)[:, :: group.table.together, None] for side in group.table.blocks)


def _weigh(matrix: Array, jacobian: Array) -> Array:
    """``H J``: (turn, row, component, column, world)."""
    terms = [matrix[:, :, row, None] * jacobian[:, None, row] for row in range(jacobian.shape[1])]
    return functools.reduce(jnp.add, terms)


def _products(group: Rows, weighted: Sequence[Array]) -> Array:
    """``M^-1 J^T`` of a side times ``H J`` of a side, (turn, constraint, sides, component, component', world)."""
    together = group.table.together
    of_sides = []
    for response, jacobian in itertools.product(group.response, compute_once(list(weighted), group.bias)):
        terms = [
            response[:, row, :, None, point::together] * jacobian[:, row, None, :, point::together]
            for point in range(together)
            for row in range(jacobian.shape[1])
        ]
        of_sides.append(jnp.moveaxis(compute_once(functools.reduce(jnp.add, terms), group.bias), 3, 1))
    return jnp.stack(of_sides, axis=2)


def _scatter(group: Rows, total: Array, products: Array) -> Array:
    """Adds the products of the constraints at their pairs of blocks."""
    count = group.table.block_count
    blocks = _blocks(group)
    pairs = [
        jnp.where((receiver < count) & (source < count), receiver * count + source, count * count)
        for receiver, source in itertools.product(blocks, blocks)
    ]
    index = jnp.stack(pairs, axis=2)  # (turn, constraint, receiver and source, world)
    if group.places is None:
        return total.at[index.reshape(-1)].add(products.reshape(-1, *products.shape[3:]), mode="drop")
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
