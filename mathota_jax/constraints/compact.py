"""Contacts of the pairs that the broadphase finds: places in the sweep of the solver, given anew in every step.

Each pair gets a turn by colouring the graph of contacts (`solver.colouring`) and a column by counting. A place is known
again in the next step by its pair, so that impulses carry over (guide 7.3).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import Bodies, of_all_bodies
from mathota_jax.collision.bounds import admissible_pairs, swept_bounds
from mathota_jax.collision.broadphase import PairList, candidate_pairs
from mathota_jax.collision.compact import compact_contacts, shapes_of_places
from mathota_jax.collision.narrowphase import ContactSet, stored
from mathota_jax.constraints.contact import ContactRows, Motion, PlacedPairs, contact_rows, rows_one_by_one
from mathota_jax.constraints.flush import Ground, PlacedShape, decide, is_slanted, lies_flush, may_be_flush
from mathota_jax.model import Model
from mathota_jax.scene import CompactGroup, Scene
from mathota_jax.solver.colouring import edge_colours
from mathota_jax.solver.rows import Places
from mathota_jax.solver.table import TracedTable
from mathota_jax.spatial.chunks import map_filled
from mathota_jax.spatial.indexing import gather, gather_together, take
from mathota_jax.spatial.running_sum import running_sum
from mathota_jax.spatial.vector import Vec3, norm

NO_PAIR = -1

HASH = 0x9E3779B1 - (1 << 32)
"""Odd, so that the product modulo 2^31 numbers different pairs differently (Knuth's multiplicative hash)."""


class GroupPlaces(NamedTuple):
    """What the places of one compact group hold, components of shape (place, world).

    Attributes:
      pair: shapes A and B; an admissible pair where the place is empty.
      active: whether the place holds a pair.
      listed: the pair's index in the list of the broadphase.
      tables: order of the solver, a table for each tier.
    """

    pair: tuple[Array, Array]
    active: Array
    listed: Array
    tables: list[tuple[TracedTable, PlacedPairs]]


class ClosePairs(NamedTuple):
    """Pairs close to each other in a step: the list, ascending by key, and their places, a `GroupPlaces` a group.

    `overflow` is (world,) whether some pair found no place.
    """

    found: PairList
    groups: list[GroupPlaces]
    overflow: Array


def close_pairs(model: Model, bodies: Bodies, free: tuple[Vec3, Vec3] | None) -> ClosePairs:
    """Runs the broadphase (guide 11.1, phase 2).

    Args:
      model: parameters and static scene.
      bodies: all bodies.
      free: velocities of the moving bodies at the end of the step if nothing constrained them, for contacts that will be
        made within the step (guide 10.4); None for those at the present poses.
    """
    scene, plan = model.scene, model.scene.broadphase
    assert plan is not None
    displacements: tuple[Vec3, ...] = ()
    turn = None
    if free is not None:
        linear, angular = (of_all_bodies(scene, v) for v in free)
        displacements = (bodies.velocity * model.dt, linear * model.dt)
        if _turns_matter(scene, model):
            turn = jnp.maximum(norm(bodies.angular_velocity), norm(angular)) * model.dt
    bounds = swept_bounds(scene, model.shapes, bodies.position, bodies.orientation, displacements, turn)
    found = candidate_pairs(plan.method, bounds, admissible_pairs(scene), plan.capacity)
    groups, lost = _places(scene, found)
    return ClosePairs(found, groups, found.overflow | lost)


def _turns_matter(scene: Scene, model: Model) -> bool:
    """Not for spheres about the centres of mass of their bodies."""
    kinds = {kind for group in scene.compact_groups for kind in (group.kind_a, group.kind_b)}
    return kinds - {"plane"} != {"sphere"} or "local_position" in model.shapes["sphere"]


def contacts_of(model: Model, bodies: Bodies, close: ClosePairs) -> list[ContactSet]:
    """Runs the narrow phase for the close pairs, a set for each compact group."""
    numbers = range(len(model.scene.compact_groups))
    return [_contacts_of(model, bodies, close, number) for number in numbers]


def groups_with_static(scene: Scene) -> list[int]:
    """Numbers of the groups of pairs of which one body alone moves, planes excepted."""
    groups = enumerate(scene.compact_groups)
    return [k for k, group in groups if group.side_count == 1 and "plane" not in (group.kind_a, group.kind_b)]


def contacts_with_static(model: Model, bodies: Bodies, close: ClosePairs) -> dict[int, ContactSet]:
    """`contacts_of` for `groups_with_static`, by their numbers."""
    return {number: _contacts_of(model, bodies, close, number) for number in groups_with_static(model.scene)}


def _contacts_of(model: Model, bodies: Bodies, close: ClosePairs, number: int) -> ContactSet:
    group, places = model.scene.compact_groups[number], close.groups[number]
    contacts, pairs = _narrow_phase(model, group, bodies), (places.pair, places.active)
    assert model.scene.broadphase is not None
    return map_filled(contacts, pairs, filled(places)) if model.scene.broadphase.one_by_one else contacts(pairs)


def moving_side(scene: Scene, pair: tuple[Array, Array]) -> tuple[Array, Array]:
    """(place, world) bodies that move of pairs of which one moves, and whether they are B."""
    body_of, moves = jnp.asarray(admissible_pairs(scene).bodies, jnp.int32), jnp.asarray(_moving_shapes(scene))
    b_moves = moves[pair[1]]
    return jnp.where(b_moves, body_of[pair[1]], body_of[pair[0]]), b_moves


def contacts_and_rows(
    model: Model,
    bodies: Bodies,
    close: ClosePairs,
    motion: Motion,
    ground: Ground | None,
    with_static: dict[int, ContactSet],
) -> tuple[list[ContactSet], list[ContactRows]]:
    """`contacts_of`, without those with shapes that are flush with the ground, and the rows of the contacts.

    `with_static` are the contacts that were found for the ground.
    """
    scene = model.scene
    assert scene.broadphase is not None
    sets, rows = [], []
    for number, (group, places) in enumerate(zip(scene.compact_groups, close.groups, strict=True)):
        pairs, find = (places.pair, places.active), _narrow_phase(model, group, bodies)
        if ground is not None and number in with_static and may_be_flush(group.kind_a, group.kind_b):
            found = jax.tree.map(lambda x, k=group.point_count: x.reshape(-1, k, x.shape[-1]), with_static[number])
            pairs, find = (*pairs, found), _not_flush(model, group, bodies, ground)
        if scene.broadphase.one_by_one:
            (table, placed), *_ = places.tables
            contacts, found_rows = rows_one_by_one(scene, table, model, find, pairs, motion, placed)
            sets.append(contacts)
            rows.append(found_rows)
            continue
        sets.append(find(pairs))
        first = places.tables[0][0].first_slot
        for table, placed in places.tables:
            of_group = dataclasses.replace(table, first_slot=table.first_slot - first)
            chosen = stored(sets[-1], bodies.position.x)
            found_rows = contact_rows(scene, of_group, model, chosen, motion, placed)
            rows.append(found_rows._replace(rows=dataclasses.replace(found_rows.rows, table=table)))
    return sets, rows


def _narrow_phase(model: Model, group: CompactGroup, bodies: Bodies) -> Callable[[tuple], ContactSet]:
    def contacts(pairs: tuple) -> ContactSet:
        return compact_contacts(model.scene, group, model.shapes, bodies.position, bodies.orientation, *pairs)

    return contacts


def _not_flush(model: Model, group: CompactGroup, bodies: Bodies, ground: Ground) -> Callable[[tuple], ContactSet]:
    """Of contacts (place, point, world) of pairs with static shapes those that are not flush with the ground."""
    scene = model.scene
    placement = lax.stop_gradient((model.shapes, bodies.position, bodies.orientation))

    def contacts(pairs: tuple) -> ContactSet:
        pair, _, found = pairs
        found = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), found)
        mover, b_moves = moving_side(scene, pair)
        of_pair = gather_together(ground, mover)
        sides = shapes_of_places(scene, group, *placement, pair)
        placed = (PlacedShape(kind, *side) for kind, side in zip((group.kind_a, group.kind_b), sides, strict=True))
        below, of_point = jax.tree.map(
            lambda x: jnp.repeat(x, group.point_count, axis=0),
            (lies_flush(of_pair, *placed, a_is_static=b_moves), of_pair),
        )
        slanted = is_slanted(of_point, lax.stop_gradient(found.normal))
        return found._replace(active=found.active & ~decide(below & slanted, found.separation.dtype))

    return contacts


