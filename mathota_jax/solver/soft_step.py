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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.solver import pgs
from mathota_jax.solver.coupling import point_responses
from mathota_jax.solver.laws import Bounded, Cone
from mathota_jax.solver.rows import Rows, add_impulses, first_row_velocity, row_velocity, visiting_all_turns
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import settle
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
"""Of joints, and of stops that carried something before; an impact gets its exact step. Measured on 10 to 40
loads: at 1 it sloshes for seconds, from 1.3 to 1.5 it comes to rest within one, at 1.7 it diverges."""

CONTACT_OVER_RELAXATION = 1.5
"""Likewise of contacts. With 1.4 a wall of 210 cubes sways out of its plane four times as far; with 1.5 chains open more."""

FIRST_GRIP = 1.6
"""Factor on the tangential step of contacts that carried nothing before. The step of a manifold is bounded for its points
pushing and turning against one another, and takes half of a common slide: a slab put on a slope slips by 0.14 mm before it
holds, with 1.3 by 0.11, with 1.6 by 0.09."""

MANIFOLD_PASSES = 3
"""Projected passes over the points of a manifold in one turn; for a box on its face they leave 4 % of the error."""


@pytree
class ForceLaws:
    """Rows of a group that obey a law of force: springs, dampers, friction, motors.

    Their bias is that of a substep at the start of the step; bounds and softness are those of a substep, too.

    Attributes:
      acts: (turn, 1, column, 1) whether the row is one of them.
      by_error, by_rate: (turn, 1, column, world) derivatives of the bias, which is linear in both.
    """

    acts: Array
    by_error: Array
    by_rate: Array


@pytree
class PositionError:
    """Position errors of the first row of each constraint of a group, (turn, 1, column, world).

    Attributes:
      start: at the start of the step; of a one-sided row it is a gap, negative where there is overlap.
      limit: largest velocity of a correction.
      one_sided: whether the row only pushes, (turn, 1, column, 1), or of size 1; None where all rows also pull.
      lever: time [s] that the impulse of a bounce has to act on the position; None for joints.
      curvature: what the turning of the Jacobian adds to ``J v`` in half a step; None where it does not turn.
      force: rows that obey a law of force instead; None without any.
    """

    start: Array
    limit: Array
    one_sided: Array | None
    lever: Array | None = None
    curvature: Array | None = None
    force: ForceLaws | None = None


