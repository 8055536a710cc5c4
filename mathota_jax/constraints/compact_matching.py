"""Which place held a pair in the last step, so that the impulses of its contacts carry over (guide 7.3)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.broadphase import PairList
from mathota_jax.collision.broadphase.ranges import lower_bound
from mathota_jax.constraints.compact import NO_PAIR, ClosePairs, filled, pair_key
from mathota_jax.constraints.warm_start import NO_FEATURE, Marks, is_steady, matched_points
from mathota_jax.scene import Scene
from mathota_jax.spatial.chunks import map_filled
from mathota_jax.spatial.indexing import gather, in_every_world, take
from mathota_jax.spatial.vector import Vec3


def pair_keys(scene: Scene, close: ClosePairs) -> Array:
    """(place, world) what `State.contact_pair` keeps."""
    keys = [pair_key(scene, *p.pair) for p in close.groups]
    return jnp.concatenate([jnp.where(p.active, key, NO_PAIR) for p, key in zip(close.groups, keys, strict=True)])


def matched_force(
    scene: Scene, close: ClosePairs, old: Marks, new: Marks, active: Array, force: Vec3, pair: Array
) -> list[Vec3]:
    """Forces of the last step in the slots where their contacts are now, a vector for each compact group.

    Args:
      scene, close: static structure, and what is close in this step.
      old, new, active, force, pair: of all slots (slot, world), and what the state keeps (place, world).
    """
    assert scene.broadphase is not None
    one_by_one = scene.broadphase.one_by_one
    sources = [] if one_by_one else _sources(scene, close, pair)
    parts, slot = [], scene.static_slot_count
    for number, (group, p) in enumerate(zip(scene.compact_groups, close.groups, strict=True)):
        rows = range(slot, slot + group.slot_count)
        shape, steady = (group.place_count, group.point_count, -1), is_steady(group)
        if steady:
            old_marks, new_marks = old._replace(offset=None), new._replace(offset=None)
        else:
            old_marks, new_marks = old, new
        taken = take(((new_marks, active), (old_marks, force)), rows)
        now, then = jax.tree.map(lambda x, shape=shape: x.reshape(shape), taken)

        def matched(
            places: tuple, number: int = number, then: tuple[Marks, Vec3] = then, steady: bool = steady
        ) -> Vec3:
            where, (marks, present) = places
            source, known = _known_places(scene, pair, number, *where) if one_by_one else where
            kept, old_force = jax.tree.map(lambda x: gather(x, source), then)
            kept = kept._replace(feature=jnp.where(known[:, None], kept.feature, NO_FEATURE))
            return matched_points(kept, marks, present, old_force, scene.options.warm_start_match, steady)

        if one_by_one:
            parts.append(map_filled(matched, ((pair_key(scene, *p.pair), p.active), now), filled(p)))
        else:
            parts.append(matched((sources[number], now)))
        slot += group.slot_count
    return parts


def carried(scene: Scene, close: ClosePairs, force: Array, feature: Array, pair: Array) -> tuple[Array, Array]:
    """Forces (slot, 3, world) and features (slot, world) of the last step in the slots where their pairs are now.

    Args:
      scene, close: static structure, and what is close in this step.
      force, feature, pair: what the state keeps: (slot, 3, world), (slot, world) and (place, world).
    """
    own = range(scene.static_slot_count)
    forces, features = [take(force, own)] if own else [], [take(feature, own)] if own else []
    slot = scene.static_slot_count
    for group, (source, known) in zip(scene.compact_groups, _sources(scene, close, pair), strict=True):
        points = jnp.arange(group.point_count, dtype=jnp.int32)[None, :, None]
        slots = slot + source[:, None] * group.point_count + points
        slots = slots.reshape(group.slot_count, -1)
        known = jnp.repeat(known, group.point_count, axis=0)
        forces.append(jnp.where(known[:, None], gather(force, slots), 0.0))
        features.append(jnp.where(known, gather(feature, slots), NO_FEATURE))
        slot += group.slot_count
    worlds = max(values.shape[-1] for values in (*forces, *features))

    def join(parts: list[Array]) -> Array:
        return jnp.concatenate([jnp.broadcast_to(part, (*part.shape[:-1], worlds)) for part in parts])

    return join(forces), join(features)


def _sources(scene: Scene, close: ClosePairs, pair: Array) -> list[tuple[Array, Array]]:
    """For each compact group, (place, world): its place that held the pair in the last step, and whether there was one."""
    assert scene.broadphase is not None
    if scene.broadphase.one_by_one:
        places = enumerate(close.groups)
        return [_known_places(scene, pair, number, pair_key(scene, *p.pair), p.active) for number, p in places]
    previous = _previous_places(scene, close.found, pair)
    sources, first = [], 0
    for group, p in zip(scene.compact_groups, close.groups, strict=True):
        source = gather(previous, p.listed) - first
        known = p.active & (source >= 0) & (source < group.place_count)
        sources.append((jnp.clip(source, 0, group.place_count - 1), known))
        first += group.place_count
    return sources


def _known_places(scene: Scene, pair: Array, number: int, key: Array, active: Array) -> tuple[Array, Array]:
    """`_sources` of some places of the group `number`, where each pair has a turn of its own: the keys of a group ascend."""
    counts = [group.place_count for group in scene.compact_groups]
    first = sum(counts[:number])
    old = take(pair, range(first, first + counts[number]))
    old = jnp.where(old == NO_PAIR, jnp.iinfo(jnp.int32).max, old)
    place = jnp.minimum(lower_bound(old, key), counts[number] - 1)
    return place, active & (gather(old, place) == key)


def _previous_places(scene: Scene, found: PairList, pair: Array) -> Array:
    """(listed pair, world) place that held the pair in the last step, -1 for none."""
    keys = jnp.where(found.active, pair_key(scene, found.first, found.second), jnp.iinfo(jnp.int32).max)
    count = keys.shape[0]
    pair = in_every_world(pair, max(pair.shape[-1], keys.shape[-1]))
    where = lower_bound(keys, pair)
    same = (pair != NO_PAIR) & (where < count) & (gather(keys, jnp.minimum(where, count - 1)) == pair)
    places = jnp.broadcast_to(jnp.arange(pair.shape[0], dtype=jnp.int32)[:, None], where.shape)
    target = jnp.where(same, where, count)
    worlds = where.shape[-1]
    return jnp.full((count, worlds), NO_PAIR, jnp.int32).at[target, jnp.arange(worlds)].set(places, mode="drop")
