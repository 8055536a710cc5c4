"""The linear system behind the derivative of solved impulses, solved to round-off, by a dense one in the velocities.

``A x = r`` with ``A = 1 - K - H J M^-1 J^T``, K and H being the slopes of the laws. Redundant rows make it singular, though
consistent: many impulses, one velocity. ``A + delta`` is regular, and its inverse needs one of the size of the velocities
(Woodbury's identity): with ``D = (1 - K + delta)^-1``, ``S = D H`` and ``G = 1 - M^-1 J^T S J``

    (A + delta)^-1 = D + S J G^-1 M^-1 J^T D.

Few steps along what this makes of the residual lead to a solution, whose velocity is the right one. A step leaves of a mode
of A of size s the share delta / (delta + s), and what round-off makes of S, which is large: the residual is found anew from
A after each.

Right sides may hold what no impulses answer to: sweeps end while all points of a face press, though their errors do not fit
one another. It stays in the residual, and each step adds it, over delta, to impulses that change no normal velocity; where
points slide in different directions, though, friction makes velocities of these. All of it is taken out in the end.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver import velocity_system
from mathota_jax.solver.laws import Law
from mathota_jax.solver.row_matrix import Dense
from mathota_jax.solver.rows import Rows, add_impulses, visiting_all_turns
from mathota_jax.solver.slopes import Slopes, left_unanswered, rates
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.spread import add_all_slices

STEPS, BODIES_A_STEP = 3, 2
"""So many steps, or one for each so many bodies, are taken in any case, and at most three times as many. (Rows at their
bounds, such as those of motors at their caps, have no mass and do not count in residuals; a step leaves delta of theirs.)
Measured for kicks of stacked cubes: five bodies need four in float32 and eight in float64, ten six in float32."""

DELTA = 1e-3
"""Beside 1; in float32 round-off makes the first step wrong by some 1e-7 over its square. In float64 it could be less, were
the rows of points that slide as redundant as they should be: where gaps of 1e-6 m do not fit one another, impulses take what
does not fit over delta, and friction makes velocities of them. With 1e-6 a ball that slides on a sliding box had derivatives
of 100 by the height of the box (0.56 in truth, 0.68 with 1e-3)."""

NOISE = 16.0
"""Round-offs of the right side above which a residual is worth a step."""

LEAST_FALL = 0.2
"""Of the square of the residual, for more steps than are taken in any case. Where all that is left is what nothing answers
to, round-off makes ways of it: their lengths would be 1e3 to 1e6."""

LEAST_EFFECT = 1e-5
"""Of a way, beside its size, for its length to be the one that leaves the least residual. What is left in the end is what no
impulses can answer to, round-off of redundant rows; so is what a way along these does, and the quotient of both took
derivatives to -132 for 5e-4 (a box under a ball, forward mode, float32). Ways that matter have effects of a share like the
mass ratio of what bears and what is borne."""

FEW_BODIES = 10
"""Moving bodies up to which the default solver's derivatives are the solution. Measured beside 15 linear sweeps, which leave
a third to a half of the answer to a kick (the whole gradient of a step, float32): 0.95 of the time for a slab, 1.02 to 1.05
for five stacked boxes, 1.4 for eight, 1.54 for ten, 1.9 for sixteen."""

Impulses = tuple[Array, ...]


def is_small(rows: tuple[Rows, ...]) -> bool:
    """Whether a dense system is worth its cost."""
    return all(group.table.block_count <= FEW_BODIES for group in rows)


def solve(rows: tuple[Rows, ...], slopes: tuple[Slopes, ...], right_sides: Impulses) -> Impulses:
    """Impulses x; linear in the right sides r (turn, row, column, world), transposable, and differentiable in everything.

    Args:
      rows: groups of rows, whose matrices are dense.
      slopes: K and H of each group.
      right_sides: r of each group.
    """
    system = _System(rows, slopes, right_sides)
    everywhere = visiting_all_turns(rows)  # the product is transposed
    product = functools.partial(left_unanswered, everywhere, slopes, system.nothing)
    masses = tuple(slope.masses for slope in slopes)

    def solve_forward(_: object, right_sides: Impulses) -> Impulses:
        weights = tuple(safe_divide(jnp.ones_like(mass), mass) for mass in masses)
        way = functools.partial(system.nearly, system.inverse())
        return _solve(way, system.product, weights, right_sides, system.nothing)

    def solve_transposed(_: object, right_sides: Impulses) -> Impulses:
        way = functools.partial(system.nearly_back, system.inverse())
        return _solve(way, system.product_back, masses, right_sides, system.nothing)

    return lax.custom_linear_solve(product, right_sides, solve_forward, transpose_solve=solve_transposed)


class _System:
    """What is nearly the inverse of A, and the transposes of both."""

    def __init__(self, rows: tuple[Rows, ...], slopes: tuple[Slopes, ...], like: Impulses) -> None:
        self.rows, self.slopes = rows, slopes
        self.swapped = tuple(dataclasses.replace(group, matrix=Dense(group.response, group.jacobian)) for group in rows)
        shape = rows[0].response[0].shape[2], rows[0].table.block_count, max(part.shape[-1] for part in like)
        self.nothing = jnp.zeros(shape, like[0].dtype)

    def once(self, values: Any) -> Any:
        """Stored; not where something else has to be transposed through it."""
        return compute_once(values, self.nothing)

    def product(self, x: Impulses) -> Impulses:
        """``A x``."""
        return left_unanswered(self.rows, self.slopes, self.nothing, x, self.once)

    def product_back(self, x: Impulses) -> Impulses:
        """``A^T x``."""
        both = [slope.transposed(part) for slope, part in zip(self.slopes, x, strict=True)]
        passed = self.once(tuple(by_error for _, by_error in both))
        velocity = self.once(add_impulses(self.swapped, self.nothing, passed))
        return tuple(
            part - by_impulse - rates(group, velocity)
            for part, (by_impulse, _), group in zip(x, both, self.swapped, strict=True)
        )

    def inverse(self) -> velocity_system.Inverse:
        """``G^-1``."""
        return velocity_system.inverse(self.rows, self.slopes, self._answer)

    def nearly(self, inverse: velocity_system.Inverse, residual: Impulses) -> Impulses:
        """``(A + delta)^-1`` times the residual."""
        settled = tuple(slope.resolve(part, DELTA) for slope, part in zip(self.slopes, residual, strict=True))
        settled = self.once(settled)
        velocity = self.once(inverse.solve(self.once(add_impulses(self.rows, self.nothing, settled))))
        return tuple(
            part + self._answer(slope, rates(group, velocity))
            for part, slope, group in zip(settled, self.slopes, self.rows, strict=True)
        )

    def nearly_back(self, inverse: velocity_system.Inverse, residual: Impulses) -> Impulses:
        """Its transpose times the same."""
        passed = tuple(
            slope.transposed(slope.resolve_back(part, DELTA))[1]
            for slope, part in zip(self.slopes, residual, strict=True)
        )
        pushed = self.once(add_impulses(self.swapped, self.nothing, self.once(passed)))
        velocity = self.once(inverse.solve_back(pushed))
        return tuple(
            slope.resolve_back(part + rates(group, velocity), DELTA)
            for slope, part, group in zip(self.slopes, residual, self.swapped, strict=True)
        )

    def _answer(self, slope: Slopes, error: Array) -> Array:
        """``S`` times errors."""
        return slope.resolve(slope.update(jnp.zeros_like(error), error), DELTA)


class _Way(NamedTuple):
    """A change of the impulses, its product, the square of that, and the change for each part of what nothing answers to."""

    change: Impulses
    effect: Impulses
    square: Array
    unanswered: Array


class _Search(NamedTuple):
    """State of the iteration.

    Attributes:
      x, residual: impulses and what they leave.
      last: way of the last step.
      unanswered: (world,) how often the impulses hold the way of what nothing answers to.
      going: (world,) whether more steps are to be taken.
      count: () steps.
    """

    x: Impulses
    residual: Impulses
    last: _Way
    unanswered: Array
    going: Array
    count: Array


def _solve(
    way: Callable[[Impulses], Impulses],
    product: Callable[[Impulses], Impulses],
    weights: Impulses,
    right_sides: Impulses,
    like: Array,
) -> Impulses:
    """Solves ``product(x) = right sides`` by steps along the ways of the residuals.

    Each leaves the least residual in the plane of its way and of the one before (P. Vinsome, "Orthomin", 1976): conjugate
    residuals where the product is symmetric by the weights, as it is where nothing slides.
    """

    def dot(a: Impulses, b: Impulses) -> Array:
        terms = (add_all_slices(w * x * y) for w, x, y in zip(weights, a, b, strict=True))
        return compute_once(functools.reduce(jnp.add, terms), like)

    steps = max(STEPS, -(-like.shape[1] // BODIES_A_STEP))
    enough = (NOISE * float(jnp.finfo(like.dtype).eps)) ** 2 * dot(right_sides, right_sides)

    def step(search: _Search) -> _Search:
        x, residual, last, unanswered, going, count = search
        change = compute_once(way(residual), like)
        effect = compute_once(product(change), like)
        share = -dot(effect, last.effect) / last.square
        change = compute_once(_add(change, share, last.change), like)
        effect = compute_once(_add(effect, share, last.effect), like)
        square, along = dot(effect, effect), dot(effect, residual)
        acts = (square > LEAST_EFFECT**2 * dot(change, change)) & (along > 0)
        best = along / jnp.where(acts, square, 1.0)
        falls = going & acts & (best * along > LEAST_FALL * dot(residual, residual))
        length = jnp.where(falls, best, jnp.where(count < steps, 1.0, 0.0))
        residual = compute_once(_add(residual, -length, effect), like)
        held = 1.0 + share * last.unanswered
        last = _Way(change, effect, jnp.where(falls, square, jnp.inf), held)
        going = (falls & (dot(residual, residual) > enough)) | (count + 1 < steps)
        return _Search(_add(x, length, change), residual, last, unanswered + length * held, going, count + 1)

    zero = tuple(jnp.zeros_like(side) for side in right_sides)
    worlds = like.shape[-1]
    never = jnp.zeros(worlds, like.dtype)
    nowhere = _Way(zero, zero, jnp.full(worlds, jnp.inf, like.dtype), never)
    start = _Search(zero, right_sides, nowhere, never, jnp.ones(worlds, bool), jnp.zeros((), jnp.int32))
    found = lax.while_loop(lambda search: (search.count < 3 * steps) & search.going.any(), step, start)
    return _add(found.x, -found.unanswered, way(found.residual))


def _add(a: Impulses, factor: Array, b: Impulses) -> Impulses:
    return tuple(x + factor * y for x, y in zip(a, b, strict=True))


def jacobians_of(law: Law, impulse: Array, error: Array) -> tuple[Array, Array]:
    """Jacobians (turn, row, row', column, world) of a law with respect to the impulse and the error."""
    row_count = impulse.shape[1]

    def column(argument: int, row: int) -> Array:
        basis = jnp.zeros_like(impulse).at[:, row].set(1.0)
        zero = jnp.zeros_like(impulse)
        directions = (basis, zero) if argument == 0 else (zero, basis)
        return jax.jvp(law.update, (impulse, error), directions)[1]

    return tuple(jnp.stack([column(argument, row) for row in range(row_count)], axis=2) for argument in (0, 1))  # type: ignore[return-value]
