"""Projected Gauss-Seidel on velocity blocks (guide 9.2), and its derivative at the solution.

The solver knows rows (`rows`), not contacts or joints.

The derivative is that of the fixed point. It satisfies a linear system: that of few bodies is solved densely (`implicit`),
that of many, which has the same sparsity, by the same sweeps with the law replaced by its Jacobian (`linear_sweeps`).
Neither stores what it passes through: reverse mode needs memory constant in the number of sweeps. The initial impulses do
not move the fixed point and have no derivative.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from mathota_jax.solver import conjugate, converged, implicit, linear_sweeps, sweeps
from mathota_jax.solver.laws import Cone, Push
from mathota_jax.solver.linearised import linearise, with_changes
from mathota_jax.solver.row_matrix import Dense
from mathota_jax.solver.rows import (
    Rows,
    add_impulses,
    map_turns,
)
from mathota_jax.solver.sweeps import Update
from mathota_jax.spatial.settle import compute_once

PLAIN_SWEEPS = 4
"""Last sweeps, in which contacts do not over-relax: they take to rest what longer steps leave swinging. Measured: with two,
dropped boxes may creep; with three none of 16 does, but a slide on a heightfield and on a plane differ by 2e-5 m."""

OVER_RELAXATION = 1.7
"""Factor on the normal steps of the sweeps before those, which converge if its product with that of `normal_bound` is below
2. Measured with 10 sweeps from nothing: ten boxes dip by 1.0 mm instead of 2.3."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def solve(
    iterations: int,
    gradient_iterations: int,
    to_solution: bool,
    rows: tuple[Rows, ...],
    velocity: Array,
    impulses: tuple[Array, ...],
    change: Array | None = None,
    momentum: Callable[[Array], Array] | None = None,
) -> tuple[Array, tuple[Array, ...]]:
    """Runs a fixed number of sweeps.

    Args:
      iterations: number of sweeps, 0 if the impulses are known to be solved.
      gradient_iterations: number of sweeps of the linear solver behind a derivative; 0 for a dense system instead.
      to_solution: whether that system is the one at what `converged` makes of the impulses.
      rows: groups of rows, solved in this order within a sweep.
      velocity: (component, block, world) without any constraint impulse.
      impulses: for each group (turn, row, column, world), the impulses to start from.
      change: (component, block, world) what they make of the velocity, without derivative; None if it is not known yet.
      momentum: pytree function, of a change of the velocity (component, block, world) that of the momentum, for sweeps
        along conjugate directions; None for sweeps alone.

    Returns:
      The velocity with the impulses, and the impulses.
    """
    velocity = add_impulses(rows, velocity, impulses) if change is None else velocity + change
    if not rows or not iterations:
        return compute_once((velocity, impulses), velocity)
    biases = tuple(group.bias for group in rows)
    laws = tuple(group.law.starting(impulse) for group, impulse in zip(rows, impulses, strict=True))
    if momentum is None or iterations == 1 or not _couple(rows):
        return sweeps.run(iterations, rows, _of_number(iterations, velocity.dtype), laws, biases, velocity, impulses)

    def with_factor(number: Array, slides: Array) -> tuple[tuple[Any, ...], ...]:
        factor = jnp.where(slides > 0, _longer(iterations, number), 1.0).astype(velocity.dtype)
        return tuple(
            (law, jnp.broadcast_to(factor, (group.bias.shape[0], 1, *factor.shape)))
            for law, group in zip(laws, rows, strict=True)
        )

    update = sweeps.of_law(lambda given, bias: _relaxed(given[0], bias, given[1]), lambda given: given[0])
    return conjugate.run(iterations, update, with_factor, momentum, rows, biases, velocity, impulses)


def _longer(iterations: int, number: Array | int) -> Array:
    """Factor on the normal steps of a sweep."""
    return jnp.where(number < iterations - PLAIN_SWEEPS, OVER_RELAXATION, 1.0)


def _relaxed(law: Any, bias: Array, factor: Array) -> Any:
    # A contact that bounces is alone for the most part, and its exact step ends at once. Longer ones leave an error
    # of 1e-4, by which elastic boxes that bounce on their faces were measured to begin to spin.
    return law.relaxed(jnp.where(bias[0] >= 0, factor, 1.0).astype(bias.dtype))


