"""Which bodies fly past each other: the spheres about them do not meet on their way.

What joints make of the way is not known beforehand, and what other contacts make of it only within bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import Bodies, of_all_bodies
from mathota_jax.collision.narrowphase import ContactSet
from mathota_jax.collision.placement import shape_reach
from mathota_jax.model import Model
from mathota_jax.scene import PairGroup, Scene
from mathota_jax.spatial.indexing import take, unstack
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.spread import add_slices
from mathota_jax.spatial.vector import Vec3, dot, norm

DEFLECTION = 3.0
"""Largest change of a body's velocity by a contact over the approach that it ends: twice that of a rebound from something
far heavier, and what friction adds."""


LEAST_TURN = 0.01
"""Angle [rad] in a step up to which bodies meet where their contacts are: others come closer by no more of their size."""


class Way(NamedTuple):
    """What bodies may do in some time if nothing stops them; components (body, world) [m].

    Attributes:
      start: centres of mass.
      path: displacement.
      bend: by how much the way may depart from its chord: under a constant acceleration by ``|a| t^2 / 8``.
    """

    start: Vec3
    path: Vec3
    bend: Vec3


def ways(scene: Scene, bodies: Bodies, now: Array, then: Array, left: Array) -> Way:
    """Of all bodies, without derivative.

    Args:
      scene: static structure.
      bodies: all of them.
      now, then: (component, block, world) velocities now and after the time `left` without constraints.
      left: (1, world) time [s].
    """
    bodies, now, then, left = lax.stop_gradient((bodies, now, then, left))
    mean, change = (Vec3(*unstack(part[:3], 0)) for part in (0.5 * (now + then), then - now))
    path, bend = of_all_bodies(scene, mean * left), of_all_bodies(scene, change * (0.125 * left))
    return Way(bodies.position, path, bend)


def largest_turn(scene: Scene, bodies: Bodies, free: Vec3, time: Array) -> Array:
    """(body, world) angle [rad] by which bodies turn at most; `free` are spins of the moving ones without constraints."""
    return jnp.maximum(norm(bodies.angular_velocity), norm(of_all_bodies(scene, free))) * time


def stay_apart(a: Way, b: Way, reach: Array) -> Array:
    """Whether bodies that reach so far from their centres of mass, together, do not meet, however they turn."""
    start, path = b.start - a.start, b.path - a.path
    share = jnp.clip(safe_divide(-dot(start, path), dot(path, path)), 0.0, 1.0)
    return norm(start + path * share) - norm(b.bend - a.bend) > reach


def misses(model: Model, way: Way) -> Array | None:
    """(slot, world) which pairs of bodies with slots of their own stay apart; None where all are with planes."""
    if not _may_miss(model.scene):
        return None
    return _by_slot(model.scene, [_stays_apart(model, group, way, None) for group in model.scene.pair_groups])


def undisturbed(model: Model, way: Way, turn: Array, contacts: ContactSet) -> Array | None:
    """The same, whatever other contacts make of the ways: those that may act within the step deflect bodies.

    Args:
      model: parameters and static scene.
      way: what bodies do if nothing stops them.
      turn: (body, world) angle [rad] by which they turn at most.
      contacts: those with slots of their own.
    """
    scene = model.scene
    if not _may_miss(scene):
        return None
    deflection = DEFLECTION * _sum_by_body(scene, _all_strikes(model, way, turn, contacts))
    apart = _by_slot(scene, [_stays_apart(model, group, way, deflection) for group in scene.pair_groups])
    return apart & np.asarray([[scene.jointed.isdisjoint(pair)] for pair in zip(*scene.slot_bodies, strict=True)])


def may_strike(model: Model, way: Way, turn: Array, contacts: ContactSet) -> Array:
    """(pair, world) which pairs may meet elsewhere than at their contacts, since they turn; arguments as above."""
    groups = model.scene.pair_groups
    turn = lax.stop_gradient(turn)
    turns = take(turn, [b for g in groups for b in g.bodies_a]) + take(turn, [b for g in groups for b in g.bodies_b])
    round_ones = [{g.kind_a, g.kind_b} <= {"plane", "sphere"} for g in groups for _ in g.bodies_a]
    strikes = _all_strikes(model, way, turn, contacts) > 0
    return strikes & (turns > LEAST_TURN) & ~np.asarray(round_ones)[:, None]


def _all_strikes(model: Model, way: Way, turn: Array, contacts: ContactSet) -> Array:
    """`_strikes` of the pairs with slots of their own, group by group; without derivative."""
    contacts, turn = lax.stop_gradient((contacts._replace(converged=None), turn))
    found, first = [], 0
    for group in model.scene.pair_groups:
        slots = range(first, first + group.slot_count)
        found.append(_strikes(model, group, way, turn, take(contacts, slots)))
        first = slots.stop
    return jnp.concatenate(found)


def _strikes(model: Model, group: PairGroup, way: Way, turn: Array, contacts: ContactSet) -> Array:
    """(pair, world) way [m] of the bodies of a group towards each other that their contact may end; 0 if it can not act."""
    pairs, worlds = len(group.bodies_a), way.path.x.shape[-1]

    def by_point(values: Array) -> Array:
        return jnp.broadcast_to(values, (group.slot_count, worlds)).reshape(pairs, -1, worlds)

    def by_pair(values: Array) -> Array:
        return jnp.broadcast_to(values, (pairs, worlds))[:, None]

    middle, normal = contacts.position.map(by_point), contacts.normal.map(by_point)
    separation, active = by_point(contacts.separation), by_point(contacts.active)
    (a, turn_a), (b, turn_b) = (take((way, turn), side) for side in (group.bodies_a, group.bodies_b))
    approach = by_pair(norm(b.bend - a.bend)) - dot((b.path - a.path).map(by_pair), normal)
    for kind, rows, of_body, angle, sign in (
        (group.kind_a, group.shapes_a, a, turn_a, 1.0),
        (group.kind_b, group.shapes_b, b, turn_b, -1.0),
    ):
        extent = sign * dot(middle - of_body.start.map(by_pair), normal) - 0.5 * separation
        reach, swung = _reach(model, kind, rows)
        closer, arc = jnp.maximum(by_pair(reach) - extent, 0.0), by_pair(angle * swung)
        approach = approach + jnp.where(by_pair(angle) > 0, jnp.minimum(arc, closer), 0.0)
    approach = jnp.maximum(approach, 0.0)
    may_act = active & (separation <= approach) & ~_stays_apart(model, group, way, None)[:, None]
    return jnp.where(may_act, approach + jnp.maximum(-separation, 0.0), 0.0).max(1)


def _sum_by_body(scene: Scene, values: Array) -> Array:
    """(body, world) sums of values of pairs (pair, world) over the pairs of each moving body; 0 for static ones."""
    pairs_of: list[list[int]] = [[] for _ in scene.static]
    pairs = [pair for group in scene.pair_groups for pair in zip(group.bodies_a, group.bodies_b, strict=True)]
    for number, pair in enumerate(pairs):
        for body in pair:
            if not scene.static[body]:
                pairs_of[body].append(number)
    most = max(map(len, pairs_of))
    padded = [(found + [len(pairs)] * most)[:most] for found in pairs_of]
    of_pairs = take(jnp.concatenate([values, jnp.zeros_like(values[:1])]), np.ravel(padded))
    of_pairs = jnp.broadcast_to(of_pairs, (len(padded) * most, values.shape[-1])).reshape(len(padded), most, -1)
    return add_slices(of_pairs, 1)


def _may_miss(scene: Scene) -> bool:
    return not all("plane" in (group.kind_a, group.kind_b) for group in scene.pair_groups)


def _by_slot(scene: Scene, apart: list[Array]) -> Array:
    return jnp.concatenate(
        [jnp.repeat(pairs, group.point_count, axis=0) for pairs, group in zip(apart, scene.pair_groups, strict=True)]
    )


def _stays_apart(model: Model, group: PairGroup, way: Way, deflection: Array | None) -> Array:
    """(pair, world) `stay_apart` of a group, though each body may be deflected (body, world) [m]; nothing misses a plane."""
    shape = (len(group.bodies_a), way.path.x.shape[-1])
    if "plane" in (group.kind_a, group.kind_b):
        return jnp.zeros(shape, bool)
    a, b = (take(way, side) for side in (group.bodies_a, group.bodies_b))
    reach = _reach(model, group.kind_a, group.shapes_a)[0] + _reach(model, group.kind_b, group.shapes_b)[0]
    if deflection is not None:
        reach = reach + take(deflection, group.bodies_a) + take(deflection, group.bodies_b)
    return jnp.broadcast_to(stay_apart(a, b, reach), shape)


def _reach(model: Model, kind: str, rows: Sequence[int]) -> tuple[Array, Array]:
    """`shape_reach` without derivative."""
    return shape_reach(model.scene, lax.stop_gradient(model.shapes), kind, rows)
