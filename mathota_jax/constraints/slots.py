"""All contact slots of a scene: those of pairs that have their own, and behind them those of the close pairs."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.bodies import Bodies, vector
from mathota_jax.collision.narrowphase import ContactSet, find_contacts, join_contacts, stored
from mathota_jax.constraints import compact, compact_matching, warm_start
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.spatial.indexing import gather
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Vec3
from mathota_jax.state import State


def find_slots(
    model: Model, bodies: Bodies, free: tuple[Vec3, Vec3] | None
) -> tuple[ContactSet, compact.ClosePairs | None]:
    """Contacts in all slots, and the close pairs behind them; for scenes that have slots.

    Args:
      model: parameters and static scene.
      bodies: all bodies.
      free: as for `compact.close_pairs`.
    """
    scene, found, close = model.scene, own_contacts(model, bodies), None
    if scene.broadphase is not None:
        close = compact.close_pairs(model, bodies, free)
        found += compact.contacts_of(model, bodies, close)
    return join_contacts(found), close


def own_contacts(model: Model, bodies: Bodies) -> list[ContactSet]:
    """Contacts of the pairs that have slots of their own: one set, or none."""
    if not model.scene.pair_groups:
        return []
    return [stored(find_contacts(model.scene, model.shapes, bodies.position, bodies.orientation), bodies.position.x)]


def bodies_of_slots(scene: Scene, close: compact.ClosePairs | None) -> tuple[Array, Array]:
    """(slot, world or 1) bodies A and B of all slots."""
    first, second = (jnp.asarray(side, jnp.int32).reshape(-1, 1) for side in scene.slot_bodies)
    if close is None:
        return first, second
    found = compact.slot_bodies(scene, close)
    first, second = (
        jnp.concatenate([jnp.broadcast_to(own, (own.shape[0], more.shape[-1])), more])
        for own, more in zip((first, second), found, strict=True)
    )
    return first, second


def contact_offsets(
    model: Model, bodies: Bodies, contacts: ContactSet, close: compact.ClosePairs | None
) -> Vec3 | None:
    """(slot, world) as `State.contact_offset` keeps them; None in scenes that do not. Without derivative."""
    if not warm_start.matches_by_distance(model.scene):
        return None
    model, bodies, contacts = lax.stop_gradient((model, bodies, contacts))
    sizes = jnp.where(jnp.asarray(model.scene.static)[:, None], jnp.inf, model.size)
    first, second = bodies_of_slots(model.scene, close)
    size_a, size_b = gather(sizes, first), gather(sizes, second)
    smaller = size_a < size_b
    size = jnp.where(smaller, size_a, size_b)

    def offset(point: Array, center: Array) -> Array:
        return (point - jnp.where(smaller, gather(center, first), gather(center, second))) / size

    return Vec3(*(offset(*pair) for pair in zip(contacts.position, bodies.position, strict=True)))


def matched_force(
    scene: Scene,
    contacts: ContactSet,
    offset: Vec3 | None,
    close: compact.ClosePairs | None,
    state: State,
    force: Array,
) -> Vec3:
    """Forces (slot, world) of the last step in the slots where their contacts are now; 0 for new ones.

    Args:
      scene, contacts, offset, close: static structure, and what is close in this step; `offset` by `contact_offsets`.
      state: of the last step.
      force: (slot, 3, world) where they were then.
    """
    before = None if state.contact_offset is None else vector(state.contact_offset)
    old, new = warm_start.Marks(state.contact_feature, before), warm_start.Marks(contacts.feature, offset)
    known = (old, new, contacts.active, vector(force))
    parts = compute_once(warm_start.matched_force(scene, *known), force)
    if close is not None:
        assert state.contact_pair is not None
        parts += compact_matching.matched_force(scene, close, *known, state.contact_pair)
    return warm_start.join_forces(parts)