def pair_key(scene: Scene, first: Array, second: Array) -> Array:
    """Number of a pair of shapes, ascending in the first and then the second."""
    assert scene.broadphase is not None
    return first * len(scene.broadphase.shapes) + second


def filled(places: GroupPlaces) -> Array:
    """() number of places that hold a pair in some world, where each pair has a turn of its own."""
    (_, placed), *_ = places.tables
    assert placed.places.turns is not None
    return placed.places.turns


def slot_bodies(scene: Scene, close: ClosePairs) -> tuple[Array, Array]:
    """(slot, world) bodies A and B of the slots of the compact groups."""
    body_of = jnp.asarray(admissible_pairs(scene).bodies, jnp.int32)
    sides = []
    for side in range(2):
        parts = zip(scene.compact_groups, close.groups, strict=True)
        sides.append(
            jnp.concatenate([jnp.repeat(body_of[p.pair[side]], group.point_count, axis=0) for group, p in parts])
        )
    return tuple(sides)  # type: ignore[return-value]


def _places(scene: Scene, found: PairList) -> tuple[list[GroupPlaces], Array]:
    """Gives every listed pair a turn and a column."""
    block_count, capacity = len(scene.dynamic_bodies), found.first.shape[0]
    turn_counts = [sum(tier.turn_count for tier in group.tiers) for group in scene.compact_groups]
    turn_count, worlds = max(turn_counts), found.active.shape[-1]
    sorted_pairs, counts, starts = _turns(scene, found, turn_counts)

    groups, lost, slot = [], jnp.zeros(worlds, bool), scene.static_slot_count
    for number, group in enumerate(scene.compact_groups):
        turn = number * (turn_count + 1)
        held, listed = [], []
        tables, sizes = [], []
        used = (counts[turn : turn + turn_counts[number]] > 0).any(1).sum(dtype=jnp.int32)
        first_turn = 0
        for tier in group.tiers:
            rows = slice(turn + first_turn, turn + first_turn + tier.turn_count)
            column = jnp.arange(tier.pair_count, dtype=jnp.int32)[None, :, None]
            held.append((column < counts[rows][:, None]).reshape(-1, worlds))
            position = jnp.minimum(starts[rows][:, None] + column, capacity - 1).reshape(-1, worlds)
            listed.append(position if sorted_pairs is None else gather(sorted_pairs, position))
            lost |= (counts[rows] > tier.pair_count).any(0)
            tables.append(TracedTable(tier.turn_count, tier.pair_count, group.point_count, slot, block_count))
            sizes.append(jnp.clip(used - first_turn, 0, tier.turn_count))
            slot += tier.turn_count * tier.pair_count * group.point_count
            first_turn += tier.turn_count
        lost |= (counts[turn + turn_counts[number] : turn + turn_count + 1] > 0).any(0)
        groups.append(_group_places(scene, group, found, jnp.concatenate(held), jnp.concatenate(listed), tables, sizes))
    return groups, lost


