"""When the first bodies meet on their flight, and the derivative of that time.

Every pair is followed from where it is by steps that stop short of the next touch: along the normal of a contact point
the gap changes by its present rate and the relative acceleration, less at most what the turning of the bodies adds,
``(omega^2 reach) t^2 / 2``. So a ball reaches a plane in one step, and the rest converges like Newton's method; what was
overstepped all the same is found by going back. The search itself has no derivative. That of its result is the one of the
root of the gap, ``d t = -d gap / (d gap / d t)``: with it, the motion before and after the impact has the derivative that
is known as saltation matrix.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import Bodies, smaller_moving
from mathota_jax.collision.narrowphase import find_contacts
from mathota_jax.collision.rest import TOUCHING, meet, next_touch, rest_speed, tolerance
from mathota_jax.dynamics.flight import Flight
from mathota_jax.dynamics.pair_motion import contacts_between, reaches, turning
from mathota_jax.model import Model
from mathota_jax.scene import PairGroup, Scene
from mathota_jax.spatial.indexing import take, unstack
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import settle
from mathota_jax.spatial.vector import Vec3, cross, dot, norm

ADVANCES = 64
"""Largest number of steps of the search."""

LOOK = 0.05
"""Angle [rad] after which bodies that touch and turn are looked at again."""

MARGIN = 256
"""Multiples of the machine epsilon, of the time that is left, before its end from which an impact waits for the next step:
something must be left to divide by."""


class FirstImpact(NamedTuple):
    """The first impact in each world.

    Attributes:
      time: (world,) [s]; the end of the time searched where there is none.
      happens: (world,) bool.
      delay: (body, world) [s] by which bodies that meet then in another pair do so later: 0, with the derivative of that.
    """

    time: Array
    happens: Array
    delay: Array


class _Search(NamedTuple):
    """State of the search for one group, (pair, world): no touch before `low`, one before `high`.

    `level` is the gap that counts as touching: 0, or that of bodies that overlap from the start.
    """

    level: Array
    time: Array
    low: Array
    high: Array
    going: Array
    touches: Array
    count: Array


def first_impact(
    model: Model, flight: Flight, separation: Array, gravity: Vec3, left: Array, wanted: Array
) -> FirstImpact:
    """Time of the first impact within the time `left` (world,), in the worlds `wanted`.

    Args:
      model: parameters, `dt` being the whole time step, and static scene.
      flight: of all bodies.
      separation: (slot, world) of the contacts at its start.
      gravity: components (1, world).
      left: time that is searched.
      wanted: (world,) bool; the others have no impact.

    Returns:
      The impact; its time is differentiable in the flight and the shapes.
    """
    fixed_model, fixed, end, fixed_gravity = lax.stop_gradient((model, flight, left, gravity))
    end = end * (1.0 - MARGIN * jnp.finfo(end.dtype).eps)
    pull = norm(fixed_gravity)
    best = jnp.broadcast_to(end, wanted.shape)
    happens = jnp.zeros_like(wanted)
    slots, levels, first = [], [], 0
    for group in model.scene.pair_groups:
        time, touches, level = _search(fixed_model, group, fixed, pull, end, wanted)
        of_group = separation[first : first + group.slot_count]
        levels.append(jnp.repeat(_level(level, of_group), group.point_count, axis=0))
        first += group.slot_count
        best = jnp.minimum(best, jnp.where(touches, time, jnp.inf).min(0))
        happens = happens | touches.any(0)
        slots.append(jnp.repeat(jnp.where(touches, time, jnp.inf), group.point_count, axis=0))
    met, level = jnp.concatenate(slots), jnp.concatenate(levels)
    time, delay = _with_derivative(model, flight, pull, end, best, happens, met, level)
    return FirstImpact(jnp.where(happens, time, left), happens, delay)


def _search(
    model: Model, group: PairGroup, flight: Flight, gravity: Array, end: Array, wanted: Array
) -> tuple[Array, Array, Array]:
    """Time (pair, world) at which each pair of a group first meets, whether it does, and the gap that is taken to touch."""
    count = len(group.bodies_a)
    a, b = (take(flight, side) for side in (group.bodies_a, group.bodies_b))
    reach_a, reach_b = reaches(model, group)
    size = smaller_moving(model, group.bodies_a, group.bodies_b)
    near = tolerance(size.dtype) * size
    restitution = jnp.minimum(*(take(model.restitution, side) for side in (group.bodies_a, group.bodies_b)))
    rebound = jnp.where(restitution > 0, restitution, 1.0)
    acceleration = b.acceleration - a.acceleration
    shape = (count, wanted.shape[-1])
    turns = not {group.kind_a, group.kind_b} <= {"plane", "sphere"}
    end = jnp.broadcast_to(end, shape)

    def look(time: Array, level: Array, first: Array) -> tuple[Array, ...]:
        """At a time: level; step to the next touch; gap, rate and acceleration of the deepest point; an impact or not."""
        (one, _), (other, _) = a.at(time), b.at(time)
        found = contacts_between(model, group, one[:2], other[:2])
        spin_a, spin_b = norm(one.angular_velocity), norm(other.angular_velocity)
        swing = turning(spin_a, spin_a * reach_a) + turning(spin_b, spin_b * reach_b)
        scale = norm(one.velocity) + norm(other.velocity) + turning(spin_a, reach_a) + turning(spin_b, reach_b)
        rests = rest_speed(gravity, model.dt, size, scale)
        step = jnp.full(shape, jnp.inf, size.dtype)
        deepest, rate_there, bend_there = step, jnp.zeros(shape, size.dtype), jnp.zeros(shape, size.dtype)
        impact = jnp.zeros(shape, bool)
        columns = [
            _by_point(component, count, shape) for component in (*found.position, *found.normal, found.separation)
        ]
        seen = []
        for x, y, z, n_x, n_y, n_z, separation, active in zip(
            *columns, _by_point(found.active, count, shape), strict=True
        ):
            point, normal = Vec3(x, y, z), Vec3(n_x, n_y, n_z)
            velocity = other.velocity + cross(other.angular_velocity, point - other.position)
            velocity = velocity - one.velocity - cross(one.angular_velocity, point - one.position)
            rate = dot(normal, velocity)
            rests_here = (separation <= TOUCHING * size) & (jnp.abs(rate) * rebound <= rests)
            seen.append((active & ~rests_here, separation, rate, dot(normal, acceleration) - swing))
        overlap = jnp.minimum(0.0, jnp.stack([jnp.where(counts, gap, 0.0) for counts, gap, *_ in seen]).min(0))
        level = jnp.where(first, overlap, level)
        for counts, separation, rate, bend in seen:
            gap = separation - level
            step = jnp.minimum(step, jnp.where(counts, next_touch(gap, rate, bend, near)[0], jnp.inf))
            deeper = counts & (gap < deepest)
            deepest, rate_there = jnp.where(deeper, gap, deepest), jnp.where(deeper, rate, rate_there)
            bend_there = jnp.where(deeper, bend, bend_there)
            impact = impact | (counts & (gap <= near) & (rate < 0))
        if turns:
            # Other corners may come, too: not before the gap is gone, and those that came are found by going back.
            safe = jnp.maximum(safe_divide(deepest, scale), safe_divide(LOOK, spin_a + spin_b))
            step = jnp.where(spin_a + spin_b > 0, jnp.minimum(step, safe), step)
        return level, step, deepest, rate_there, bend_there, impact

    def advance(state: _Search) -> _Search:
        level, step, gap, rate, bend, impact = look(state.time, state.level, state.count == 0)
        # Bodies that overlapped and have parted since, as the speed of their return tells, meet at their surfaces.
        parted = impact & (state.time > 0) & (rate * rate + 2.0 * jnp.minimum(bend, 0.0) * -level > 0)
        gap, level = gap + jnp.where(parted, level, 0.0), jnp.where(parted, 0.0, level)
        inside = settle(jnp.where((gap < -near) & (state.time > 0), 1.0, 0.0)) > 0.5
        touches = settle(jnp.where(impact & ~inside, 1.0, 0.0)) > 0.5
        low = jnp.where(inside, state.low, state.time)
        high = jnp.where(inside, state.time, state.high)
        back = state.time - jnp.where(rate < 0, gap / jnp.where(rate < 0, rate, 1.0), jnp.inf)
        time = jnp.where(inside, back, state.time + step)
        middle = 0.5 * (low + high)
        time = jnp.where((time > low) & (time < high), time, jnp.where(jnp.isfinite(high), middle, time))
        left = (time <= end) & (time > low)
        going = state.going & ~touches & left
        return _Search(
            level,
            jnp.where(going, time, state.time),
            jnp.where(state.going, low, state.low),
            jnp.where(state.going, high, state.high),
            going,
            state.touches | (state.going & touches),
            state.count + 1,
        )

    zero = jnp.zeros(shape, size.dtype)
    start = _Search(zero, zero, zero, zero + jnp.inf, wanted & (zero == 0), zero > 0, jnp.asarray(0))
    last = lax.while_loop(lambda s: s.going.any() & (s.count < ADVANCES), advance, start)
    # What is not decided by then is stopped where nothing was overstepped yet, and looked at again from there.
    return jnp.where(last.going, last.low, last.time), last.touches | last.going, last.level


def _level(level: Array, separation: Array) -> Array:
    """The level (pair, world) of a search with the derivative of the overlap (slot, world) that it is."""
    count, worlds = level.shape
    apart = jnp.stack(_by_point(separation, count, (count, worlds)))
    nearest = (
        jnp.argmin(jnp.abs(lax.stop_gradient(apart) - level), 0)[None] == jnp.arange(apart.shape[0])[:, None, None]
    )
    overlap = jnp.where(nearest & (level < 0), apart, 0.0).sum(0)
    return level + overlap - lax.stop_gradient(overlap)


def _by_point(values: Array, count: int, shape: tuple[int, int]) -> list[Array]:
    """The (pair, world) values of each point of the manifolds, from (slot, world)."""
    return unstack(jnp.broadcast_to(values, (values.shape[0], shape[1])).reshape(count, -1, shape[1]), 1)


def _with_derivative(
    model: Model,
    flight: Flight,
    pull: Array,
    end: Array,
    time: Array,
    happens: Array,
    meets: Array,
    level: Array,
) -> tuple[Array, Array]:
    """The time where something happens, refined by one step of Newton's method, which carries the derivative.

    `meets` and `level` are the time of the pair of each slot and the gap at which it touches.

    Returns:
      The time, and the delays of other pairs that meet then (see `FirstImpact`).
    """

    def gaps(time: Array) -> tuple[Array, tuple[Array, Bodies]]:
        placed, _ = flight.at(time[None])
        found = find_contacts(model.scene, model.shapes, placed.position, placed.orientation)
        return found.separation - level, (found.active, placed)

    (gap, (active, placed)), (rate, _) = jax.jvp(gaps, (time,), (jnp.ones_like(time),))
    rate = lax.stop_gradient(rate)
    # The point that meets: the deepest of those of the pairs that meet now and approach.
    candidate = active & (meets <= time) & (rate < 0)
    step = _step_of_deepest(candidate, gap, rate)[0]
    least = jnp.finfo(time.dtype).eps * end
    refined = jnp.clip(time + lax.stop_gradient(step), least, end)
    candidate = candidate | (active & happens & _meets_too(model, lax.stop_gradient((placed, gap, rate)), pull))
    delay = jnp.where(happens, _delays(model.scene, candidate, gap, rate, step), 0.0)
    return jnp.where(happens, refined + step - lax.stop_gradient(step), end), delay


def _step_of_deepest(candidate: Array, gap: Array, rate: Array) -> tuple[Array, Array]:
    """Newton's step of the deepest of the candidates (point, ..., world), 0 without one; and whether there is one."""
    depth = jnp.where(candidate, lax.stop_gradient(gap), jnp.inf)
    first = jnp.argmin(depth, 0)[None] == jnp.arange(depth.shape[0]).reshape(-1, *(1,) * (depth.ndim - 1))
    chosen = settle(jnp.where(candidate & first, 1.0, 0.0))
    return -safe_divide((chosen * gap).sum(0), (chosen * rate).sum(0)), chosen.sum(0) > 0.5


