"""Sweeps along conjugate directions.

The impulses x of contacts that nothing bounds minimise ``E(x) = v M v / 2 + b x`` with the velocity ``v = v_0 + M^-1 J^T x``
and the biases b: its slope is the error that the rows see. A sweep lowers E, but by less and less where impulses go far: up
a stack, or between a light body and the heavy one on it. It says where to go; how far, and with how much of the last
direction, is where E is least. Those are conjugate gradients with the sweep as their preconditioner, in the form that needs
no symmetry (A. Knyazev 2001, locally optimal). Bounds are the sweep's business: what goes beyond them comes back in the next
one (M. Silcowitz-Hansen, S. Niebe and K. Erleben 2010, nonsmooth conjugate gradients). If E rises by that, the sweeps go on
from where the last one ended. The last one goes as far as it says.

Friction of a contact that slides has no such E: what it does depends on what presses. Worlds in which one does, or nearly,
go on by sweeps alone. Measured with the E of what sticks: a sliding cube is thrown up.

Measured at 1/60 s with ten sweeps in float32, alone and along directions: a cube of 100 times the mass falls through the one
below, and dips by 4e-6 of its size; stacks of twenty dip by 1.6 % and 0.04 %, of forty by 30 % and 0.13 %.

Scenes in which something bounces are none for it: what is not converged yet was measured to gain energy. Nor are joints.

Each turn of a sweep takes its impulses along itself, before it is solved: of tables with room for many constraints only the
turns that hold one are touched.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver import sweeps
from mathota_jax.solver.laws import Cone
from mathota_jax.solver.rows import Rows
from mathota_jax.solver.sweeps import Update
from mathota_jax.spatial.settle import compute_once, store
from mathota_jax.spatial.spread import add_all_slices, add_slices, greatest
from mathota_jax.struct import pytree

NEAR_LIMIT = 0.5
"""Share of its limit from which on friction counts as sliding: a step along a direction takes more of it than a sweep.
Measured: with half of it a box of 400 times the mass that is dropped on two small ones presses them into the ground by 1e-4
of their size, with all of it by 0.8; and of a house of cards, which loses 18 without directions, 24 fall with all of it."""

APART = 1e-5
"""Share of a direction that must be left without the last one, for both to span a plane."""

LONGEST = 1e5
"""Longest step, in changes by a sweep; beyond is round-off, or what overflows."""

SUMS = 2
"""What turns add up: biases times changes, and contacts that slide."""


@pytree
class Along:
    """How far to go, (world,) or of each turn (turn, 1, world).

    Attributes:
      length: of what the last sweep changed.
      share: of the direction before it.
      back: 1 to go back to what the last sweep but one found.
    """

    length: Array
    share: Array
    back: Array


class _Parts(NamedTuple):
    """What goes along: velocities (component, block, world), or impulses (row, column, world) of a turn.

    Attributes:
      swept: what the last sweep found.
      start: from which it did.
      direction: by which that was reached.
      best: what the last sweep found that counted.
    """

    swept: Array
    start: Array
    direction: Array
    best: Array

    def along(self, way: Along) -> _Parts:
        """Before the next sweep, whose result is still missing."""
        direction = store(way.length * (self.swept - self.start) + way.share * self.direction, self.start)
        best = jnp.where(way.back > 0.5, self.best, self.swept)
        start = store(jnp.where(way.back > 0.5, self.best, self.start + direction), self.start)
        return _Parts(self.swept, start, direction, best)


def run(
    iterations: int,
    update: Update,
    coefficients: Callable[[Array, Array], tuple[tuple[Any, ...], ...]],
    momentum: Callable[[Array], Array],
    rows: tuple[Rows, ...],
    biases: tuple[Array, ...],
    velocity: Array,
    impulses: tuple[Array, ...],
) -> tuple[Array, tuple[Array, ...]]:
    """A number of sweeps; the velocity and the impulses after them.

    Args:
      iterations: that number.
      update: how turns find their impulses, from coefficients that begin with those given here.
      coefficients: tuple of each group, its law first, from the number of the sweep and how many contacts (world,) slide
        after the one before.
      momentum: (component, block, world) of a change of the velocity.
      rows, biases, velocity, impulses: as in `sweeps.run`.
    """
    worlds = velocity.shape[-1]
    # By the largest mass, so that energies of tiny and of huge scenes stay within the range of float32.
    unit = compute_once(1.0 / greatest(momentum(jnp.ones_like(velocity))[0]), velocity)
    along = update._replace(begin=_begin, end=_end, sums=SUMS)

    def one(number: Array, before: tuple[Any, ...]) -> tuple[Any, ...]:
        parts, held, way, size, risen, slides = before
        parts = parts.along(way)
        given = tuple(
            (*of_group, jax.tree.map(lambda x, group=group: jnp.broadcast_to(x, (group.bias.shape[0], 1, worlds)), way))
            for of_group, group in zip(coefficients(number, slides), rows, strict=True)
        )
        start = jnp.concatenate([parts.start, jnp.zeros((SUMS, *velocity.shape[1:]), velocity.dtype)])
        swept, held = sweeps.run(1, rows, lambda _: along, given, biases, start, held)
        swept, work = swept[: len(velocity)], add_slices(store(swept, swept)[len(velocity) :], 1)
        change = store(swept - parts.start, velocity)
        moved = store(momentum(change) * unit, velocity)
        own, mixed = add_all_slices(change * moved), add_all_slices(parts.direction * moved)
        slope = -add_all_slices(parts.start * moved) - work[0] * unit
        slides = store(work[1], work[1])
        own, mixed, slope = (store(x, x) for x in (own, mixed, slope))
        rises = (size > 0) & (risen - slope + 0.5 * own > 0)
        length, share = _least(own, mixed, size, slope)
        # After a step back the next sweep counts as it is, else the same step would be taken again.
        falls = (own > 0) & (slope > 0) & (length < LONGEST) & (slides == 0) & ~rises & (way.back < 0.5)
        way = Along(
            *(
                store(x.astype(own.dtype), own)
                for x in (jnp.where(falls, length, 1.0), jnp.where(falls, share, 0.0), jnp.where(rises, 1.0, 0.0))
            )
        )
        size = way.length * way.length * own + 2.0 * way.length * way.share * mixed + way.share * way.share * size
        risen = slope - 0.5 * (own + way.length * slope)
        parts = parts._replace(swept=swept)
        return parts, held, way, jnp.where(falls, size, 0.0), jnp.where(falls, risen, 0.0), slides

    nothing = jnp.zeros(worlds, velocity.dtype)
    parts = _still(velocity)
    way = Along(nothing + 1.0, nothing, nothing)
    begin = (parts, tuple(_still(impulse) for impulse in impulses), way, nothing, nothing, nothing)
    parts, held, way, *_ = lax.fori_loop(0, iterations, one, begin)

    def last(parts: _Parts) -> Array:
        return jnp.where(way.back > 0.5, parts.best, parts.swept)

    return last(parts), tuple(last(of_group) for of_group in held)


def _still(values: Array) -> _Parts:
    return _Parts(values, values, jnp.zeros_like(values), values)


def _begin(given: tuple[Any, ...], parts: _Parts) -> tuple[Array, _Parts]:
    ahead = parts.along(given[-1])
    return ahead.start, ahead


def _end(given: tuple[Any, ...], bias: Array, parts: _Parts, impulse: Array, new: Array) -> tuple[_Parts, Array]:
    """What is held of a turn, and what it adds to the slope by its biases and to the number of contacts that slide."""
    law = given[0]
    slope = bias[0] * (new[0] - impulse[0])  # tangents have no bias
    if not isinstance(law, Cone):
        return parts._replace(swept=new), jnp.stack([slope, jnp.zeros_like(slope)])
    limit = law.friction * new[0]
    near = NEAR_LIMIT * limit
    slides = (limit > 0) & (new[1] * new[1] + new[2] * new[2] >= near * near)
    return parts._replace(swept=new), jnp.stack([slope, jnp.where(slides, 1.0, 0.0).astype(new.dtype)])


def _least(own: Array, mixed: Array, size: Array, slope: Array) -> tuple[Array, Array]:
    """How much of a new and of the last direction leads to the least E, whose slope along the last one is 0.

    In ratios: products of energies leave the range of float32 for scenes of a tenth of a millimetre or of kilometres.
    """
    exists = size > 0
    safe_own = jnp.where(own > 0, own, 1.0)
    of_last = jnp.where(exists, mixed / jnp.where(exists, size, 1.0), 0.0)
    left = 1.0 - of_last * (mixed / safe_own)
    apart = left > APART
    length = slope / safe_own / jnp.where(apart, left, 1.0)
    return length, jnp.where(apart, -of_last * length, 0.0)
