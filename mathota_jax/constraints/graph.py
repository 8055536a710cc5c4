"""The contact graph (guide 12.2): which bodies touch or are joined, and the impulses that sleep with them."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.bodies import Edges
from mathota_jax.collision.bounds import admissible_pairs
from mathota_jax.collision.narrowphase import ContactSet
from mathota_jax.constraints import compact, compact_matching
from mathota_jax.constraints.joint_layout import joint_groups
from mathota_jax.constraints.slots import bodies_of_slots
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.spatial.indexing import gather
from mathota_jax.spatial.settle import settle
from mathota_jax.state import State

TOUCHING = 1e-3
"""Gap, as a share of the smaller body's inner radius, up to which bodies touch even if no force passes between them."""


def body_graph(
    model: Model, old: State, new: State, contacts: ContactSet | None, close: compact.ClosePairs | None
) -> Edges:
    """Bodies that touch or are joined.

    Args:
      model: parameters and static scene.
      old, new: states before and after the step; bodies that pushed each other in the last step are connected as well,
        so that who loses its support notices.
      contacts, close: those of the step.
    """
    scene = model.scene
    parts = [_joint_edges(scene)] if scene.joints else []
    if scene.pair_groups:
        assert contacts is not None
        slots = slice(0, scene.static_slot_count)
        first, second = (jnp.asarray(side, jnp.int32)[:, None] for side in scene.slot_bodies)
        touching = _touching(model, contacts, slots, first, second)
        parts.append(Edges(first, second, touching | _pushed(old, slots) | _pushed(new, slots)))
    if scene.broadphase is not None:
        assert contacts is not None and close is not None
        parts += _compact_edges(model, old, new, contacts, close)
    if not parts:
        none = jnp.zeros((0, 1), jnp.int32)
        return Edges(none, none, none > 0)
    worlds = max(field.shape[-1] for part in parts for field in part)
    return Edges(
        *(
            jnp.concatenate([jnp.broadcast_to(x, (x.shape[0], worlds)) for x in fields])
            for fields in zip(*parts, strict=True)
        )
    )


def _joint_edges(scene: Scene) -> Edges:
    parent, child = (
        jnp.asarray([getattr(entry, side) for entry in scene.joints], jnp.int32)[:, None]
        for side in ("parent", "child")
    )
    return Edges(parent, child, jnp.ones(parent.shape, bool))


def _compact_edges(
    model: Model, old: State, new: State, contacts: ContactSet, close: compact.ClosePairs
) -> list[Edges]:
    """Edges of the pairs that the broadphase found now, and of those that it had found in the last step."""
    scene = model.scene
    assert scene.broadphase is not None and old.contact_pair is not None
    body_of = jnp.asarray(admissible_pairs(scene).bodies, jnp.int32)
    count = len(scene.broadphase.shapes)
    slots = slice(scene.static_slot_count, scene.slot_count)
    first, second = compact.slot_bodies(scene, close)
    touching = _touching(model, contacts, slots, first, second) | _pushed(new, slots)
    per_place = np.repeat(
        np.arange(scene.place_count), [g.point_count for g in scene.compact_groups for _ in range(g.place_count)]
    )
    pair = old.contact_pair[per_place]
    known = jnp.maximum(pair, 0)
    return [
        Edges(first, second, touching),
        Edges(body_of[known // count], body_of[known % count], (pair != compact.NO_PAIR) & _pushed(old, slots)),
    ]


def _pushed(state: State, slots: slice) -> Array:
    """(slot, world) whether a force passed through each slot in the last step."""
    return (state.contact_force[slots] != 0).any(1)


def _touching(model: Model, contacts: ContactSet, slots: slice, first: Array, second: Array) -> Array:
    sizes = jnp.minimum(*(gather(model.size, side) for side in (first, second)))
    near = contacts.active[slots] & (contacts.separation[slots] <= TOUCHING * sizes)
    return settle(jnp.where(near, 1.0, 0.0)) > 0.5


def keep_forces(
    model: Model, old: State, new: State, close: compact.ClosePairs | None, sleepers: Array
) -> dict[str, Any]:
    """Forces of contacts and joints after the step; those between sleeping bodies stay what they were.

    Args:
      model: parameters and static scene.
      old, new: states before and after the step.
      close: pairs that the broadphase found in the step.
      sleepers: (body, world) bodies that slept all through the step.
    """
    scene = model.scene
    quiet = sleepers | jnp.asarray(scene.static)[:, None]
    joint_quiet = slot_quiet = None
    changes: dict[str, Any] = {}
    if scene.joints:
        rows = [(scene.joints[j].parent, scene.joints[j].child) for group in joint_groups(scene)
                for _ in range(group.row_count) for j in group.joints]  # fmt: skip
        parent, child = (np.asarray(side) for side in zip(*rows, strict=True))
        joint_quiet = quiet[parent] & quiet[child]
    if scene.slot_count:
        first, second = bodies_of_slots(scene, close)
        slot_quiet = gather(quiet, first) & gather(quiet, second)
        feature = _in_present_slots(scene, close, old, old.contact_force)[1]
        changes["contact_feature"] = jnp.where(slot_quiet, feature, new.contact_feature)
        if old.contact_offset is not None and new.contact_offset is not None:
            offset = _in_present_slots(scene, close, old, old.contact_offset)[0]
            changes["contact_offset"] = jnp.where(slot_quiet[:, None], offset, new.contact_offset)

    def kept(before: Any, after: Any) -> dict[str, Array]:
        found = {}
        if joint_quiet is not None:
            found["joint_force"] = jnp.where(joint_quiet, before.joint_force, after.joint_force)
        if slot_quiet is not None:
            force = _in_present_slots(scene, close, old, before.contact_force)[0]
            found["contact_force"] = jnp.where(slot_quiet[:, None], force, after.contact_force)
        return found

    changes.update(kept(old, new))
    if new.end_forces is not None:
        changes["end_forces"] = dataclasses.replace(new.end_forces, **kept(old.end_forces, new.end_forces))
    return changes


def _in_present_slots(scene: Scene, close: compact.ClosePairs | None, old: State, force: Array) -> tuple[Array, Array]:
    """Forces (slot, 3, world) of the last step, and their features, in the slots where their pairs are now."""
    if close is None:
        return force, old.contact_feature
    assert old.contact_pair is not None
    return compact_matching.carried(scene, close, force, old.contact_feature, old.contact_pair)
