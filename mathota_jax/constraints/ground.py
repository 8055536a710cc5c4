"""What bodies rest on: of their contacts with static shapes the one whose normal is most upward."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import Bodies
from mathota_jax.collision.narrowphase import ContactSet
from mathota_jax.collision.placement import shape_parameters, shape_poses
from mathota_jax.constraints import compact
from mathota_jax.constraints.flush import (
    FLUSH,
    Ground,
    PlacedShape,
    decide,
    is_slanted,
    lies_flush,
    may_be_flush,
)
from mathota_jax.model import Model
from mathota_jax.scene import PairGroup, Scene
from mathota_jax.spatial.indexing import gather, in_every_world, take
from mathota_jax.spatial.quaternion import exponential, to_matrix
from mathota_jax.spatial.settle import settle
from mathota_jax.spatial.vector import Vec3, cross, dot


class Touch(NamedTuple):
    """Contacts of bodies with what is static, components (slot, world).

    Attributes:
      upward: how much of its normal is against gravity [m/s^2]; 0 where nothing touches or it is downward.
      normal: towards the body.
      foot: the point on the static shape.
    """

    upward: Array
    normal: Vec3
    foot: Vec3


def has_seams(scene: Scene) -> bool:
    """Whether bodies may rest on one static shape and meet another one, which may be flush with it."""
    shapes = _own_grounds(scene)
    if scene.broadphase is not None and compact.groups_with_static(scene):
        taking_part = [scene.shapes[place] for place in scene.broadphase.shapes]
        shapes |= {(shape.kind, shape.index) for shape in taking_part if scene.static[shape.body]}
    # Planes end nowhere, and nothing is flush with a heightfield but what is not one.
    finite = {shape for shape in shapes if shape[0] != "plane"}
    return len(finite) > 1 and any(kind != "heightfield" for kind, _ in finite)


def _own_grounds(scene: Scene) -> set[tuple[str, int]]:
    """Kinds and rows of the static shapes but planes in pairs with slots of their own."""
    return {
        (kind, row)
        for group in scene.pair_groups
        if "plane" not in (group.kind_a, group.kind_b)
        for kind, rows, owners in _sides(group)
        for row, body in zip(rows, owners, strict=True)
        if scene.static[body]
    }


def find_ground(
    model: Model,
    bodies: Bodies,
    own: ContactSet | None,
    close: compact.ClosePairs | None,
    with_static: dict[int, ContactSet],
) -> Ground:
    """The ground of each body, without derivative.

    Args:
      model: parameters and static scene.
      bodies: all of them.
      own: contacts of the pairs that have slots of their own.
      close, with_static: pairs that the broadphase found, and their contacts with static bodies by `compact`.
    """
    model, bodies, own, with_static = lax.stop_gradient((model, bodies, own, with_static))
    found = []
    if own is not None and _own_grounds(model.scene):
        found.append(_most_upward_of_own(model, own))
    if close is not None and with_static:
        found.append(_most_upward_of_close(model, close, with_static))
    best = found[0]
    for other in found[1:]:
        higher = settle((other.upward > best.upward).astype(best.foot.x.dtype)) > 0.5
        best = jax.tree.map(functools.partial(jnp.where, higher), other, best)
    return _ground(model, bodies, best)


def without_flush(model: Model, bodies: Bodies, ground: Ground, contacts: ContactSet) -> ContactSet:
    """The contacts of pairs with slots of their own, without those with shapes that are flush with the ground."""
    scene, worlds = model.scene, contacts.separation.shape[-1]
    model, bodies, found = lax.stop_gradient((model, bodies, contacts._replace(converged=None)))
    flush, first = [], 0
    for group in scene.pair_groups:
        slots = range(first, first + group.slot_count)
        first = slots.stop
        moves = _moving_side(scene, group)
        if not may_be_flush(group.kind_a, group.kind_b) or not moves.any():
            flush.append(jnp.zeros((len(slots), worlds), bool))
            continue
        mover = np.where(moves < 0, group.bodies_a, group.bodies_b)
        sides = (
            PlacedShape(
                kind,
                shape_parameters(scene, model.shapes, kind, rows),
                shape_poses(model.shapes, kind, rows, owners, bodies.position, bodies.orientation),
            )
            for kind, rows, owners in _sides(group)
        )
        below = lies_flush(take(ground, mover), *sides, a_is_static=moves[:, None] > 0) & (moves[:, None] != 0)
        below = jnp.repeat(jnp.broadcast_to(below, (len(mover), worlds)), group.point_count, axis=0)
        slanted = is_slanted(take(ground, np.repeat(mover, group.point_count)), take(found.normal, slots))
        flush.append(below & slanted)
    return contacts._replace(active=contacts.active & ~decide(jnp.concatenate(flush), contacts.separation.dtype))


def _sides(group: PairGroup) -> tuple[tuple[str, tuple[int, ...], tuple[int, ...]], ...]:
    return (group.kind_a, group.shapes_a, group.bodies_a), (group.kind_b, group.shapes_b, group.bodies_b)


def _moving_side(scene: Scene, group: PairGroup) -> np.ndarray:
    """(pair,) 1 where body B alone moves, -1 where body A does, else 0."""
    static = np.asarray(scene.static, int)
    return static[list(group.bodies_a)] - static[list(group.bodies_b)]


def _touch(model: Model, contacts: ContactSet, toward: Array | np.ndarray, size: Array) -> Touch:
    """Contacts with what is static; `toward` is the sign (slot, world or 1) of their normals on the body that moves."""
    normal = contacts.normal * toward
    touches = contacts.active & (contacts.separation <= FLUSH * size)
    gravity = Vec3(*(model.gravity[axis][None] for axis in range(3)))
    upward = jnp.where(touches, jnp.maximum(-dot(normal, gravity), 0.0), 0.0)
    return Touch(settle(upward), normal, contacts.position - normal * (0.5 * contacts.separation))


def _most_upward_of_own(model: Model, contacts: ContactSet) -> Touch:
    """(body, world) of the contacts with slots of their own."""
    scene, count = model.scene, len(model.scene.static)
    slots_of: list[list[int]] = [[] for _ in range(count)]
    toward, mover = [], []
    for group in scene.pair_groups:
        sides = zip(_moving_side(scene, group), group.bodies_a, group.bodies_b, strict=True)
        for side, a, b in sides:
            if side and "plane" not in (group.kind_a, group.kind_b):
                slots_of[b if side > 0 else a] += range(len(toward), len(toward) + group.point_count)
            toward += [side] * group.point_count
            mover += [b if side > 0 else a] * group.point_count
    touch = _touch(model, contacts, np.asarray(toward)[:, None], take(model.size, mover))
    most = max(map(len, slots_of))
    # Bodies of fewer slots name one of them again; those of none name any, which counts for nothing.
    padded = np.asarray([(slots * most)[:most] if slots else [0] * most for slots in slots_of])
    upward = jnp.broadcast_to(touch.upward, (len(toward), contacts.separation.shape[-1]))
    upward = take(upward, padded.ravel()).reshape(*padded.shape, -1)
    upward = jnp.where(np.asarray([[bool(slots)] for slots in slots_of])[..., None], upward, 0.0)
    chosen = jnp.take_along_axis(jnp.asarray(padded, jnp.int32), upward.argmax(1), axis=1)
    return _of_chosen(touch, chosen, upward.max(1))


def _most_upward_of_close(model: Model, close: compact.ClosePairs, with_static: dict[int, ContactSet]) -> Touch:
    """(body, world) of the contacts of the pairs that the broadphase found."""
    scene, parts, movers = model.scene, [], []
    for number, found in with_static.items():
        group = scene.compact_groups[number]
        mover, b_moves = compact.moving_side(scene, close.groups[number].pair)
        mover, b_moves = (jnp.repeat(part, group.point_count, axis=0) for part in (mover, b_moves))
        parts.append(_touch(model, found, jnp.where(b_moves, 1.0, -1.0), gather(model.size, mover)))
        movers.append(mover)
    touch = jax.tree.map(lambda *values: jnp.concatenate(values), *in_every_world(parts, close.overflow.shape[-1]))
    mover, worlds = jnp.concatenate(movers), touch.upward.shape[-1]
    world, count = jnp.arange(worlds), len(scene.static)
    best = jnp.zeros((count, worlds), touch.upward.dtype).at[mover, world].max(touch.upward)
    slot = jnp.arange(len(mover), dtype=jnp.int32)[:, None]
    is_best = touch.upward == gather(best, mover)
    chosen = jnp.zeros((count, worlds), jnp.int32).at[mover, world].max(jnp.where(is_best, slot, 0))
    return _of_chosen(touch, chosen, best)


def _of_chosen(touch: Touch, slot: Array, upward: Array) -> Touch:
    """(body, world) of a slot for each body."""
    return Touch(upward, *(vector.map(lambda x: gather(x, slot)) for vector in (touch.normal, touch.foot)))


def _ground(model: Model, bodies: Bodies, touch: Touch) -> Ground:
    """The ground stops the point that rests on it, and with it the body."""
    normal = touch.normal * settle(jnp.where(touch.upward > 0, 1.0, 0.0))
    arm = touch.foot - bodies.position
    speed = dot(bodies.velocity + cross(bodies.angular_velocity, arm), normal)
    rise = model.dt * (dot(bodies.velocity, normal) - jnp.minimum(speed, 0.0))
    turn = to_matrix(exponential(bodies.angular_velocity * model.dt))
    return Ground(normal, turn.apply_transposed(normal), bodies.position, dot(arm, normal), rise, model.size)