def _turns(scene: Scene, found: PairList, turn_counts: list[int]) -> tuple[Array | None, Array, Array]:
    """Listed pairs sorted by turn, those of all groups; how many each turn holds, and where in the order they begin.

    The order is None where it is that of the list. Each group has one turn more than it has places for: what is there is
    lost.
    """
    turn_count, capacity, active = max(turn_counts), found.first.shape[0], found.active
    assert scene.broadphase is not None
    several = len(scene.compact_groups) > 1
    group_of_pair = jnp.asarray(_group_codes(scene))[found.first, found.second] if several else 0
    if _in_list_order(scene):
        # The list has no gaps: each pair has the turn of its number in its group.
        turns = jnp.arange(turn_count + 1, dtype=jnp.int32)[:, None]
        sizes = [(active & (group_of_pair == group)).sum(0, dtype=jnp.int32) for group in range(len(turn_counts))]
        counts = [(turns < size).astype(jnp.int32) for size in sizes]
        starts = [turns + sum(sizes[:group], jnp.zeros_like(found.count)) for group in range(len(sizes))]
        return None, jnp.concatenate(counts), jnp.concatenate(starts)
    if scene.broadphase.one_by_one:
        colour = _ranks(group_of_pair, active, len(turn_counts))
    else:
        blocks = _blocks(scene)
        ends = [blocks[side] for side in (found.first, found.second)]
        block_count = len(scene.dynamic_bodies)
        node_count = len(scene.compact_groups) * block_count
        nodes = tuple(jnp.where(end < block_count, end + group_of_pair * block_count, node_count) for end in ends)
        priority = (pair_key(scene, found.first, found.second) * jnp.int32(HASH)) & jnp.iinfo(jnp.int32).max
        colour = edge_colours(nodes, priority, active, node_count, turn_count)  # type: ignore[arg-type]

    # Sorted by group, turn and place in the list: the pairs of a turn follow one another.
    code = jnp.where(active, group_of_pair * (turn_count + 1) + colour, len(turn_counts) * (turn_count + 1))
    worlds = code.shape[-1]
    sorted_pairs = jnp.sort(code * capacity + jnp.arange(capacity, dtype=jnp.int32)[:, None], axis=0) % capacity
    counts = jnp.zeros((len(turn_counts) * (turn_count + 1), worlds), jnp.int32)
    counts = counts.at[code, jnp.arange(worlds)].add(1, mode="drop")
    return sorted_pairs, counts, running_sum(counts) - counts


