"""Fast bodies stop where they first touch something (guide 10.4): the motion of a step is checked after the solve.

Two bodies are fast to each other where the step moves them by more than a share of the smaller one's inner radius: then
contacts found at the start of the step say little of what they meet. Their motion is followed by conservative advancement
(B. Mirtich, "Impulse-based Dynamic Simulation", 1996, section 2.3), which can jump over nothing, and both stop at the
first touch with their velocities as they are. The contact is handled in the next step; the time that was left is lost to
them (E. Catto, "Continuous Collision", GDC 2013).
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import Bodies, smaller_moving
from mathota_jax.collision.narrowphase import SPECULATIVE
from mathota_jax.dynamics.pair_motion import contacts_between, reaches, turning
from mathota_jax.model import Model
from mathota_jax.scene import PairGroup
from mathota_jax.spatial.indexing import take, unstack
from mathota_jax.spatial.quaternion import Quaternion, exponential, multiply, normalize
from mathota_jax.spatial.settle import settle
from mathota_jax.spatial.vector import Vec3, cross, dot, norm, where

TOUCHING = 1e-3
"""Gap at which bodies stop, as a share of the inner radius of the smaller one; and tolerance of the search."""

SINKING = 0.1
"""Share of the same radius by which bodies that touch already may approach in a step: less than what would pass them
through."""

DEEPEST = 0.5
"""Share of the same radius at which almost nothing of that is left: a stick that spins on the ground would sink a little in
every step, and in the end through it."""

LEAST_SINKING = 0.02
"""What is left then, as a share of `SINKING`: with nothing a body could not turn out of what it is in."""

ADVANCES = 64
"""Largest number of advances; what is left then counts as a touch, so that nothing passes through."""

ROUNDS = 4
"""Bodies that stop are where others pass later: the search is repeated with their shorter motions."""


class Motion(NamedTuple):
    """Straight motion of bodies in a step, components (body, world).

    At share s of the step they are at ``position + s shift``, turned by ``exp(s turn)``.
    """

    position: Vec3
    orientation: Quaternion
    shift: Vec3
    turn: Vec3

    def at(self, share: Array) -> tuple[Vec3, Quaternion]:
        """Positions and orientations."""
        turned = normalize(multiply(exponential(self.turn * share), self.orientation))
        return self.position + self.shift * share, turned


class _Pairs(NamedTuple):
    """The pairs of a group, components (pair, world).

    Motions of the two bodies, reaches of the two shapes about the centres of mass, inner radii of the smaller moving body
    and of the smaller body.
    """

    a: Motion
    b: Motion
    reach: tuple[Array, Array]
    moving_size: Array
    size: Array


def stop_at_impacts(model: Model, motion: Motion, moved: Bodies, trees: tuple[tuple[int, ...], ...] = ()) -> Bodies:
    """Bodies at the end of the step, those that hit something at speed where they do.

    Args:
      model: parameters and static scene.
      motion: of all bodies in this step, static ones included.
      moved: all bodies at the end of the step.
      trees: bodies that stop together, since joints hold them together.

    Returns:
      `moved` with other positions and orientations. Differentiable: the share of the motion that is made is that of the
      root of the gap, ``d s = -d gap / (d gap / d s)``.
    """
    worlds = max(component.shape[-1] for component in (*motion.shift, *motion.position))
    full = jnp.ones((model.scene.body_count, worlds), motion.position.x.dtype)
    fast = jnp.asarray(False)
    for group in model.scene.pair_groups:
        fast = fast | _fast(_pairs(model, group, motion)).any()
    shares = functools.partial(_shares, trees)
    share = lax.cond(fast, shares, lambda model, motion, full: full, model, motion, full)
    stops = settle(jnp.where(share < 1, 1.0, 0.0)) > 0.5
    position, orientation = motion.at(share)

    def select(stopped: Array, free: Array) -> Array:
        return jnp.where(stops, stopped, free)

    return moved._replace(
        position=Vec3(*(select(a, b) for a, b in zip(position, moved.position, strict=True))),
        orientation=Quaternion(*(select(a, b) for a, b in zip(orientation, moved.orientation, strict=True))),
    )


def _shares(trees: tuple[tuple[int, ...], ...], model: Model, motion: Motion, full: Array) -> Array:
    """(body, world) share of its motion that each body makes."""
    groups = model.scene.pair_groups
    fixed_model, fixed_motion = lax.stop_gradient((model, motion))
    fixed = [_pairs(fixed_model, group, fixed_motion) for group in groups]

    def one_round(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        old, _, count = state
        share = old
        for group, pairs in zip(groups, fixed, strict=True):
            share = _lower(group, share, _first_touch(fixed_model, group, pairs, share))
        for tree in trees:
            share = share.at[np.asarray(tree)].set(take(share, tree).min(0))
        return share, (share != old).any(), count + 1

    start = (full, jnp.asarray(True), jnp.asarray(0))
    share = lax.while_loop(lambda state: state[1] & (state[2] < ROUNDS), one_round, start)[0]
    # One Newton step of the root: no change of the value, the exact derivative (implicit function theorem).
    change = jnp.zeros_like(share)
    for group in groups:
        change = change + _differential(group, _newton_step(model, group, _pairs(model, group, motion), share), share)
    for tree in trees:
        # Of the body that touches: 0 for the others.
        change = change.at[np.asarray(tree)].set(take(change, tree).sum(0))
    return share + change


def _pairs(model: Model, group: PairGroup, motion: Motion) -> _Pairs:
    sides = (group.bodies_a, group.bodies_b)
    a, b = (take(motion, side) for side in sides)
    sizes = [take(model.size, side) for side in sides]
    return _Pairs(
        a, b, reaches(model, group), smaller_moving(model, group.bodies_a, group.bodies_b), jnp.minimum(*sizes)
    )


def _fast(pairs: _Pairs) -> Array:
    """(pair, world) whether the step moves two bodies so far that contacts at its start do not see what they meet."""
    travel = norm(pairs.a.shift - pairs.b.shift) + sum(
        turning(norm(body.turn), reach) for body, reach in zip((pairs.a, pairs.b), pairs.reach, strict=True)
    )
    return travel > SPECULATIVE * pairs.moving_size


def _closest(model: Model, group: PairGroup, pairs: _Pairs, share_a: Array, share_b: Array) -> tuple[Array, Vec3]:
    """Gap (pair, world) and normal where each body has made its share of the motion."""
    count = len(group.bodies_a)
    placed = pairs.a.at(share_a), pairs.b.at(share_b)
    worlds = max(component.shape[-1] for place in placed for part in place for component in part)
    found = contacts_between(model, group, *placed)

    def by_point(values: Array) -> list[Array]:
        return unstack(jnp.broadcast_to(values, (*values.shape[:-1], worlds)).reshape(count, -1, worlds), 1)

    gaps = by_point(jnp.where(found.active, found.separation, jnp.inf))
    normals = list(zip(*(by_point(component) for component in found.normal), strict=True))
    gap, normal = gaps[0], Vec3(*normals[0])
    for other, direction in zip(gaps[1:], normals[1:], strict=True):
        nearer = settle(jnp.where(other < gap, 1.0, 0.0)) > 0.5
        gap, normal = jnp.where(nearer, other, gap), where(nearer, Vec3(*direction), normal)
    return gap, normal


def _first_touch(model: Model, group: PairGroup, pairs: _Pairs, share: Array) -> Array:
    """(pair, world) share of the step after which each pair touches; 1 if it does not."""
    ends = [take(share, side) for side in (group.bodies_a, group.bodies_b)]
    fast = _fast(pairs)
    zero = jnp.zeros_like(ends[0])
    gap, normal = _closest(model, group, pairs, zero, zero)
    touch = TOUCHING * pairs.size
    depth = jnp.minimum(gap, 0.0)
    further = SINKING * pairs.size * jnp.clip(1.0 + depth / (DEEPEST * pairs.size), LEAST_SINKING, 1.0)
    target = jnp.where(gap > 2.0 * touch, touch, depth - further)

    def bound(normal: Vec3, time: Array) -> Array:
        """Of the approach along the normal in a unit of time; a body at the end of its motion stands."""
        total = jnp.zeros(())
        for body, reach, end, sign in (
            (pairs.a, pairs.reach[0], ends[0], 1.0),
            (pairs.b, pairs.reach[1], ends[1], -1.0),
        ):
            own = dot(normal, body.shift) * sign
            # Standing later is no faster than either.
            own = jnp.where(end < 1, jnp.where(time < end, jnp.maximum(own, 0.0), 0.0), own)
            around = turning(norm(cross(normal, body.turn)), reach)
            total = total + own + jnp.where(time < end, around, 0.0)
        return total

    def advance(state: tuple) -> tuple:
        time, going, gap, normal, count = state
        rate = bound(normal, time)
        step = jnp.where(rate > 0, (gap - target) / jnp.where(rate > 0, rate, 1.0), jnp.inf)
        time = jnp.where(going, jnp.minimum(time + step, 1.0), time)
        gap, normal = _closest(model, group, pairs, jnp.minimum(time, ends[0]), jnp.minimum(time, ends[1]))
        left = settle(jnp.where(going & (gap - target > 0.5 * touch) & (time < 1.0), 1.0, 0.0)) > 0.5
        return time, left, gap, normal, count + 1

    going = fast & (gap > target)
    state = (jnp.zeros_like(gap), going, gap, normal, jnp.asarray(0))
    time, going, gap, _, _ = lax.while_loop(lambda s: s[1].any() & (s[4] < ADVANCES), advance, state)
    touches = fast & (going | (gap - target <= 0.5 * touch))
    return jnp.where(touches, time, 1.0)


def _lower(group: PairGroup, share: Array, touch: Array) -> Array:
    for side in (group.bodies_a, group.bodies_b):
        share = share.at[np.asarray(side)].min(touch)
    return share


def _newton_step(model: Model, group: PairGroup, pairs: _Pairs, share: Array) -> Array:
    """(pair, world) zero, with the derivative of the share at which the pair touches."""
    time = jnp.minimum(*(take(share, side) for side in (group.bodies_a, group.bodies_b)))
    gap, _ = _closest(model, group, pairs, time, time)
    fixed_model, fixed = lax.stop_gradient((model, pairs))
    ones = jnp.ones_like(time)
    rate = lax.stop_gradient(jax.jvp(lambda s: _closest(fixed_model, group, fixed, s, s)[0], (time,), (ones,))[1])
    approaches = (rate < 0) & (gap <= 2.0 * TOUCHING * pairs.size)
    step = jnp.where(approaches, gap / jnp.where(approaches, rate, 1.0), 0.0)
    return lax.stop_gradient(step) - step


def _differential(group: PairGroup, step: Array, share: Array) -> Array:
    """(body, world) the steps of the pairs that stopped each body: those whose two bodies stop at its own share."""
    ends = [take(share, side) for side in (group.bodies_a, group.bodies_b)]
    time = jnp.minimum(*ends)
    result = jnp.zeros_like(share)
    for side, end in zip((group.bodies_a, group.bodies_b), ends, strict=True):
        result = result.at[np.asarray(side)].add(jnp.where((end < 1) & (end == time), step, 0.0))
    return result
