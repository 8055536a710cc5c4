"""The constraints of a step solved to round-off: proximal point method outside, semismooth Newton method inside.

Outside, impulses are replaced by those of the stiffened laws (`proximal`), ``P <- law(P, J u + b)``, whose fixed points are
the solutions of the nonlinear complementarity problem of contact with Coulomb friction: not of its convex relaxation.
Inside, the velocity that agrees with such impulses, ``u = u_free + M^-1 J^T law(P, J u + b)``, is found by Newton's method
in the velocities: a linear system of the size of the moving bodies, however many contacts there are, that is regular even
where rows are redundant. A search along the step compares kinetic energies of the residual. The stiffness grows while
all goes well and falls when Newton's method fails.

Impulses are searched as changes of the centre of the proximal term, and velocities by increments. A light body under a heavy
one carries impulses whose round-off alone would move it, so nothing that decides when a world is solved may contain them.
Residuals are velocities, beside the largest one of contacts and, weighed by the root of each row's effective mass, beside
that of the largest energy: the energy alone would let a light body under a heavy one move.

Sources: R. T. Rockafellar, "Augmented Lagrangians and applications of the proximal point algorithm in convex
programming", Math. Oper. Res. 1, 1976; P. Alart and A. Curnier, "A mixed formulation for frictional contact problems prone
to Newton like solution methods", CMAME 92, 1991; J. Carpentier, Q. Le Lidec and L. Montaut, "From compliant to rigid
contact simulation: a unified and efficient approach", RSS 2024 (proximal terms for over-determined contacts).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver import implicit, velocity_system
from mathota_jax.solver.laws import Cone, Push
from mathota_jax.solver.linearised import linearise, with_changes
from mathota_jax.solver.proximal import masses, slope, stiffen
from mathota_jax.solver.row_matrix import Dense
from mathota_jax.solver.rows import Rows, add_impulses, row_velocity
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.spread import add_all_slices, add_slices, largest_slice

LIMIT = 300
"""Largest number of linear systems in a solve. Measured: ten boxes at rest take 1 or 2, a falling pile 20; of 46,080 steps
of a cube under one of 1e5 times its mass in float32, two took more than 150 and none 300."""

NEWTON_LIMIT = 5
"""Newton steps without success after which the problem is made softer."""

TRIALS = 8
"""Step lengths 1, 1/2, 1/4, ... of the search along a Newton step."""

ENOUGH = 0.8
"""Share of the energy of the residual at which a trial is taken at once."""

INEXACT = 0.3
"""Newton's method stops at this share of the residual before it."""

SLOW = 0.5
"""Share of the residual left by an outer step at which the stiffness grows."""

PATIENCE, NEAR_PATIENCE, LONG_PATIENCE, NEAR = 8, 3, 24, 10.0
"""Outer steps in a row without progress on the least residual after which one that is good is accepted, one that is within
so many tolerances, and one that is acceptable. What a world does after that is noise: its velocity drifts from its
impulses, and all others wait. Measured on cold problems of four bodies and 14 contacts in float32: without a limit a tenth
of them search to the end, and momentum is lost by 0.003 m/s (0.19 at a mass ratio of 1e4). So all end within 50 (150), and
0.0004 (0.0006) is lost; four steps everywhere leave ten times the least residual in some. 64 worlds of four tumbling boxes:
19 linear systems a step, 65 before."""

FIRST_STIFFNESS, STIFFNESS_FACTOR, EASY_FACTOR = 10.0, 4.0, 10.0
"""The stiffness grows faster after an outer step that took a single Newton step."""

LARGEST_STIFFNESS = {"float32": 1e6, "float64": 1e9}
"""The linear system loses the mass of a body beside a stiffness near the inverse of round-off."""

MEASURE = 1e3
"""Stiffness of the laws by which velocities are measured: rows that stick count as they move, those that slide as little."""

ROUNDING = 32.0
"""Round-offs by which impulses may differ from those of the laws. Beside a light body they stand for much velocity."""

TOLERANCE = {"float32": 1e-5, "float64": 1e-9}
"""Residual at which a world is done, relative to the largest velocity or constraint error of the unconstrained motion."""

GOOD = {"float32": 1e-3, "float64": 1e-6}
"""Residual at which a world that no longer improves is done too."""

