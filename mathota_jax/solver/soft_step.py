"""Small steps with soft corrections: the "Soft Step" scheme on rows of any kind.

A step has one collision pass and n substeps. In each of them the velocity is kicked, every row is swept twice with a soft
bias that takes out a share of the position error, the bodies drift at that velocity, and two sweeps without the bias
*relax* the rows, so that the push-out velocity does not stay (E. Catto, "Solver2D", box2d.org, 2024; Box2D v3).

What differs from there, and why:

* A substep is kick, drift, kick: half of the forces and half of the impulses act before the drift, half after it. Free
  flight and a slide under constant friction are exact parabolas, whatever the substep, and a load sinks half as far.
* Bodies are not moved between the substeps. Rows see the displacement summed so far, times their Jacobian: exact for a
  rolling sphere, where anchors fixed in the body would lift off, and right to second order in the turn of a step elsewhere.
* The stiffness is not capped at 30 Hz: a load sinks by ``load / (2 effective mass * frequency^2)``, so that a cap would
  keep the error from falling with the substep.
* Rows are swept twice where Catto sweeps once (`SWEEPS`).
* The points of a manifold are solved together (a sequence would tilt a stack), and every sweep over-relaxes. Ten boxes
  bounce for ever with the bounded step of `Cone` and come to rest exactly with this one.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.solver import sweeps
from mathota_jax.solver.rows import Rows, add_impulses, row_velocity, visiting_all_turns
from mathota_jax.solver.soft_laws import (
    Group,
    PositionError,
    apart_rows,
    closing_speed,
    correction,
    end_biases,
    error_change,
    force_bias,
    manifold_coupling,
    rigid_law,
    soft_law,
)

SWEEPS = 2
"""Sweeps before and after the drift of a substep. Impulses that lag behind a load act like dampers of the wrong sign. With
one each a house of cards that rests sways ever more at any rate of substeps, e-fold in 0.2 s; with two before and one
after in 0.5 s, and 20 cubes at one point part at 5.8 m/s, not 2.6; with two each its sway dies away (1/240 and 1/480 s,
float64). Four substeps of two sweeps each let a wall of 210 cubes sway out of its plane a sixteenth as far as four of one,
eight of one half as far."""


class Impulses(NamedTuple):
    """For each group of rows (turn, row, column, world): impulses of the whole step, and of its last substep alone.

    Those of a restitution pass belong to the first, not to the second: they do not come again.
    """

    total: tuple[Array, ...]
    last: tuple[Array, ...]


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
        Group(
            group,
            error,
            None if error.lever is None else manifold_coupling(group),
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
        wanted = tuple(force_bias(group, velocity, displacement, time, dt) for group in groups)
        present = tuple(group.error.start + error_change(group, displacement, time, dt) for group in groups)
        apart = tuple(apart_rows(group, error) for group, error in zip(groups, present, strict=True))
        laws = tuple(soft_law(*arguments) for arguments in zip(groups, lasting, apart, strict=True))
        biases = tuple(
            correction(group, law_bias, error, gap, velocity, time, length, dt) + group.free_rate(middle)
            for group, law_bias, error, gap in zip(groups, wanted, present, apart, strict=True)
        )
        velocity, impulses = _sweep(SWEEPS, rows, laws, biases, velocity + half, halves)
        displacement = displacement + length * velocity
        velocity = velocity * decay
        closing = tuple(closing_speed(*parts, length) for parts in zip(apart, impulses, present, strict=True))
        impulses = tuple(first + second for first, second in zip(impulses, halves, strict=True))
        laws = tuple(
            rigid_law(group, impulse[:, :1] > 0, before)
            for group, impulse, before in zip(groups, impulses, lasting, strict=True)
        )
        biases = tuple(
            bias if speed is None else bias + speed
            for bias, speed in zip(end_biases(groups, wanted, end, dt), closing, strict=True)
        )
        velocity, impulses = _sweep(SWEEPS, rows, laws, biases, velocity + half, impulses)
        total = tuple(before + impulse for before, impulse in zip(total, impulses, strict=True))
        # What the impulses changed in this substep is what they would change in the next one.
        return (velocity, velocity - start, displacement, impulses, total, wanted), None

    zero, none = jnp.zeros_like(velocity), tuple(jnp.zeros_like(impulse) for impulse in impulses)
    added = add_impulses(rows, zero, impulses)
    wanted = tuple(force_bias(group, zero, zero, jnp.zeros_like(dt), dt) for group in groups)
    carry = (zero, added, zero, impulses, none, wanted)
    # In reverse mode a substep is computed again: only what it starts from is stored.
    carry, _ = lax.scan(jax.checkpoint(substep, prevent_cse=False), carry, jnp.arange(substeps, dtype=velocity.dtype))
    velocity, _, displacement, impulses, total, wanted = carry
    if not rebound_sweeps:
        return velocity, displacement, Impulses(total, impulses)
    biases = end_biases(groups, wanted, dt, dt)
    return _rebound(rebound_sweeps, groups, biases, velocity, displacement, impulses, total)


def _decay(damping: tuple[float, float], time: Array, velocity: Array) -> Array | float:
    """Factor (component, 1, world) or 1 on what the impulses added to the velocity.

    `velocity` without them is damped as if they were not there: a body stopped from 180 m/s would leave again.
    """
    if not any(damping):
        return 1.0
    rates = np.repeat(damping, 3)[: len(velocity), None, None]
    return jnp.maximum(1.0 - jnp.asarray(rates, velocity.dtype) * time, 0.0)


def _rebound(
    count: int,
    groups: tuple[Group, ...],
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
        laws.append(rigid_law(group, (impulse[:, :1] > 0) | bounces, None))
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
    # Turn by turn on GPUs, too: the points of a manifold answer to one another.
    return sweeps.by_turns(count, lambda _: sweeps.of_law(), rows, laws, biases, velocity, impulses)


@_sweep.defjvp
def _sweep_jvp(count: int, primals: tuple, tangents: tuple) -> tuple:
    """A loop over the turns in use has no reverse mode; a loop over all turns, which does the same, has."""

    def sweep_all_turns(rows: tuple[Rows, ...], *others: Any) -> tuple[Array, tuple[Array, ...]]:
        return _sweep.fun(count, visiting_all_turns(rows), *others)

    return jax.jvp(sweep_all_turns, primals, tangents)