class Impulses(NamedTuple):
    """For each group of rows (turn, row, column, world): impulses of the whole step, and of its last substep alone.

    Those of a restitution pass belong to the first, not to the second: they do not come again.
    """

    total: tuple[Array, ...]
    last: tuple[Array, ...]


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
            new = jnp.maximum(old + jnp.where(self.lasting, CONTACT_OVER_RELAXATION, 1.0) * (new - old), 0.0)
        if not isinstance(self.base, Cone):
            return new[None]
        base = self.base
        if self.lasting is not None:
            longer = base.tangent_mass * jnp.where(self.lasting, 1.0, FIRST_GRIP)
            base = dataclasses.replace(base, tangent_mass=longer)
        return base.with_friction(new, (impulse[1], impulse[2]), (error[1], error[2]))

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
    damping: tuple[float, float] = (0.0, 0.0),
) -> tuple[Array, Array, Impulses]:
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
      damping: rates [1/s] at which linear and angular velocities decay, in `free` already.

    Returns:
      What the impulses add to the velocity at the end of the step and to the displacement (component, block, world), and
      the impulses.
    """
    if not rows:
        return jnp.zeros_like(free), jnp.zeros_like(free), Impulses(impulses, impulses)
    length = dt / substeps
    groups = tuple(
        _Group(
            group,
            error,
            None if error.lever is None else _coupling(group),
            row_velocity(group, velocity),
            row_velocity(group, free - velocity) / dt,
        )
        for group, error in zip(rows, errors, strict=True)
    )

    decay = _decay(damping, 0.5 * length, velocity)

    def substep(carry: tuple, number: Array) -> tuple[tuple, None]:
        """Carries what the impulses added to velocity and displacement: free bodies keep to their path exactly."""
        velocity, change, displacement, impulses, total, _ = carry
        velocity, half = velocity * decay, 0.5 * change
        start = velocity * decay
        time, middle, end = number * length, (number + 0.5) * length, (number + 1.0) * length
        halves = tuple(0.5 * impulse for impulse in impulses)
        lasting = tuple(impulse[:, 0] > 0 for impulse in impulses)
        wanted = tuple(_law_bias(group, velocity, displacement, time, dt) for group in groups)
        present = tuple(group.error.start + _moved(group, displacement, time, dt) for group in groups)
        apart = tuple(_apart(group, error) for group, error in zip(groups, present, strict=True))
        laws = tuple(_soft_law(*arguments) for arguments in zip(groups, lasting, apart, strict=True))
        biases = tuple(
            _correction(group, law_bias, error, gap, velocity, time, length, dt) + group.free_rate(middle)
            for group, law_bias, error, gap in zip(groups, wanted, present, apart, strict=True)
        )
        velocity, impulses = _sweep(1, rows, laws, biases, velocity + half, halves)
        displacement = displacement + length * velocity
        velocity = velocity * decay
        impulses = tuple(first + second for first, second in zip(impulses, halves, strict=True))
        laws = tuple(
            _rigid_law(group, impulse[:, :1] > 0, before)
            for group, impulse, before in zip(groups, impulses, lasting, strict=True)
        )
        biases = _end_biases(groups, wanted, end, dt)
        velocity, impulses = _sweep(1, rows, laws, biases, velocity + half, impulses)
        total = tuple(before + impulse for before, impulse in zip(total, impulses, strict=True))
        # What the impulses changed in this substep is what they would change in the next one.
        return (velocity, velocity - start, displacement, impulses, total, wanted), None

    zero, none = jnp.zeros_like(velocity), tuple(jnp.zeros_like(impulse) for impulse in impulses)
    added = add_impulses(rows, zero, impulses)
    wanted = tuple(_law_bias(group, zero, zero, jnp.zeros_like(dt), dt) for group in groups)
    carry = (zero, added, zero, impulses, none, wanted)
    # In reverse mode a substep is computed again: only what it starts from is stored.
    carry, _ = lax.scan(jax.checkpoint(substep, prevent_cse=False), carry, jnp.arange(substeps, dtype=velocity.dtype))
    velocity, _, displacement, impulses, total, wanted = carry
    if not rebound_sweeps:
        return velocity, displacement, Impulses(total, impulses)
    biases = _end_biases(groups, wanted, dt, dt)
    return _rebound(rebound_sweeps, groups, biases, velocity, displacement, impulses, total)


def _decay(damping: tuple[float, float], time: Array, velocity: Array) -> Array | float:
    """Factor (component, 1, world) or 1 on what the impulses added to the velocity.

    `velocity` without them is damped as if they were not there: a body stopped from 180 m/s would leave again.
    """
    if not any(damping):
        return 1.0
    rates = np.repeat(damping, 3)[: len(velocity), None, None]
    return jnp.maximum(1.0 - jnp.asarray(rates, velocity.dtype) * time, 0.0)


class _Group(NamedTuple):
    """Rows with their errors, the coupling of their manifolds (None for joints), and their motion without impulses.

    Attributes:
      begin, acceleration: (turn, row, column, world) rate at the start of the step and its change per time.
    """

    rows: Rows
    error: PositionError
    coupling: Array | None
    begin: Array
    acceleration: Array

    def free_rate(self, time: Array) -> Array:
        return self.begin + time * self.acceleration


def _rebound(
    count: int,
    groups: tuple[_Group, ...],
    biases: tuple[Array, ...],
    velocity: Array,
    displacement: Array,
    impulses: tuple[Array, ...],
    total: tuple[Array, ...],
) -> tuple[Array, Array, Impulses]:
    """Restitution: contacts that met in this step get the velocity away from each other that their rows ask for.

    The impulse acts since the time of the impact. So does the answer of the rows that do not bounce themselves, which is
    exact for one impact in a step and an approximation for several at different times.
    """
    rows = tuple(group.rows for group in groups)
    laws, wanted, levers = [], [], []
    for group, bias, impulse, sum_ in zip(groups, biases, impulses, total, strict=True):
        bounces, lever = jnp.zeros_like(impulse[:, :1], bool), jnp.zeros_like(impulse[:, :1])
        if group.error.lever is not None:
            asked = group.rows.bias[:, :1]
            bounces = (sum_[:, :1] > 0) & (asked < 0)
            bias = bias + jnp.where(bounces, group.rows.bias, 0.0)
            lever = jnp.where(bounces, group.error.lever, 0.0)
        laws.append(_rigid_law(group, (impulse[:, :1] > 0) | bounces, None))
        wanted.append(bias)
        levers.append((bounces, lever))
    longest = functools.reduce(jnp.maximum, [lever.max((0, 1, 2)) for _, lever in levers])
    velocity, new = _sweep(count, rows, tuple(laws), tuple(wanted), velocity, impulses)
    changes = tuple(after - before for after, before in zip(new, impulses, strict=True))
    moves = tuple(
        change * jnp.where(bounces, lever, longest) for change, (bounces, lever) in zip(changes, levers, strict=True)
    )
    displacement = add_impulses(rows, displacement, moves)
    return velocity, displacement, Impulses(tuple(a + b for a, b in zip(total, changes, strict=True)), impulses)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _sweep(
    count: int,
    rows: tuple[Rows, ...],
    laws: tuple[Any, ...],
    biases: tuple[Array, ...],
    velocity: Array,
    impulses: tuple[Array, ...],
) -> tuple[Array, tuple[Array, ...]]:
    def update(_: Array | int, law: Any, __: Array, impulse: Array, error: Array) -> Array:
        return law.update(impulse, error)

    return pgs.sweeps(count, rows, update, laws, biases, velocity, impulses)


@_sweep.defjvp
def _sweep_jvp(count: int, primals: tuple, tangents: tuple) -> tuple:
    """A loop over the turns in use has no reverse mode; a loop over all turns, which does the same, has."""

    def sweep_all_turns(rows: tuple[Rows, ...], *others: Any) -> tuple[Array, tuple[Array, ...]]:
        return _sweep.fun(count, visiting_all_turns(rows), *others)

    return jax.jvp(sweep_all_turns, primals, tangents)


def _coupling(group: Rows) -> Array:
    """(turn, point, column, world) response of the normal of each column to the points of its own manifold."""
    turns, _, columns, worlds = group.bias.shape
    jacobian, response = ([unstack(side[:, 0], 1) for side in sides] for sides in (group.jacobian, group.response))
    of_points = point_responses(jacobian, response, group.table.together)
    return jnp.moveaxis(of_points, 3, 1).reshape(turns, -1, columns, worlds)


def _apart(group: _Group, present: Array) -> Array | None:
    """Whether rows that only push are open now; None where all rows also pull."""
    if group.error.one_sided is None:
        return None
    return settle(jnp.where(group.error.one_sided & (present > 0), 1.0, 0.0)) > 0.5


def _soft_law(group: _Group, lasting: Array, apart: Array | None) -> Any:
    """Law of the first sweep, in which half of the impulse of a substep acts; gaps close to the surface exactly."""
    coupling, law, force = group.coupling, group.rows.law, group.error.force
    if coupling is not None:
        points = group.rows.table.together
        own = coupling.reshape(*coupling.shape[:2], -1, points, coupling.shape[-1])
        own = jnp.stack([own[:, p, :, p] for p in range(points)], axis=2)
        softness = own.reshape(coupling.shape[0], *coupling.shape[2:]) / HARDNESS
        assert apart is not None
        return Manifold(law, coupling, jnp.where(apart[:, 0], 0.0, softness), lasting)
    assert isinstance(law, Bounded)
    own = safe_divide(jnp.ones_like(law.effective_mass), law.effective_mass)
    softness = 1.0 / HARDNESS if apart is None else jnp.where(apart, 0.0, 1.0 / HARDNESS)
    mass = law.effective_mass * (_lengthening(group, lasting) / (1.0 + softness))
    softness = own * softness
    if force is None:
        return dataclasses.replace(law, softness=softness, effective_mass=mass)
    return Bounded(
        effective_mass=jnp.where(force.acts, law.effective_mass, mass),
        softness=jnp.where(force.acts, law.softness, softness),
        lower=0.5 * law.lower,
        upper=0.5 * law.upper,
    )


def _lengthening(group: _Group, lasting: Array | None) -> Array | float:
    """Factor on the step of the rows of a joint; a stop that is just met gets its exact step, or it would throw back."""
    if group.error.one_sided is None or lasting is None:
        return OVER_RELAXATION
    return jnp.where(group.error.one_sided & ~lasting[:, None], 1.0, OVER_RELAXATION)


def _rigid_law(group: _Group, carries: Array, lasting: Array | None) -> Any:
    """Rows that only push and carry nothing stay open: what is still apart must not be stopped."""
    coupling, law, force = group.coupling, group.rows.law, group.error.force
    if isinstance(law, Cone):
        assert coupling is not None
        closed = jnp.where(carries[:, 0], law.normal_mass, 0.0)
        return Manifold(dataclasses.replace(law, normal_mass=closed), coupling, None, lasting)
    closed = jnp.where(carries | (law.lower < 0), law.effective_mass, 0.0)
    if coupling is not None:
        return Manifold(dataclasses.replace(law, effective_mass=closed), coupling, None, lasting)
    longer = _lengthening(group, lasting) * closed
    mass = longer if force is None else jnp.where(force.acts, closed, longer)
    return dataclasses.replace(law, effective_mass=mass)


def _first_row(group: _Group, velocity: Array) -> Array:
    """``J v`` of the first row of each constraint: (turn, 1, column, world)."""
    rows = group.rows
    return first_row_velocity(rows, velocity)


def _moved(group: _Group, displacement: Array, time: Array, dt: Array) -> Array:
    """Change of the error of the first rows since the start of the step."""
    path = time * group.free_rate(0.5 * time)[:, :1] + _first_row(group, displacement)
    curvature = group.error.curvature
    return path if curvature is None else path + curvature * (time * (time / dt - 1.0))


def _law_bias(group: _Group, velocity: Array, displacement: Array, time: Array, dt: Array) -> Array | None:
    """Bias that the laws of force ask for in the substep that starts at `time`; None where there are none."""
    force, curvature = group.error.force, group.error.curvature
    if force is None:
        return None
    gained = time * group.acceleration + _first_row(group, velocity)
    if curvature is not None:
        gained = gained + curvature * (2.0 * time / dt)
    moved = _moved(group, displacement, time, dt)
    return group.rows.bias + force.by_error * moved + force.by_rate * gained


def _correction(
    group: _Group,
    law_bias: Array | None,
    present: Array,
    apart: Array | None,
    velocity: Array,
    time: Array,
    length: Array,
    dt: Array,
) -> Array:
    """Bias of the first sweep: closes gaps at most, and takes out a share of an overlap; `present` is the error now."""
    error = group.error
    speed = jnp.clip(present * (SHARE / length), -error.limit, error.limit)
    if apart is not None:
        speed = jnp.where(apart, present / length, speed)
    if law_bias is not None:
        assert error.force is not None
        # A law holds at the end, for the rate u_1 = 2 u - u_0 that belongs to the rate u in the middle.
        rate = group.free_rate(time) + _first_row(group, velocity) + _drift(group, time, dt)
        speed = jnp.where(error.force.acts, 0.5 * (law_bias - rate), speed)
    speed = speed + _drift(group, time + 0.5 * length, dt)
    return jnp.concatenate([speed, jnp.zeros_like(group.rows.bias[:, 1:])], axis=1)


def _end_biases(groups: tuple[_Group, ...], wanted: tuple[Array | None, ...], time: Array, dt: Array) -> tuple:
    """Biases of the sweep that relaxes the rows at `time`, the end of a substep."""
    biases = []
    for group, law_bias in zip(groups, wanted, strict=True):
        bias = _drift(group, time, dt) + group.free_rate(time)
        if law_bias is not None:
            assert group.error.force is not None
            bias = bias + jnp.where(group.error.force.acts, law_bias, 0.0)
        biases.append(bias)
    return tuple(biases)


def _drift(group: _Group, time: Array, dt: Array) -> Array:
    """What the turning of a Jacobian adds to the rate: linear in time about the middle of the step."""
    curvature = group.error.curvature
    return jnp.zeros((), group.rows.bias.dtype) if curvature is None else curvature * (2.0 * time / dt - 1.0)