ACCEPTABLE = {"float32": 1e-3, "float64": 1e-4}
"""The same after a longer search; above it the world is flagged. Two points of a rim that stick while one of them sinks onto
the ground contradict each other: their distance would change by the product of the angle between them and the ground and
the speed, 3e-5 of it for a cylinder that settles. Only forces at the limit of friction solve that to round-off."""

Impulses = tuple[Array, ...]


class _Search(NamedTuple):
    """State of the iteration; arrays (world,) but for the first four.

    Attributes:
      velocity: current, equal to that of the impulses ``centre + trial``.
      trial: impulses of the inner iteration, less `centre`.
      centre: impulses that the proximal term pulls to.
      best: impulses with the least residual so far, and their velocity.
      least: that residual.
      residual: after the last outer step.
      stiffness: of the laws.
      newton: Newton steps since the last outer step.
      stalled: outer steps in a row that hardly reduced the least residual.
      done: whether the world is finished.
      count: () iterations.
    """

    velocity: Array
    trial: Impulses
    centre: Impulses
    best: tuple[Array, Impulses]
    least: Array
    residual: Array
    stiffness: Array
    newton: Array
    stalled: Array
    done: Array
    count: Array


class _Trial(NamedTuple):
    """A point on the line of a Newton step, and the energy of its residual."""

    step: Array
    velocity: Array
    trial: Impulses
    impulses: Impulses
    error: Impulses
    change: Array
    energy: Array


@jax.custom_jvp
def solve(rows: tuple[Rows, ...], velocity: Array, impulses: Impulses) -> tuple[Array, Impulses, Array]:
    """Solves all rows together.

    Args:
      rows: groups of rows.
      velocity: (component, block, world) without any constraint impulse.
      impulses: for each group (turn, row, column, world), the impulses to start from.

    Returns:
      The velocity with the impulses, the impulses, and (world,) 1 where they are not the solution, else 0. Derivatives
      are those of the solution, by the implicit function theorem; redundant rows do not disturb those of the velocity.
    """
    worlds = velocity.shape[-1]
    if not rows:
        return velocity, impulses, jnp.zeros(worlds, velocity.dtype)
    problem = _Problem(rows, velocity)
    impulses = tuple(jnp.broadcast_to(part, (*part.shape[:-1], worlds)) for part in impulses)
    start = add_impulses(rows, velocity, impulses)
    residual = jnp.broadcast_to(problem.residual(impulses, problem.errors(start)), (worlds,))
    search = _Search(
        start,
        tuple(jnp.zeros_like(part) for part in impulses),
        impulses,
        (start, impulses),
        residual,
        residual,
        jnp.full(worlds, FIRST_STIFFNESS, velocity.dtype),
        jnp.zeros(worlds, jnp.int32),
        jnp.zeros(worlds, jnp.int32),
        residual <= problem.tolerance,
        jnp.zeros((), jnp.int32),
    )
    search = lax.while_loop(lambda s: (s.count < LIMIT) & ~s.done.all(), problem.iterate, search)
    failed = jnp.where(search.least <= problem.acceptable, 0.0, 1.0).astype(velocity.dtype)
    velocity, impulses = search.best
    # What a large impulse lost on its way to a small one is round-off of the large one.
    impulses = tuple(group.law.project(part) for group, part in zip(rows, impulses, strict=True))
    return velocity, impulses, failed


