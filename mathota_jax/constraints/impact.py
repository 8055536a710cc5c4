"""When a contact meets within a step, what velocity it then asks for, and how long its impulse acts on the position."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import settle
from mathota_jax.spatial.vector import Vec3, norm

ROUND_OFF = 64
"""Multiples of the machine epsilon, of the velocities at play, within which a rebound is round-off."""


LET_IN = 0.2
"""Share of the smaller body's inner radius, times the restitution, by which a gap may be overshot that closes only because
of what else hits the bodies in this step: in the next one they rebound, and else they would stop each other for good. 216
elastic balls that fall in a block lost 1.8 % of their energy in steps of 1 ms, 24 % in those of 1/240 s; now 2e-5 and 1e-4.
(With 0.1 still 6 % in those of 1/240 s, in which some balls go through more than that.)"""

FALL = 2.0
"""Multiples of ``gravity dt^2`` from which a gap may be overshot. What closes narrower ones is mostly a load, as on balls
that rest on others."""


class Approach(NamedTuple):
    """Normal motion of contacts (column, world) over a step.

    Attributes:
      separation: at the start.
      start, free: normal velocities at the start and, unconstrained, at the end of the step.
      restitution: coefficient of the pair; None where nothing bounces.
      gravity: (1, world) components.
    """

    separation: Array
    start: Array
    free: Array
    restitution: Array | None
    gravity: Vec3


def let_in(approach: Approach, size: Array, dt: Array) -> Array | None:
    """How far [m] contacts may overlap at the end of the step, see `LET_IN`; None where nothing bounces.

    Args:
      approach: of the contacts.
      size: (column, world) inner radius of the smaller body.
      dt: time step.
    """
    if approach.restitution is None:
        return None
    wide = (approach.separation > FALL * norm(approach.gravity) * dt * dt) & (approach.restitution > 0)
    return jnp.where(settle(jnp.where(wide, 1.0, 0.0)) > 0, LET_IN * size * approach.restitution, 0.0)


class Answer(NamedTuple):
    """What contacts (column, world) ask for: normal velocity at the end of the step, and the lever of the impulse [s]."""

    target: Array
    lever: Array


def stop(approach: Approach, admitted: Array | None, dt: Array) -> Answer:
    """What contacts ask for that do not rebound.

    A contact *hits* if it overlaps or if its present velocity closes the gap within the step; other gaps may close no
    further than to 0, or to the overlap `admitted`.
    """
    separation, start = approach.separation, approach.start
    gap = jnp.maximum(separation, 0.0)
    hits = settle(jnp.where(gap + start * dt <= 0, 1.0, 0.0) + jnp.where(separation <= 0, 1.0, 0.0)) > 0
    # The gap changes by dt (start + end) / 2, so this end velocity closes it and no more.
    way = gap if admitted is None else gap + admitted
    target = jnp.where(hits, 0.0, -2.0 * way / dt - start)
    stopped = jnp.where(hits, jnp.maximum(-start, 0.0), 0.0)
    # Only of those that hit: a gap of metres over next to no speed has an infinite derivative, times 0.
    time = jnp.clip(safe_divide(gap, stopped), 0.0, dt)
    # Share of the impulse that stops an approach at `time`; the rest carries the load, all through the step.
    share = safe_divide(stopped, stopped + _load(approach, dt))
    return Answer(target, 0.5 * dt + share * (0.5 * dt - time))


def impact(approach: Approach, stopped: Answer, dt: Array) -> Answer:
    """What contacts ask for that may rebound: if they do not, they are `stopped`."""
    if approach.restitution is None:
        return stopped
    gap = jnp.maximum(approach.separation, 0.0)
    acceleration = (approach.free - approach.start) / dt
    velocity, time, bounces = _bounce(approach, approach.restitution, gap, acceleration, dt, dt)
    return Answer(jnp.where(bounces, velocity, stopped.target), jnp.where(bounces, dt - time, stopped.lever))


def _load(approach: Approach, dt: Array) -> Array:
    """Velocity by which a contact has to hold its bodies up in a step: their weight, or what else presses them together.

    A body that sinks a little while a force of many times its weight presses it down is not thrown out by that force.
    """
    return jnp.maximum(norm(approach.gravity) * dt, approach.start - approach.free)


def loaded(approach: Approach, target: Array, lever: Array, dt: Array) -> tuple[Array, Array]:
    """Change of the normal velocity that a rebound asks for, 0 for none; its lever if its impulse mostly carries others.

    A box that settles on another by 1 mm/s may rebound by half of that, while its contact carries all that rests on it
    through the step: the lever of the impact, all of the step, would lift it by twice its fall.
    """
    bounces, asked = target > 0, jnp.maximum(target - approach.free, 0.0)
    share = safe_divide(asked, asked + _load(approach, dt))
    lasting = 0.5 * dt + share * (lever - 0.5 * dt)
    return jnp.where(bounces, asked, 0.0), jnp.where(bounces, lasting, lever)


def rebound(approach: Approach, dt: Array, latest: Array) -> Answer:
    """The same for the small steps, which stop an approach at the surface before the restitution pass; 0 for no bounce.

    An impact due just after the step may be met in it, by round-off or because of other contacts: those up to the time
    `latest` count. The lever makes up for the flight after the impact: a body that left the surface with velocity u has
    moved by ``u t + acceleration t^2 / 2`` and reached ``u + acceleration t``. It is bounded where that is nearly lost.
    """
    if approach.restitution is None:
        return Answer(jnp.zeros(()), jnp.zeros(()))
    gap = jnp.maximum(approach.separation, 0.0)
    acceleration = (approach.free - approach.start) / dt
    velocity, time, bounces = _bounce(approach, approach.restitution, gap, acceleration, dt, latest)
    flight = jnp.maximum(dt - time, 0.0)
    leaving = velocity - acceleration * (dt - time)
    velocity = jnp.maximum(leaving + acceleration * flight, 0.0)
    mean = jnp.clip(safe_divide(leaving + 0.5 * acceleration * flight, velocity), 0.0, 2.0)
    return Answer(jnp.where(bounces, velocity, 0.0), jnp.where(bounces, flight * mean, 0.0))


def _bounce(
    approach: Approach, restitution: Array, gap: Array, acceleration: Array, dt: Array, latest: Array
) -> tuple[Array, Array, Array]:
    """End velocity, time of impact and whether the contact bounces, for constant acceleration within the step.

    The impact is the first root tau of ``gap + start t + acceleration t^2 / 2``. Forces act before and after it: a
    contact bounces if it comes by the time `latest` and if, after it, the bodies still separate at the end of the step,
    beyond round-off. That is the only threshold.
    """
    start = approach.start
    discriminant = start * start - 2.0 * acceleration * gap
    speed = safe_sqrt(jnp.maximum(discriminant, 0.0))  # at the impact
    divisor = speed - start
    time = safe_divide(2.0 * gap, divisor)
    velocity = restitution * speed + acceleration * (dt - time)
    reaches = (discriminant >= 0) & (divisor > 0) & (time <= latest) & ((start < 0) | (gap > 0))
    # Bodies at rest on one another move relative to each other by round-off, which is no impact.
    moved = norm(approach.gravity) * dt + jnp.abs(start) + jnp.abs(acceleration) * dt
    noise = ROUND_OFF * jnp.finfo(dt.dtype).eps * moved
    bounces = settle(jnp.where(reaches & (restitution > 0) & (velocity > noise), 1.0, 0.0)) > 0
    return velocity, jnp.where(bounces, time, 0.0), bounces
