"""The laws of all rows at their fixed point, linearised: what a derivative of the solution has to solve."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
from jax import Array

from mathota_jax.solver.rows import Rows, add_changes, add_impulses, map_turns, row_velocity
from mathota_jax.solver.slopes import Slopes, slopes_of
from mathota_jax.spatial.settle import compute_once


def linearise(
    rows: tuple[Rows, ...], d_rows: tuple[Rows, ...], velocity: Array, impulses: tuple[Array, ...], d_velocity: Array
) -> tuple[Array, tuple[Slopes, ...], tuple[Array, ...]]:
    """Derivative of the fixed point of all laws, but for the change of the impulses.

    Returns:
      The change of the velocity at fixed impulses; for each group the slopes of its law, and the change of its impulses at
      fixed impulses.
    """
    # As derivatives of what visits the turns in use alone, which can be transposed.
    for group, d_group, impulse in zip(rows, d_rows, impulses, strict=True):
        added = functools.partial(_add_changes_by, group, impulse)
        d_velocity = jax.jvp(added, (group.matrix, velocity), (d_group.matrix, d_velocity))[1]
    slopes, right_sides = [], []
    for group, d_group, impulse in zip(rows, d_rows, impulses, strict=True):
        slopes.append(
            map_turns(lambda part, impulse: slopes_of(part.law, impulse, _error(part, velocity)), group, impulse)
        )
        answer = functools.partial(_answer, group, impulse)
        primals, changes = ((g.matrix, g.bias, g.law, v) for g, v in ((group, velocity), (d_group, d_velocity)))
        right_sides.append(jax.jvp(answer, primals, changes)[1])
    return d_velocity, tuple(slopes), tuple(right_sides)


def with_changes(rows: tuple[Rows, ...], primals: tuple[Array, Any], changes: tuple[Array, Any]) -> Array:
    """A change of the velocity with those of the impulses, by what they are changes of."""
    return jax.jvp(functools.partial(add_impulses, rows), primals, changes)[1]


def _add_changes_by(group: Rows, impulse: Array, matrix: Any, velocity: Array) -> Array:
    return add_changes(group, matrix, velocity, impulse)


def _error(part: Rows, velocity: Array) -> Array:
    """Stored: it goes into all slopes of the law, and its cotangent into that of every entry of the matrix."""
    return compute_once(part.bias + row_velocity(part, velocity), velocity)


def _answer(group: Rows, impulse: Array, matrix: Any, bias: Array, law: Any, velocity: Array) -> Array:
    """The impulses that the law makes of those given."""
    group = dataclasses.replace(group, matrix=matrix, bias=bias, law=law)
    return map_turns(lambda part, impulse: part.law.update(impulse, _error(part, velocity)), group, impulse)