class _Problem:
    """One solve: rows, unconstrained velocity, and the scale of residuals."""

    def __init__(self, rows: tuple[Rows, ...], free: Array) -> None:
        self.rows, self.free = rows, free
        none = tuple(jnp.zeros_like(group.bias) for group in rows)
        sizes = [
            dataclasses.replace(group, matrix=Dense(tuple(jnp.abs(j) for j in group.jacobian), group.response))
            for group in rows
        ]
        violations = [
            safe_divide(jnp.abs(group.law.change(old, error)), jnp.broadcast_to(masses(group.law), old.shape))
            for group, old, error in zip(rows, none, self.errors(free), strict=True)
        ]
        speeds = [row_velocity(size, jnp.abs(free)) + part for size, part in zip(sizes, violations, strict=True)]
        self.weights = compute_once(_weights(rows, speeds, free), free)
        precision = str(free.dtype)
        self.tolerance, self.good, self.acceptable = TOLERANCE[precision], GOOD[precision], ACCEPTABLE[precision]

    def errors(self, velocity: Array) -> Impulses:
        """Constraint errors of all rows."""
        return compute_once(tuple(group.bias + row_velocity(group, velocity) for group in self.rows), self.free)

    def residual(self, impulses: Impulses, errors: Impulses) -> Array:
        """Largest distance (world,) of impulses from those that the laws ask for."""
        parts = []
        rounding = ROUNDING * float(jnp.finfo(self.free.dtype).eps)
        for group, old, error, weight in zip(self.rows, impulses, errors, self.weights, strict=True):
            law = stiffen(group.law, jnp.full(1, MEASURE, error.dtype))
            moves = safe_divide(jnp.abs(law.change(old, error)), jnp.broadcast_to(masses(law), old.shape))
            wrong = jnp.abs(group.law.change(old, error)) - rounding * jnp.abs(old).max(1, keepdims=True)
            lacks = safe_divide(jnp.maximum(wrong, 0.0), jnp.broadcast_to(masses(group.law), old.shape))
            parts.append(weight * jnp.maximum(moves, lacks))
        return _largest(parts, self.free)

    def project(self, stiffness: Array, centre: Impulses, errors: Impulses) -> Impulses:
        """Impulses of the stiffened laws, less `centre`."""
        impulses = tuple(
            stiffen(group.law, stiffness).change(old, error)
            for group, old, error in zip(self.rows, centre, errors, strict=True)
        )
        return compute_once(impulses, self.free)

    def iterate(self, search: _Search) -> _Search:
        """One Newton step; where that has solved the inner problem, the outer step as well."""
        errors = self.errors(search.velocity)
        impulses = self.project(search.stiffness, search.centre, errors)
        slopes = tuple(
            slope(stiffen(group.law, search.stiffness), old, error)
            for group, old, error in zip(self.rows, search.centre, errors, strict=True)
        )
        slopes = compute_once(slopes, self.free)
        change, energy = self.mismatch(search.trial, impulses)
        direction = -velocity_system.solve_once(self.rows, slopes, change)
        found = self.line_search(search, errors, impulses, slopes, direction, energy)

        new_centre = tuple(old + change for old, change in zip(search.centre, found.impulses, strict=True))
        kept = tuple(t - (new - old) for t, new, old in zip(found.trial, new_centre, search.centre, strict=True))
        mismatch = (w * jnp.abs(row_velocity(g, found.change)) for w, g in zip(self.weights, self.rows, strict=True))
        inner = _largest(mismatch, self.free)
        residual = jnp.maximum(inner, self.residual(new_centre, found.error))
        gives_up = search.newton >= NEWTON_LIMIT
        outer = gives_up | (inner <= INEXACT * search.residual) | (inner <= self.tolerance)
        slow = outer & (residual > SLOW * search.residual)
        harder = outer & ~gives_up & (slow | (search.newton == 0))
        factor = jnp.where(search.newton == 0, EASY_FACTOR, STIFFNESS_FACTOR)
        stiffness = jnp.where(harder, search.stiffness * factor, search.stiffness)
        stiffness = jnp.where(gives_up, search.stiffness / STIFFNESS_FACTOR, stiffness)
        stalled = jnp.where(residual > SLOW * search.least, search.stalled + 1, 0)
        stalled = jnp.where(outer, stalled, search.stalled)
        patience = jnp.where(search.least <= self.good, PATIENCE, LONG_PATIENCE)
        patience = jnp.where(search.least <= NEAR * self.tolerance, NEAR_PATIENCE, patience)
        better = residual < search.least
        new = _Search(
            velocity=found.velocity,
            trial=_where(outer, kept, found.trial),
            centre=_where(outer, new_centre, search.centre),
            best=_where(better, (found.velocity - found.change, new_centre), search.best),
            least=jnp.where(better, residual, search.least),
            residual=jnp.where(outer, residual, search.residual),
            stiffness=jnp.clip(stiffness, 1.0, LARGEST_STIFFNESS[str(self.free.dtype)]),
            newton=jnp.where(outer, 0, search.newton + 1),
            stalled=stalled,
            done=(residual <= self.tolerance) | ((stalled >= patience) & (search.least <= self.acceptable)),
            count=search.count + 1,
        )
        chosen = jax.tree.map(
            lambda a, b: jnp.where(search.done, a, b), search._replace(count=()), new._replace(count=())
        )
        return chosen._replace(done=search.done | new.done, count=new.count)

    def mismatch(self, trial: Impulses, impulses: Impulses) -> tuple[Array, Array]:
        """Velocity change from the one impulses to the others, and its kinetic energy, times 2."""
        difference = tuple(a - b for a, b in zip(trial, impulses, strict=True))
        change = compute_once(add_impulses(self.rows, jnp.zeros_like(self.free), difference), self.free)
        energy = [
            add_all_slices(part * row_velocity(group, change))
            for part, group in zip(difference, self.rows, strict=True)
        ]
        return change, compute_once(functools.reduce(jnp.add, energy), self.free)

    def line_search(
        self,
        search: _Search,
        errors: Impulses,
        impulses: Impulses,
        slopes: Impulses,
        direction: Array,
        energy: Array,
    ) -> _Trial:
        """Halves the Newton step until the residual falls; the best of all trials if it does not."""
        rates = compute_once(tuple(row_velocity(group, direction) for group in self.rows), self.free)
        toward = tuple(
            part - old + add_slices(matrix * rate[:, None], 2)
            for part, old, matrix, rate in zip(impulses, search.trial, slopes, rates, strict=True)
        )
        toward = compute_once(toward, self.free)
        # The step that these impulses make: by that of the linear system its round-off would part velocity and impulses.
        direction = compute_once(add_impulses(self.rows, jnp.zeros_like(self.free), toward), self.free)
        rates = compute_once(tuple(row_velocity(group, direction) for group in self.rows), self.free)

        def at(step: Array) -> _Trial:
            trial = tuple(old + step * change for old, change in zip(search.trial, toward, strict=True))
            there = tuple(error + step * rate for error, rate in zip(errors, rates, strict=True))
            projected = self.project(search.stiffness, search.centre, there)
            change, left = self.mismatch(trial, projected)
            return _Trial(step, search.velocity + step * direction, trial, projected, there, change, left)

        def body(carry: tuple[Array, Array, _Trial]) -> tuple[Array, Array, _Trial]:
            count, step, best = carry
            new = at(0.5 * step)
            wanted = (new.energy < best.energy) & (best.energy > ENOUGH * energy)
            return count + 1, new.step, _where(wanted, new, best)

        def unfinished(carry: tuple[Array, Array, _Trial]) -> Array:
            count, _, best = carry
            return (count < TRIALS) & (~search.done & (best.energy > ENOUGH * energy)).any()

        first = at(jnp.ones_like(energy))
        return lax.while_loop(unfinished, body, (jnp.ones((), jnp.int32), first.step, first))[2]


