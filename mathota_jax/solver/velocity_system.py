"""The dense linear system in the velocities that a linearised law of the rows leads to.

With impulses ``P(J u + b)`` whose derivative by the error is H, the velocities ``u = u_free + M^-1 J^T P`` change by the
matrix ``G = 1 - M^-1 J^T H J``. It has one row for each component of a velocity block, however many rows act on them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver import dense
from mathota_jax.solver.rows import Rows
from mathota_jax.spatial.settle import compute_once, materialize
from mathota_jax.spatial.spread import add_scaled


def solve_once(rows: tuple[Rows, ...], by_error: tuple[Array, ...], right_side: Array) -> Array:
    """``G^-1`` times (component, block, world); `by_error` is (turn, row, row', column, world) for each group.

    The right side is one more column of the matrix, which elimination permutes and reduces with the others: to turn pivots
    into a permutation takes longer than to eliminate.
    """
    weighted = [[_weigh(matrix, side) for side in group.jacobian] for group, matrix in zip(rows, by_error, strict=True)]
    # Joined with the worlds last, and stored: within the kernel that makes it, a transposition reads one number at a time.
    columns = jnp.concatenate([_system(rows, weighted).swapaxes(0, 1), _vector(right_side)[None]])
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


def inverse(rows: tuple[Rows, ...], answers: Sequence[Callable[[Array], Array]]) -> Inverse:
    """``G^-1``; the answers are, of each group, the products (turn, row, column, world) of H with errors."""
    weighted = [
        [jax.vmap(answer, 2, 2)(side) for side in group.jacobian] for group, answer in zip(rows, answers, strict=True)
    ]
    return Inverse(compute_once(dense.inverse(_system(rows, weighted), rows[0].response[0].shape[2]), rows[0].bias))


def _vector(velocity: Array) -> Array:
    """(n, world) of (component, block, world), with the block as the slower index."""
    return velocity.swapaxes(0, 1).reshape(-1, velocity.shape[-1])


def _velocity(vector: Array, like: Array) -> Array:
    """(component, block, world) of (n, world)."""
    return vector.reshape(like.shape[1], like.shape[0], -1).swapaxes(0, 1)


def _system(rows: tuple[Rows, ...], weighted: Sequence[Sequence[Array]]) -> Array:
    """``G``, (n, n, world), from ``H J`` of each group and side."""
    count, components = rows[0].table.block_count, rows[0].response[0].shape[2]
    worlds = max(side.shape[-1] for sides in weighted for side in sides)
    total = jnp.zeros((count * count, components, components, worlds), rows[0].bias.dtype)
    for group, sides in zip(rows, compute_once(weighted, rows[0].bias), strict=True):
        blocks = _blocks(group)
        for receiver, response in zip(blocks, group.response, strict=True):
            for source, jacobian in zip(blocks, sides, strict=True):
                total = _scatter(group, total, receiver, source, response, jacobian)
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


def _scatter(group: Rows, total: Array, receiver: Array, source: Array, response: Array, jacobian: Array) -> Array:
    """Adds the products of the constraints (turn, constraint) at their pairs of blocks."""
    count, together = group.table.block_count, group.table.together
    worlds = total.shape[-1]
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
    product = functools.reduce(jnp.add, of_points)  # (turn, component, component', constraint, world)
    product = jnp.moveaxis(compute_once(product, product), 3, 1)
    product = product.reshape(-1, *product.shape[2:])
    index = jnp.where((receiver < count) & (source < count), receiver * count + source, count * count)
    if group.places is None:
        return total.at[index.reshape(-1)].add(product, mode="drop")
    index = index.reshape(-1, index.shape[-1])
    return jax.vmap(lambda t, i, p: t.at[i].add(p, mode="drop"), (-1, -1, -1), -1)(
        total,
        jnp.broadcast_to(index, (index.shape[0], worlds)),
        jnp.broadcast_to(product, (*product.shape[:-1], worlds)),
    )
