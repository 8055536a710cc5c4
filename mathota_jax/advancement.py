"""When two shapes that move uniformly touch first: conservative advancement; all components (1, world).

Two convex shapes are parted by the plane across their closest points. Along its normal n they approach by their
velocities, and by turning: no faster than ``|n x omega|`` times the reach, and in all by no more than what the reach exceeds
their present extent along n. No contact comes before all of that closes the gap (B. Mirtich, "Impulse-based Dynamic
Simulation", 1996, section 2.3; the bound of the whole turn is ours: without it a fast spinning shape hardly advances).

A heightfield is not convex, and only the cells under the other shape are known. Above its highest point the time until that
is reached is safe; below, the motion is sampled, and the time of the first overlap found by bisection.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.manifold import Nearest
from mathota_jax.geometry.leaves import Geometry
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, exponential, multiply, normalize, to_matrix
from mathota_jax.spatial.settle import settle
from mathota_jax.spatial.vector import Vec3, cross, dot, norm

TURNS, SAMPLES = 512, 8192
"""Most evaluations of the distance of convex shapes, and beside a heightfield."""
SAMPLE = 1 / 16
"""Beside a heightfield no point moves by more than this share of the other shape's reach between two samples."""


class Mover(NamedTuple):
    """A shape in uniform motion, components (1, world). `reach` is the radius of the sphere about its origin around it."""

    geometry: Geometry
    position: Vec3
    orientation: Quaternion
    velocity: Vec3
    angular_velocity: Vec3
    reach: Array

    def at(self, time: Array) -> Pose:
        """The pose at a time [s]."""
        turned = normalize(multiply(exponential(self.angular_velocity * time), self.orientation))
        return Pose(self.position + self.velocity * time, to_matrix(turned))


class Contact(NamedTuple):
    """End of the search.

    Attributes:
      time: [s] of the first contact; that up to which there is none if none was found.
      hit: bool, the shapes touch then.
      searched: bool, the search ended with a contact or with the duration, not with its limit.
      found: closest points at that time.
    """

    time: Array
    hit: Array
    searched: Array
    found: Nearest


def first_contact(a: Mover, b: Mover, nearest: Callable[[Array], Nearest], duration: Array, touching: Array) -> Contact:
    """First time within the duration at which the gap is at most `touching` [m].

    Args:
      a: the first mover; the search is not differentiable.
      b: the second one.
      nearest: closest points at a time.
      duration: [s].
      touching: a gap [m] of this size is none.
    """
    components = (*a.position, *a.velocity, *b.position, *b.velocity, duration)
    start = jnp.zeros(jnp.broadcast_shapes(*(jnp.shape(component) for component in components)), duration.dtype)
    search = _sample if "heightfield" in (a.geometry.kind, b.geometry.kind) else _advance
    found = search(a, b, nearest, start, duration, touching)
    # Where a motion is not finite no comparison says anything.
    known = jnp.isfinite(duration) | (duration > 0)
    for mover in (a, b):
        for component in (*mover.position, *mover.orientation, *mover.velocity, *mover.angular_velocity):
            known = known & jnp.isfinite(component)
    return found._replace(
        time=jnp.where(known, found.time, jnp.nan), hit=found.hit & known, searched=found.searched & known
    )


class _Advance(NamedTuple):
    turn: Array
    time: Array
    hit: Array
    done: Array
    last: tuple[Array, Nearest]


def _advance(
    a: Mover, b: Mover, nearest: Callable[[Array], Nearest], start: Array, duration: Array, touching: Array
) -> Contact:
    """Contact of convex shapes, by safe steps."""

    def advance(state: _Advance) -> _Advance:
        found = _everywhere(nearest(state.time), start)
        gap = found.separation - touching
        ahead = jnp.minimum(state.time + _safe_step(a, b, state.time, found, gap), duration)
        late = state.time >= duration
        # A step that the clock does not resolve leaves no gap either.
        code = settle(jnp.where((gap <= 0) | ((ahead <= state.time) & ~late), 2.0, jnp.where(late, 1.0, 0.0)))
        time = jnp.where(code > 0.5, state.time, ahead)
        return _Advance(state.turn + 1, time, code > 1.5, code > 0.5, (state.time, found))

    no, nowhere = start > 0, Vec3(start, start, start)
    last = start, Nearest(start, nowhere, nowhere, nowhere, no)
    state = _Advance(jnp.zeros((), jnp.int32), start, no, no, last)
    state = lax.while_loop(lambda s: (s.turn < TURNS) & ~jnp.all(s.done), advance, state)
    # Evaluated once more, the closest points would be compiled once more.
    return Contact(state.last[0], state.hit, state.done, state.last[1])