def _where(condition: Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _weights(rows: tuple[Rows, ...], speeds: list[Array], like: Array) -> tuple[Array, ...]:
    """What a velocity of each row counts in residuals, from the largest ones of the unconstrained motion.

    Rows of contacts are all in m/s. Those of joints may be in rad/s, which energies alone compare with others.
    """
    roots = [jnp.sqrt(masses(group.law)) for group in rows]
    energy = _inverse(_largest((root * speed for root, speed in zip(roots, speeds, strict=True)), like))
    weights = [root * energy for root in roots]
    contacts = [k for k, group in enumerate(rows) if isinstance(group.law, Cone | Push)]
    if contacts:
        speed = _inverse(_largest((jnp.where(roots[k] > 0, speeds[k], 0.0) for k in contacts), like))
        for k in contacts:
            weights[k] = jnp.where(roots[k] > 0, jnp.maximum(weights[k], speed), 0.0)
    return tuple(weights)


def _inverse(scale: Array) -> Array:
    """Inverse of a scale of residuals: of 1 where nothing moves, since old impulses may be wrong there."""
    return 1.0 / jnp.where(scale > 1e-30, scale, 1.0)


def _largest(values: Iterable[Array], like: Array) -> Array:
    """Maximum over rows, (world,)."""
    return compute_once(functools.reduce(jnp.maximum, [largest_slice(value) for value in values]), like)


@solve.defjvp
def _solve_jvp(primals: tuple, tangents: tuple) -> tuple:
    rows, velocity, impulses = primals
    d_rows, d_velocity, _ = tangents
    velocity, impulses, failed = solve(rows, velocity, impulses)
    if not rows:
        return (velocity, impulses, failed), (d_velocity, impulses, jnp.zeros_like(failed))
    d_velocity, slopes, right_sides = linearise(rows, d_rows, velocity, impulses, d_velocity)
    d_impulses = implicit.solve(rows, slopes, right_sides)
    d_velocity = with_changes(rows, (velocity, impulses), (d_velocity, d_impulses))
    return (velocity, impulses, failed), (d_velocity, d_impulses, jnp.zeros_like(failed))