def _meets_too(model: Model, found: tuple[Bodies, Array, Array], pull: Array) -> Array:
    """(slot, world) which points take part in the collision, and do not rest: those of `collisions.collide`."""
    bodies, gap, rate = found
    sides = model.scene.slot_bodies
    size = smaller_moving(model, *sides)
    speed = norm(bodies.velocity)
    scale = take(speed, sides[0]) + take(speed, sides[1])
    rests = -rate <= rest_speed(pull, model.dt, size, scale)
    return meet(gap, size) & ~rests


def _delays(scene: Scene, candidate: Array, gap: Array, rate: Array, step: Array) -> Array:
    """(body, world) 0, with the derivative of the time by which bodies meet later than the pair whose Newton step is given.

    Where all pairs share one time, of those that meet at once only one would have the derivative of its own. A body that
    meets several at once has the mean.
    """
    worlds = gap.shape[-1]
    total, count = (jnp.zeros((scene.body_count, worlds), gap.dtype) for _ in range(2))
    first = 0
    for group in scene.pair_groups:
        rows = slice(first, first + group.slot_count)
        points = (jnp.stack(_by_point(v[rows], len(group.bodies_a), (0, worlds))) for v in (candidate, gap, rate))
        of_pair, meets = _step_of_deepest(*points)
        later = jnp.where(meets, of_pair - step, 0.0)
        for side in (group.bodies_a, group.bodies_b):
            total, count = total.at[np.asarray(side)].add(later), count.at[np.asarray(side)].add(meets * 1.0)
        first += group.slot_count
    moves = jnp.asarray(~np.asarray(scene.static))[:, None]
    delay = jnp.where(moves & (count > 0), total / jnp.maximum(count, 1.0), 0.0)
    return delay - lax.stop_gradient(delay)