def _in_list_order(scene: Scene) -> bool:
    """Whether each pair has a turn of its own, and those of a group follow one another in the list."""
    assert scene.broadphase is not None
    codes = _group_codes(scene)[admissible_pairs(scene).pairs]
    return scene.broadphase.one_by_one and bool((np.diff(codes) >= 0).all())


def _blocks(scene: Scene) -> Array:
    """(shape,) velocity block of the body of each shape that takes part; the number of blocks for static bodies."""
    block_of = {body: block for block, body in enumerate(scene.dynamic_bodies)}
    return jnp.asarray([block_of.get(body, len(block_of)) for body in admissible_pairs(scene).bodies], jnp.int32)


def _ranks(group_of_pair: Array | int, active: Array, group_count: int) -> Array:
    """(listed pair, world) number of the pair among those of its group."""
    rank = jnp.zeros(active.shape, jnp.int32)
    for group in range(group_count):
        mine = active & (group_of_pair == group)
        rank = jnp.where(mine, running_sum(mine.astype(jnp.int32)) - 1, rank)
    return rank


def _group_places(
    scene: Scene,
    group: CompactGroup,
    found: PairList,
    active: Array,
    listed: Array,
    tables: list[TracedTable],
    used_turns: list[Array],
) -> GroupPlaces:
    block_count = len(scene.dynamic_bodies)
    blocks = _blocks(scene)
    bodies = jnp.asarray(admissible_pairs(scene).bodies, jnp.int32)
    example = _example(scene, group)
    pair = tuple(
        jnp.where(active, gather(side, listed), spare)
        for side, spare in zip((found.first, found.second), example, strict=True)
    )
    block_a, block_b = (jnp.where(active, blocks[side], block_count) for side in pair)
    sign = None
    if group.side_count == 1:
        b_moves = block_b < block_count
        block_a = jnp.where(b_moves, block_b, block_a)
        sign = jnp.where(b_moves, 1.0, -1.0)
    sides = (block_a,) if group.side_count == 1 else (block_a, block_b)
    start, placed = 0, []
    for table, turns in zip(tables, used_turns, strict=True):
        rows = range(start, start + table.turn_count * table.constraint_count)
        start = rows.stop

        def by_turn(values: Array, rows: range = rows, table: TracedTable = table) -> Array:
            return take(values, rows).reshape(table.turn_count, table.constraint_count, -1)

        placed.append(
            (
                table,
                PlacedPairs(
                    Places(tuple(by_turn(side) for side in sides), turns),
                    (by_turn(bodies[pair[0]]), by_turn(bodies[pair[1]])),
                    None if sign is None else by_turn(sign),
                ),
            )
        )
    return GroupPlaces(pair, active, listed, placed)  # type: ignore[arg-type]


def _moving_shapes(scene: Scene) -> np.ndarray:
    return ~np.asarray(admissible_pairs(scene).static)


def _group_codes(scene: Scene) -> np.ndarray:
    """(shape, shape) group of each pair of shapes; 0 for pairs that are never listed."""
    assert scene.broadphase is not None
    kinds = [scene.shapes[entry].kind for entry in scene.broadphase.shapes]
    names = list(dict.fromkeys(kinds))
    kind, moving = np.asarray([names.index(k) for k in kinds]), _moving_shapes(scene).astype(int)
    codes = np.zeros((len(names), len(names), 3), np.int32)
    for number, group in enumerate(scene.compact_groups):
        codes[names.index(group.kind_a), names.index(group.kind_b), group.side_count] = number
    return codes[kind[:, None], kind[None, :], moving[:, None] + moving[None, :]]


def _example(scene: Scene, group: CompactGroup) -> tuple[int, int]:
    """An admissible pair of the group, for empty places: its values are finite, and not used."""
    assert scene.broadphase is not None
    kinds = np.asarray([scene.shapes[entry].kind for entry in scene.broadphase.shapes])
    moving = _moving_shapes(scene)
    a, b = np.flatnonzero(kinds == group.kind_a), np.flatnonzero(kinds == group.kind_b)
    fits = (moving[a][:, None].astype(int) + moving[b][None, :]) == group.side_count
    fits &= a[:, None] < b[None, :]
    row, column = np.unravel_index(np.argmax(fits), fits.shape)
    return int(a[row]), int(b[column])
