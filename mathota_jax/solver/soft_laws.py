"""Rows of small steps: laws and biases of the soft sweeps and of those that relax them."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from mathota_jax.solver.coupling import point_responses
from mathota_jax.solver.laws import Bounded, Cone
from mathota_jax.solver.rows import Rows, first_row_velocity
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once, settle
from mathota_jax.struct import pytree

PHASE = 2.0 * math.pi / 4.0
"""Frequency of the correction times the substep: a quarter of the substep rate. At a third of it a house of cards falls."""

DAMPING_RATIO = 10.0
"""Of the correction. Far overdamped, since sweeps that have not converged act like an elastic chain (Catto's value)."""

SHARE = PHASE / (2.0 * DAMPING_RATIO + PHASE)
"""Share of a position error that is corrected in one substep."""

HARDNESS = PHASE * (2.0 * DAMPING_RATIO + PHASE)
"""Response of a row to its own impulse, divided by its softness."""

OVER_RELAXATION = 1.4
"""Of joints, and of stops that carried something before; an impact gets its exact step. Measured on 10 to 40 loads: at
1 it sloshes for seconds, from 1.3 to 1.5 it comes to rest within one, at 1.7 it diverges. Joints of a body with more
than two get their exact step. Sweeps over a few rows that all feel one another leave modes of complex or negative share,
which impulses that carry over amplify: two boxes welded to the sides of a third, which is welded to a wall, flew off at
1.2, and three swayed ever more at 1, had joints not been closed at the end of the step (`phases.close_joints`). Closed,
all of 120 random trees with masses up to 1 : 100 come to rest; the slowest mode keeps 0.60 a step, with 1.4 here 0.92."""

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
      curvature: what the turning of the Jacobian adds to ``J v`` in half a step; None for contacts.
      force: rows that obey a law of force instead; None without any.
      branches: whether the row is one of a joint of a body with more than two, (turn, 1, column, 1); None where none is.
    """

    start: Array
    limit: Array
    one_sided: Array | None
    lever: Array | None = None
    curvature: Array | None = None
    force: ForceLaws | None = None
    branches: Array | None = None


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
        """Contacts without friction."""
        return self.push(impulse, error)

    def push(self, impulse: Array, error: Array) -> Array:
        """Normals of a manifold (1, column, world), by projected passes."""
        mass = self.base.normal_mass if isinstance(self.base, Cone) else self.base.effective_mass[0]
        old, error_normal = impulse[0], compute_once(error[0], error)  # every pass reads it
        if self.softness is not None:
            mass = mass / (1.0 + mass * self.softness)
        new = old
        for number in range(MANIFOLD_PASSES if self.coupling.shape[0] > 1 else 1):
            residual = error_normal + self._respond(new - old) if number else error_normal
            if self.softness is not None:
                residual = residual + self.softness * new
            new = jnp.maximum(new - mass * residual, 0.0)
        if self.lasting is not None:
            longer = jnp.where(self.lasting & (old > 0), CONTACT_OVER_RELAXATION, 1.0)
            new = jnp.maximum(old + longer * (new - old), 0.0)
        return new[None]

    def hold(self, normal: Array, old: Sequence[Array], errors: Sequence[Array]) -> list[Array]:
        """Tangents (column, world) for new impulses of the normals."""
        base = self.base
        assert isinstance(base, Cone)
        if self.lasting is not None:
            longer = base.tangent_mass * jnp.where(self.lasting, 1.0, FIRST_GRIP)
            base = dataclasses.replace(base, tangent_mass=longer)
        return base.hold(normal, old, errors)

    def _respond(self, change: Array) -> Array:
        """Change of the normal velocities of the columns by changes of their impulses, manifold by manifold."""
        points = self.coupling.shape[0]
        by_point = change.reshape(-1, points, change.shape[-1])
        parts = [
            row.reshape(by_point.shape) * by_point[:, point : point + 1] for point, row in enumerate(self.coupling)
        ]
        return functools.reduce(jnp.add, parts).reshape(change.shape)


class Group(NamedTuple):
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


def manifold_coupling(group: Rows) -> Array:
    """(turn, point, column, world) response of the normal of each column to the points of its own manifold."""
    turns, _, columns, worlds = group.bias.shape
    jacobian, response = ([unstack(side[:, 0], 1) for side in sides] for sides in (group.jacobian, group.response))
    of_points = point_responses(jacobian, response, group.table.together)
    return jnp.moveaxis(of_points, 3, 1).reshape(turns, -1, columns, worlds)


def apart_rows(group: Group, present: Array) -> Array | None:
    """Whether rows that only push are open now; None where all rows also pull."""
    if group.error.one_sided is None:
        return None
    return settle(jnp.where(group.error.one_sided & (present > 0), 1.0, 0.0)) > 0.5


def soft_law(group: Group, lasting: Array, apart: Array | None) -> Any:
    """Law of the soft sweeps, in which half of the impulse of a substep acts; gaps close to the surface exactly."""
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


def _lengthening(group: Group, lasting: Array | None) -> Array | float:
    """Factor on the step of the rows of a joint; a stop that is just met gets its exact step, or it would throw back."""
    error = group.error
    factor = OVER_RELAXATION if error.branches is None else jnp.where(error.branches, 1.0, OVER_RELAXATION)
    if error.one_sided is None or lasting is None:
        return factor
    return jnp.where(error.one_sided & ~lasting[:, None], 1.0, factor)


def rigid_law(group: Group, carries: Array, lasting: Array | None) -> Any:
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


def _first_row(group: Group, velocity: Array) -> Array:
    """``J v`` of the first row of each constraint: (turn, 1, column, world)."""
    rows = group.rows
    return first_row_velocity(rows, velocity)


def error_change(group: Group, displacement: Array, time: Array, dt: Array) -> Array:
    """Change of the error of the first rows since the start of the step."""
    path = time * group.free_rate(0.5 * time)[:, :1] + _first_row(group, displacement)
    curvature = group.error.curvature
    return path if curvature is None else path + curvature * (time * (time / dt - 1.0))


def force_bias(group: Group, velocity: Array, displacement: Array, time: Array, dt: Array) -> Array | None:
    """Bias that the laws of force ask for in the substep that starts at `time`; None where there are none."""
    force, curvature = group.error.force, group.error.curvature
    if force is None:
        return None
    gained = time * group.acceleration + _first_row(group, velocity)
    if curvature is not None:
        gained = gained + curvature * (2.0 * time / dt)
    moved = error_change(group, displacement, time, dt)
    return group.rows.bias + force.by_error * moved + force.by_rate * gained


def correction(
    group: Group,
    law_bias: Array | None,
    present: Array,
    apart: Array | None,
    velocity: Array,
    time: Array,
    length: Array,
    dt: Array,
) -> Array:
    """Bias of the soft sweeps: closes gaps at most, and takes out a share of an overlap; `present` is the error now."""
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


def end_biases(groups: tuple[Group, ...], wanted: tuple[Array | None, ...], time: Array, dt: Array) -> tuple:
    """Biases of the sweeps that relax the rows at `time`, the end of a substep."""
    biases = []
    for group, law_bias in zip(groups, wanted, strict=True):
        bias = _drift(group, time, dt) + group.free_rate(time)
        if law_bias is not None:
            assert group.error.force is not None
            bias = bias + jnp.where(group.error.force.acts, law_bias, 0.0)
        biases.append(bias)
    return tuple(biases)


def closing_speed(apart: Array | None, impulse: Array, present: Array, length: Array) -> Array | None:
    """Speed (turn, row, column, world) at which rows may close that are open and needed no impulse in the soft sweeps.

    They carry nothing, though they did in the last substep: a body that is lifted off its support would hang in the air.
    """
    if apart is None:
        return None
    speed = jnp.where(apart & (impulse[:, :1] <= 0), present / length, 0.0)
    return jnp.concatenate([speed, jnp.zeros_like(impulse[:, 1:])], axis=1)


def _drift(group: Group, time: Array, dt: Array) -> Array:
    """What the turning of a Jacobian adds to the rate: linear in time about the middle of the step."""
    curvature = group.error.curvature
    return jnp.zeros((), group.rows.bias.dtype) if curvature is None else curvature * (2.0 * time / dt - 1.0)
