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
from mathota_jax.spatial.settle import compute_once, materialize
from mathota_jax.spatial.spread import add_slices


class Factor(NamedTuple):
    """LU factors (world, n, n) and pivots of ``G``, for vectors with the block as the slower index."""

    lu: Array
    permutation: Array


def solve_once(rows: tuple[Rows, ...], by_error: tuple[Array, ...], right_side: Array) -> Array:
    """``G^-1`` times (component, block, world); `by_error` is (turn, row, row', column, world) for each group.

    The right side is one more column of the matrix, which elimination permutes and reduces with the others: to turn pivots
    into a permutation takes longer than to eliminate.
    """
    parts = _system(rows, by_error, right_side.shape[0]), _vectors(right_side)
    # Joined with the worlds last, and stored: within the kernel that makes it, a transposition reads one number at a time.
    columns = jnp.concatenate([part.transpose(2, 1, 0) for part in parts])
    lu = lax.linalg.lu(materialize(columns).transpose(2, 1, 0))[0]
    return _velocity(lax.linalg.triangular_solve(lu[..., :-1], lu[..., -1:], left_side=True, lower=False), right_side)


def factorize(rows: tuple[Rows, ...], by_error: tuple[Array, ...], components: int) -> Factor:
    """Factors of ``G`` for many right sides."""
    lu, _, permutation = lax.linalg.lu(_system(rows, by_error, components))
    return Factor(lu, permutation)


def solve(factor: Factor, right_side: Array) -> Array:
    """``G^-1`` times (component, block, world); linear in it and transposable."""
    vectors = jnp.take_along_axis(_vectors(right_side), factor.permutation[..., None], axis=1)
    lower = functools.partial(lax.linalg.triangular_solve, left_side=True, lower=True, unit_diagonal=True)
    vectors = lax.linalg.triangular_solve(factor.lu, lower(factor.lu, vectors), left_side=True, lower=False)
    return _velocity(vectors, right_side)


def _vectors(velocity: Array) -> Array:
    """(world, n, 1) of (component, block, world)."""
    return velocity.transpose(2, 1, 0).reshape(velocity.shape[-1], -1, 1)


def _velocity(vectors: Array, like: Array) -> Array:
    """(component, block, world) of (world, n, 1)."""
    return vectors.reshape(-1, like.shape[1], like.shape[0]).transpose(2, 1, 0)


def _system(rows: tuple[Rows, ...], by_error: tuple[Array, ...], components: int) -> Array:
    """``G``, (world, n, n)."""
    count = rows[0].table.block_count
    worlds = max(value.shape[-1] for value in by_error)
    total = jnp.zeros((count * count, components, components, worlds), by_error[0].dtype)
    for group, matrix in zip(rows, by_error, strict=True):
        blocks = _blocks(group)
        weighted = compute_once([_weigh(matrix, jacobian) for jacobian in group.jacobian], matrix)
        for receiver, response in zip(blocks, group.response, strict=True):
            for source, jacobian in zip(blocks, weighted, strict=True):
                total = _scatter(group, total, receiver, source, response, jacobian)
    system = total.reshape(count, count, components, components, worlds).transpose(4, 0, 2, 1, 3)
    size = count * components
    return jnp.eye(size, dtype=total.dtype) - system.reshape(worlds, size, size)


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
    product = compute_once(product.reshape(turns, components, components, -1, together, product.shape[-1]), product)
    product = jnp.moveaxis(add_slices(product, 4), 3, 1)
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