def _everywhere(found: Nearest, like: Array) -> Nearest:
    """In every world, and with a word about convergence."""
    converged = jnp.ones(like.shape, bool) if found.converged is None else found.converged
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, like.shape), found._replace(converged=converged))


def _safe_step(a: Mover, b: Mover, time: Array, found: Nearest, gap: Array) -> Array:
    """Time in which convex shapes can not close a gap.

    What they close of it in a time t is at most the sum of ``v t`` and, for each shape, the lesser of ``rate t`` and `room`;
    so it takes at least as long as with any choice of the two.
    """
    speed = dot(found.normal, a.velocity - b.velocity)
    turns = [_turn(a, time, found.normal, found.point_a), _turn(b, time, -found.normal, found.point_b)]
    longest = jnp.zeros_like(gap)
    for choice in itertools.product((False, True), repeat=2):
        slope, needed = speed, gap
        for bounded, (rate, room) in zip(choice, turns, strict=True):
            slope, needed = (slope, needed - room) if bounded else (slope + rate, needed)
        closing = slope > 0
        never = jnp.where(needed > 0, jnp.inf, 0.0)
        longest = jnp.maximum(longest, jnp.where(closing, needed / jnp.where(closing, slope, 1.0), never))
    return longest


def _turn(mover: Mover, time: Array, outward: Vec3, point: Vec3) -> tuple[Array, Array]:
    """How fast turning can move a shape's support along a fixed direction [m/s], now or later, and how far in all [m].

    ``n . (omega x r) = r . (n x omega)``, and omega stays. `point` is the support now. An infinite shape has no bound.
    """
    if mover.geometry.kind == "sphere":
        return jnp.zeros(()), jnp.zeros(())
    across = norm(cross(outward, mover.angular_velocity))
    extent = dot(outward, point - (mover.position + mover.velocity * time))
    room = jnp.maximum(mover.reach - extent, 0.0)
    return jnp.where(across > 0, across * mover.reach, 0.0), jnp.where(across > 0, room, 0.0)


class _Sample(NamedTuple):
    turn: Array
    free: Array
    overlap: Array
    done: Array


def _sample(
    a: Mover, b: Mover, nearest: Callable[[Array], Nearest], start: Array, duration: Array, touching: Array
) -> Contact:
    """Contact with a heightfield: the first sample that overlaps, and then the time between it and the one before."""
    field, other = (a, b) if a.geometry.kind == "heightfield" else (b, a)
    speed = norm(a.velocity - b.velocity) + sum(norm(mover.angular_velocity) * mover.reach for mover in (a, b))
    inverse = jnp.where(speed > 0, 1.0 / jnp.where(speed > 0, speed, 1.0), jnp.inf)
    highest = jnp.max(field.geometry.parameters["heights"], axis=(0, 1))

    def overlaps(time: Array) -> Array:
        return settle(jnp.where(nearest(time).separation <= touching, 1.0, 0.0)) > 0.5

    def probe(free: Array, overlap: Array) -> Array:
        pose = field.at(free)
        assert pose.rotation is not None
        height = dot(pose.rotation.column_y, other.position + other.velocity * free - pose.position)
        step = jnp.maximum(height - highest - other.reach, SAMPLE * other.reach) * inverse
        found = jnp.isfinite(overlap)
        middle = 0.5 * (free + jnp.where(found, overlap, free))
        return settle(jnp.where(found, middle, jnp.minimum(free + step, duration)))

    def advance(state: _Sample) -> _Sample:
        time = probe(state.free, state.overlap)
        closed = overlaps(time)
        free, overlap = jnp.where(closed, state.free, time), jnp.where(closed, time, state.overlap)
        between = probe(free, overlap)
        return _Sample(state.turn + 1, free, overlap, (between <= free) | (between >= overlap))

    overlap = jnp.where(overlaps(start), start, jnp.inf)
    state = _Sample(jnp.zeros((), jnp.int32), start, overlap, jnp.isfinite(overlap))
    state = lax.while_loop(lambda s: (s.turn < SAMPLES) & ~jnp.all(s.done), advance, state)
    hit = jnp.isfinite(state.overlap) & state.done
    time = jnp.where(hit, state.overlap, state.free)
    return Contact(time, hit, state.done, _everywhere(nearest(time), start))
