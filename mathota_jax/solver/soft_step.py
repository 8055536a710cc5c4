"""Small steps with soft corrections: the "Soft Step" scheme on rows of any kind.

A step has one collision pass and n substeps. In each of them the velocity is kicked, every row is swept once with a soft
bias that takes out a share of the position error, the bodies drift at that velocity, and a second sweep without the bias
*relaxes* the rows, so that the push-out velocity does not stay (E. Catto, "Solver2D", box2d.org, 2024; Box2D v3).

What differs from there, and why:

* A substep is kick, drift, kick: half of the forces and half of the impulses act before the drift, half after it. Free
  flight and a slide under constant friction are exact parabolas, whatever the substep, and a load sinks half as far.
* Bodies are not moved between the substeps. Rows see the displacement summed so far, times their Jacobian: exact for a
  rolling sphere, where anchors fixed in the body would lift off, and right to second order in the turn of a step elsewhere.
* The stiffness is not capped at 30 Hz: a load sinks by ``load / (2 effective mass * frequency^2)``, so that a cap would
  keep the error from falling with the substep.
* The points of a manifold are solved together (a sequence would tilt a stack), and every sweep over-relaxes. Ten boxes
  bounce for ever with the bounded step of `Cone` and come to rest exactly with this one.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver import pgs
from mathota_jax.solver.laws import Bounded, Cone
from mathota_jax.solver.pgs import Rows
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.struct import pytree

PHASE = 2.0 * math.pi / 4.0
"""Frequency of the correction times the substep: a quarter of the substep rate, the stiffest that one sweep follows."""

DAMPING_RATIO = 10.0
"""Of the correction. Far overdamped, since sweeps that have not converged act like an elastic chain (Catto's value)."""

SHARE = PHASE / (2.0 * DAMPING_RATIO + PHASE)
"""Share of a position error that is corrected in one substep."""

HARDNESS = PHASE * (2.0 * DAMPING_RATIO + PHASE)
"""Response of a row to its own impulse, divided by its softness."""

OVER_RELAXATION = 1.4
"""Of joints, and of contacts that carried something before; an impact gets its exact step. Measured on a chain of 10 to 40
loads: at 1 it sloshes for seconds, from 1.3 to 1.5 it comes to rest within one, at 1.7 it diverges."""

MANIFOLD_PASSES = 3
"""Projected passes over the points of a manifold in one turn; for a box on its face they leave 4 % of the error."""


@pytree
class PositionError:
    """Position errors of the first row of each constraint of a group, (turn, 1, column, world).

    Attributes:
      start: at the start of the step; of a one-sided row it is a gap, negative where there is overlap.
      limit: largest velocity of a correction; 0 for a row without a position error, which the first sweep leaves alone.
      one_sided: whether the row only pushes, (turn, 1, column, 1), or of size 1.
      lever: time [s] that the impulse of a bounce has to act on the position; None for joints.
      curvature: what the turning of the Jacobian adds to ``J v`` in half a step; None where it does not turn.
    """

    start: Array
    limit: Array
    one_sided: Array
    lever: Array | None = None
    curvature: Array | None = None


@pytree
class Manifold:
    """Law of contacts in one sweep: `base` with normals solved together, soft, over-relaxed.

    Attributes:
      base: effective masses and friction.
      coupling: (turn, point, column, world) normal response of a column to its neighbours' impulses.
      softness: (turn, column, world) of the normal rows; None for rigid ones.
      lasting: (turn, column, world) contacts to over-relax; None for none.
    """

    base: Cone | Bounded
    coupling: Array
    softness: Array | None
    lasting: Array | None

    def update(self, impulse: Array, error: Array) -> Array:
        """Normals of a manifold by projected passes, then friction."""
        mass = self.base.normal_mass if isinstance(self.base, Cone) else self.base.effective_mass[0]
        old, error_normal = impulse[0], error[0]
        if self.softness is not None:
            mass = mass / (1.0 + mass * self.softness)
        new = old
        for number in range(MANIFOLD_PASSES if self.coupling.shape[0] > 1 else 1):
            residual = error_normal + self._respond(new - old) if number else error_normal
            if self.softness is not None:
                residual = residual + self.softness * new
            new = jnp.maximum(new - mass * residual, 0.0)
        if self.lasting is not None:
            new = jnp.maximum(old + jnp.where(self.lasting, OVER_RELAXATION, 1.0) * (new - old), 0.0)
        if isinstance(self.base, Cone):
            base = self.base
            if self.coupling.shape[0] > 1:
                # The bounded step of several points, lengthened to just below the limit of stability.
                base = dataclasses.replace(base, tangent_mass=base.tangent_mass * OVER_RELAXATION)
            return base.with_friction(new, (impulse[1], impulse[2]), (error[1], error[2]))
        return new[None]

    def _respond(self, change: Array) -> Array:
        """Change of the normal velocities of the columns by changes of their impulses, manifold by manifold."""
        points = self.coupling.shape[0]
        by_point = change.reshape(-1, points, change.shape[-1])
        parts = [
            row.reshape(by_point.shape) * by_point[:, point : point + 1] for point, row in enumerate(self.coupling)
        ]
        return functools.reduce(jnp.add, parts).reshape(change.shape)


def solve(
    substeps: int,
    rebound_sweeps: int,
    rows: tuple[Rows, ...],
    errors: tuple[PositionError, ...],
    velocity: Array,
    free: Array,
    impulses: tuple[Array, ...],
    dt: Array,
) -> tuple[Array, Array, tuple[Array, ...]]:
    """Runs the substeps of one step. Derivatives are those of the map itself, through every sweep.

    Args:
      substeps: their number.
      rebound_sweeps: sweeps of the restitution pass after the last substep; 0 for none.
      rows: groups of rows, swept in this order.
      errors: position errors of each group.
      velocity: (component, block, world) at the start of the step.
      free: the same at its end if nothing constrained it.
      impulses: for each group (turn, row, column, world), those of one substep to start from.
      dt: length of the step.

    Returns:
      What the impulses add to the velocity at the end of the step and to the displacement (component, block, world), and
      the impulses of the whole step.
    """
    length = dt / substeps
    couplings = tuple(
        None if error.lever is None else _coupling(group) for group, error in zip(rows, errors, strict=True)
    )
    begin = tuple(pgs.row_velocity(group, velocity) for group in rows)
    gain = tuple(pgs.row_velocity(group, free - velocity) / dt for group in rows)
    added = pgs.add_impulses(rows, jnp.zeros_like(velocity), impulses)

    def substep(carry: tuple, number: Array) -> tuple[tuple, None]:
        """Carries what the impulses added to velocity and displacement: free bodies keep to their path exactly."""
        velocity, change, displacement, impulses, total = carry
        start, half = velocity, 0.5 * change
        time, middle, end = number * length, (number + 0.5) * length, (number + 1.0) * length
        halves = tuple(0.5 * impulse for impulse in impulses)
        biases, laws = [], []
        lasting = tuple(impulse[:, 0] > 0 for impulse in impulses)
        for group, error, coupling, rate, acceleration, before in zip(
            rows, errors, couplings, begin, gain, lasting, strict=True
        ):
            path = time * (rate + (0.5 * time) * acceleration)[:, :1]
            correction = _correction(group, error, path, displacement, time, length, dt)
            biases.append(correction + rate + middle * acceleration)
            laws.append(_soft_law(group, error, coupling, before))
        velocity, impulses = _sweep(1, rows, tuple(laws), tuple(biases), velocity + half, halves)
        displacement = displacement + length * velocity
        impulses = tuple(first + second for first, second in zip(impulses, halves, strict=True))
        biases, laws = [], []
        for group, error, coupling, rate, acceleration, impulse, before in zip(
            rows, errors, couplings, begin, gain, impulses, lasting, strict=True
        ):
            biases.append(_drift(group, error, end, dt) + rate + end * acceleration)
            laws.append(_rigid_law(group, coupling, impulse[:, :1] > 0, before))
        velocity, impulses = _sweep(1, rows, tuple(laws), tuple(biases), velocity + half, impulses)
        total = tuple(before + impulse for before, impulse in zip(total, impulses, strict=True))
        # What the impulses changed in this substep is what they would change in the next one.
        return (velocity, velocity - start, displacement, impulses, total), None

    zero, none = jnp.zeros_like(velocity), tuple(jnp.zeros_like(impulse) for impulse in impulses)
    carry = (zero, added, zero, impulses, none)
    carry, _ = lax.scan(substep, carry, jnp.arange(substeps, dtype=velocity.dtype))
    velocity, _, displacement, impulses, total = carry
    if not rebound_sweeps:
        return velocity, displacement, total
    biases = [
        _drift(group, error, dt, dt) + rate + dt * acceleration
        for group, error, rate, acceleration in zip(rows, errors, begin, gain, strict=True)
    ]
    return _rebound(rebound_sweeps, rows, couplings, errors, biases, velocity, displacement, impulses, total)


def _rebound(
    count: int,
    rows: tuple[Rows, ...],
    couplings: tuple[Array | None, ...],
    errors: tuple[PositionError, ...],
    biases: list[Array],
    velocity: Array,
    displacement: Array,
    impulses: tuple[Array, ...],
    total: tuple[Array, ...],
) -> tuple[Array, Array, tuple[Array, ...]]:
    """Restitution: contacts that met in this step get the velocity away from each other that their rows ask for.

    The impulse acts since the time of the impact. So does the answer of the rows that do not bounce themselves, which is
    exact for one impact in a step and an approximation for several at different times.
    """
    laws, wanted, levers = [], [], []
    for group, coupling, error, bias, impulse, sum_ in zip(
        rows, couplings, errors, biases, impulses, total, strict=True
    ):
        bounces, lever = jnp.zeros_like(impulse[:, :1], bool), jnp.zeros_like(impulse[:, :1])
        if error.lever is not None:
            bounces = (sum_[:, :1] > 0) & (group.bias[:, :1] < 0)
            bias = bias + jnp.where(bounces, group.bias, 0.0)
            lever = jnp.where(bounces, error.lever, 0.0)
        laws.append(_rigid_law(group, coupling, (impulse[:, :1] > 0) | bounces, None))
        wanted.append(bias)
        levers.append((bounces, lever))
    longest = functools.reduce(jnp.maximum, [lever.max((0, 1, 2)) for _, lever in levers])
    velocity, new = _sweep(count, rows, tuple(laws), tuple(wanted), velocity, impulses)
    changes = tuple(after - before for after, before in zip(new, impulses, strict=True))
    moves = tuple(
        change * jnp.where(bounces, lever, longest) for change, (bounces, lever) in zip(changes, levers, strict=True)
    )
    displacement = pgs.add_impulses(rows, displacement, moves)
    return velocity, displacement, tuple(sum_ + change for sum_, change in zip(total, changes, strict=True))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _sweep(
    count: int,
    rows: tuple[Rows, ...],
    laws: tuple[Any, ...],
    biases: tuple[Array, ...],
    velocity: Array,
    impulses: tuple[Array, ...],
) -> tuple[Array, tuple[Array, ...]]:
    def update(law: Any, impulse: Array, error: Array) -> Array:
        return law.update(impulse, error)

    return pgs.sweeps(count, rows, update, laws, biases, velocity, impulses)


@_sweep.defjvp
def _sweep_jvp(count: int, primals: tuple, tangents: tuple) -> tuple:
    """A loop over the turns in use has no reverse mode; a loop over all turns, which does the same, has."""

    def sweep_all_turns(rows: tuple[Rows, ...], *others: Any) -> tuple[Array, tuple[Array, ...]]:
        everywhere = tuple(
            group
            if group.places is None
            else dataclasses.replace(group, places=dataclasses.replace(group.places, turns=None))
            for group in rows
        )
        return _sweep.fun(count, everywhere, *others)

    return jax.jvp(sweep_all_turns, primals, tangents)


def _coupling(group: Rows) -> Array:
    """(turn, point, column, world) response of the normal of each column to the points of its own manifold."""
    points = group.table.together

    def block(jacobian: Array, response: Array) -> Array:
        turns, components, columns, worlds = jacobian.shape
        shape = (turns, components, columns // points, points, worlds)
        left, right = jacobian.reshape(shape), response.reshape(shape)
        terms = [
            functools.reduce(
                jnp.add, [unstack(left, 1)[c] * unstack(right, 1)[c][:, :, p : p + 1] for c in range(components)]
            )
            for p in range(points)
        ]
        return jnp.stack(terms, axis=1).reshape(turns, points, columns, worlds)

    sides = zip(group.jacobian, group.response, strict=True)
    return functools.reduce(jnp.add, [block(jacobian[:, 0], response[:, 0]) for jacobian, response in sides])


def _soft_law(group: Rows, error: PositionError, coupling: Array | None, lasting: Array) -> Any:
    if coupling is not None:
        points = group.table.together
        own = coupling.reshape(*coupling.shape[:2], -1, points, coupling.shape[-1])
        own = jnp.stack([own[:, p, :, p] for p in range(points)], axis=2)
        return Manifold(group.law, coupling, own.reshape(coupling.shape[0], *coupling.shape[2:]) / HARDNESS, lasting)
    law = group.law
    assert isinstance(law, Bounded)
    own = safe_divide(jnp.ones_like(law.effective_mass), law.effective_mass) - law.softness
    softness = own / HARDNESS
    mass = jnp.where(error.limit > 0, OVER_RELAXATION * safe_divide(jnp.ones_like(own), own + softness), 0.0)
    return dataclasses.replace(law, softness=softness, effective_mass=mass)


def _rigid_law(group: Rows, coupling: Array | None, carries: Array, lasting: Array | None) -> Any:
    """Rows that only push and carry nothing stay open: what is still apart must not be stopped."""
    law = group.law
    if isinstance(law, Cone):
        assert coupling is not None
        closed = jnp.where(carries[:, 0], law.normal_mass, 0.0)
        return Manifold(dataclasses.replace(law, normal_mass=closed), coupling, None, lasting)
    law = dataclasses.replace(law, effective_mass=jnp.where(carries | (law.lower < 0), law.effective_mass, 0.0))
    if coupling is not None:
        return Manifold(law, coupling, None, lasting)
    return dataclasses.replace(law, effective_mass=OVER_RELAXATION * law.effective_mass)


def _correction(
    group: Rows, error: PositionError, path: Array, displacement: Array, time: Array, length: Array, dt: Array
) -> Array:
    """Bias of the first sweep: closes gaps at most, and takes out a share of an overlap; `path` is that of free motion."""
    first = dataclasses.replace(group, jacobian=tuple(side[:, :1] for side in group.jacobian))
    now = error.start + path + pgs.row_velocity(first, displacement)
    if error.curvature is not None:
        now = now + error.curvature * (time * (time / dt - 1.0))
    speed = jnp.clip(now * (SHARE / length), -error.limit, error.limit)
    speed = jnp.where(error.one_sided & (now > 0), now / length, speed)
    if error.curvature is not None:
        speed = speed + error.curvature * ((2.0 * time + length) / dt - 1.0)
    return jnp.concatenate([speed, jnp.zeros_like(group.bias[:, 1:])], axis=1)


def _drift(group: Rows, error: PositionError, time: Array, dt: Array) -> Array:
    """Bias of the relaxing sweep: none but that of a turning Jacobian, linear in time about the middle of the step."""
    if error.curvature is None:
        return jnp.zeros_like(group.bias)
    return error.curvature * (2.0 * time / dt - 1.0)
