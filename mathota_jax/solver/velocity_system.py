"""The dense linear system in the velocities that a linearised law of the rows leads to.

With impulses ``P(J u + b)`` whose derivative by the error is H, the velocities ``u = u_free + M^-1 J^T P`` change by the
matrix ``G = 1 - M^-1 J^T H J``. It has one row for each component of a velocity block, however many rows act on them.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver.rows import Rows


class Factor(NamedTuple):
    """LU factors (world, n, n) and pivots of ``G``, for vectors with the block as the slower index."""

    lu: Array
    permutation: Array


def factorize(rows: tuple[Rows, ...], by_error: tuple[Array, ...], components: int) -> Factor:
    """Factors of ``G``; `by_error` is (turn, row, row', column, world) for each group."""
    count = rows[0].table.block_count
    worlds = max(value.shape[-1] for value in by_error)
    total = jnp.zeros((count * count, components, components, worlds), by_error[0].dtype)
    for group, matrix in zip(rows, by_error, strict=True):
        blocks = _blocks(group)
        weighted = [_weigh(matrix, jacobian) for jacobian in group.jacobian]
        for receiver, response in zip(blocks, group.response, strict=True):
            for source, jacobian in zip(blocks, weighted, strict=True):
                total = _scatter(group, total, receiver, source, response, jacobian)
    system = total.reshape(count, count, components, components, worlds).transpose(4, 0, 2, 1, 3)
    size = count * components
    lu, _, permutation = lax.linalg.lu(jnp.eye(size, dtype=total.dtype) - system.reshape(worlds, size, size))
    return Factor(lu, permutation)


def solve(factor: Factor, right_side: Array) -> Array:
    """``G^-1`` times (component, block, world); linear in it and transposable."""
    components, count, worlds = right_side.shape
    vector = right_side.transpose(2, 1, 0).reshape(worlds, count * components)
    vector = jnp.take_along_axis(vector, factor.permutation, axis=1)[..., None]
    lower = functools.partial(lax.linalg.triangular_solve, left_side=True, lower=True, unit_diagonal=True)
    vector = lax.linalg.triangular_solve(factor.lu, lower(factor.lu, vector), left_side=True, lower=False)
    return vector.reshape(worlds, count, components).transpose(2, 1, 0)


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
    product = functools.reduce(
        jnp.add, [response[:, row, :, None] * jacobian[:, row, None] for row in range(jacobian.shape[1])]
    )  # (turn, component, component', column, world)
    turns, components = product.shape[:2]
    product = product.reshape(turns, components, components, -1, together, product.shape[-1]).sum(4)
    product = jnp.moveaxis(product, 3, 1)
    index = jnp.where((receiver < count) & (source < count), receiver * count + source, count * count)
    product = product.reshape(-1, *product.shape[2:])
    if group.places is None:
        return total.at[index.reshape(-1)].add(product, mode="drop")
    index = index.reshape(-1, index.shape[-1])
    return jax.vmap(lambda t, i, p: t.at[i].add(p, mode="drop"), (-1, -1, -1), -1)(
        total,
        jnp.broadcast_to(index, (index.shape[0], worlds)),
        jnp.broadcast_to(product, (*product.shape[:-1], worlds)),
    )