def _of_number(iterations: int, dtype: Any) -> Callable[[Array | int], Update]:
    """What each of so many sweeps does."""

    def of_number(number: Array | int) -> Update:
        factor = _longer(iterations, number).astype(dtype)
        return sweeps.of_law(lambda law, bias: _relaxed(law, bias, factor))

    return of_number


def from_rest(iterations: int, rows: tuple[Rows, ...], still: Array) -> tuple[Array, ...]:
    """Impulses after sweeps from nothing, without derivative; `still` is the velocity (component, block, world), 0."""
    start = tuple(jnp.zeros_like(group.bias) for group in rows)
    return solve(iterations, 1, False, *lax.stop_gradient((rows, still, start, still)))[1]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def as_swept(iterations: int, rows: tuple[Rows, ...], still: Array, found: tuple[Array, ...]) -> tuple[Array, ...]:
    """Impulses that `from_rest` found, with the derivative of just these sweeps.

    Of few sweeps, which end before the solution: their derivative is not that of the solution. Reverse mode stores the
    impulses of each.

    Args:
      iterations: number of sweeps.
      rows, still: as of `from_rest`.
      found: for each group (turn, row, column, world), without derivative.
    """
    del iterations, rows, still
    return found


def _as_swept_jvp(iterations: int, primals: tuple, tangents: tuple) -> tuple:
    rows, still, found = primals
    leaves, structure = jax.tree.flatten(rows)
    changes = jax.tree.leaves(tangents[0])
    moving = [k for k, change in enumerate(changes) if not isinstance(change, SymbolicZero)]

    def swept(of_moving: list[Array]) -> tuple[Array, ...]:
        new = dict(zip(moving, of_moving, strict=True))
        given = jax.tree.unflatten(structure, [new.get(k, leaf) for k, leaf in enumerate(leaves)])
        start = tuple(jnp.zeros_like(group.bias) for group in given)
        laws = tuple(group.law.starting(impulse) for group, impulse in zip(given, start, strict=True))
        biases = tuple(group.bias for group in given)
        return sweeps.by_turns(iterations, _of_number(iterations, still.dtype), given, laws, biases, still, start)[1]

    old, d_old = ([values[k] for k in moving] for values in (leaves, changes))
    return found, jax.jvp(swept, (old,), (d_old,))[1]


as_swept.defjvp(_as_swept_jvp, symbolic_zeros=True)


def gradient_sweeps(rows: tuple[Rows, ...], iterations: int, asked: int | None) -> int:
    """Sweeps behind the derivative of so many `iterations`: those asked for, if any; 0 for one dense system."""
    if asked:
        return asked
    return 0 if implicit.is_small(rows) else linear_sweeps.enough_for_derivatives(rows, iterations)


def _couple(rows: tuple[Rows, ...]) -> bool:
    """Whether impulses of contacts travel from block to block; on one block alone sweeps get far enough."""
    sides = [group.table.blocks if group.places is None else group.places.blocks for group in rows]
    return any(len(of_group) > 1 for of_group in sides) and all(isinstance(group.law, Cone | Push) for group in rows)


@solve.defjvp
def _solve_jvp(iterations: int, gradient_iterations: int, to_solution: bool, primals: tuple, tangents: tuple) -> tuple:
    rows, free, start, _, _ = primals
    d_rows, d_velocity, _, _, _ = tangents
    found = solve(iterations, gradient_iterations, to_solution, *primals)
    if not rows:
        return found, (d_velocity, start)
    # With all entries: the transposed system exchanges Jacobian and response.
    dense = tuple(dataclasses.replace(group, matrix=_all_entries(group)) for group in rows)
    velocity, impulses = found
    if to_solution and not gradient_iterations:
        # Second derivatives are those of what was found.
        solution = converged.solve(*lax.stop_gradient((dense, free, impulses)))[:2]
        further = jax.tree.map(jnp.subtract, solution, lax.stop_gradient(found))
        velocity, impulses = jax.tree.map(jnp.add, found, further)
    d_velocity, slopes, right_sides = linearise(rows, d_rows, velocity, impulses, d_velocity)
    if gradient_iterations:
        d_impulses = linear_sweeps.solve(gradient_iterations, dense, slopes, right_sides)
    else:
        d_impulses = implicit.solve(dense, slopes, right_sides)
    return found, (with_changes(rows, (velocity, impulses), (d_velocity, d_impulses)), d_impulses)


def _all_entries(group: Rows) -> Any:
    if isinstance(group.matrix, Dense):
        return group.matrix
    return map_turns(lambda part, _: part.matrix.dense(), group, ())
