"""Which pairs get slots of their own and which are left to the broadphase; decided when a scene is built."""

from __future__ import annotations

import collections
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from mathota_jax.collision.broadphase.choice import choose_method
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.geometry import SHAPES
from mathota_jax.options import Options
from mathota_jax.pair_filter import Filter
from mathota_jax.scene import Broadphase, CompactGroup, ShapeEntry, Tier

OWN_SLOTS_UP_TO = 20
"""Pairs that keep slots of their own; beyond, finding the close ones is cheaper than solving all (measured with stacks)."""

UNPLANNED_KINDS = ("plane", "heightfield")
"""Kinds whose pairs have slots of their own: what is unbounded, or below everything, is close to most."""

OWN_PLANE_POINTS = 8
"""Points on planes for each moving shape up to which all have slots: those of one box on two planes, a ball in a bin.

A pile of 27 boxes in a bin of five planes touches 80 of 540 points, and solving those alone is twice as fast; a stack on
one plane gains 6 %, and balls in a bin, with a point for each plane, lose as much (measured).
"""

PAIRS_PER_SHAPE = 8
"""Close pairs for each moving shape: equal spheres have at most 6, boxes somewhat more, their bounds touch sooner."""

FEWEST_PAIRS = 100
"""Room for close pairs in scenes of few moving shapes, which may lie on many static ones."""

ONE_BY_ONE_UP_TO = 300
"""Pairs up to which each has a turn of its own: worlds side by side keep the processor busy, and no place stays empty."""

FULL_TURNS = 12
"""Turns of a sweep that hold as many pairs as can be without sharing a body; the later ones are narrower."""


class _Cell(NamedTuple):
    """What shapes must have in common for the same pairs to be possible."""

    kind: str
    static: bool
    filter_class: int


class _Bodies(NamedTuple):
    """Moving bodies that take part: their number, most shapes on one; largest size of all over the smallest, large ones."""

    count: int
    most_shapes: int
    size_ratio: float
    large_count: int


def plan_broadphase(
    entries: Sequence[ShapeEntry],
    static: Sequence[bool],
    collides: Sequence[bool],
    reach: Sequence[float],
    excluded: Sequence[tuple[int, int]],
    ignored: Filter,
    options: Options,
) -> Broadphase | None:
    """The broadphase of a scene, or None if each pair has its own slots.

    Args:
      entries: all shapes.
      static, collides, reach: of each body: whether it never moves, whether it has contacts, its bounding radius [m].
      excluded: pairs of bodies that a joint connects, which never collide; they count as possible all the same.
      ignored: which others never collide.
      options: `broadphase` and `pair_capacity`.

    Raises:
      ValueError: kinds that can not collide with each other.
    """
    order = list(SHAPES)
    taking_part = [k for k, entry in enumerate(entries) if collides[entry.body] and entry.kind not in UNPLANNED_KINDS]
    shapes = sorted(taking_part, key=lambda k: (order.index(entries[k].kind), k))
    moving = sum(not static[entries[k].body] for k in shapes)
    fixed = len(shapes) - moving

    def cells(members: Sequence[int]) -> Mapping[_Cell, int]:
        classes = ignored.classes or (0,) * len(static)
        bodies = [entries[k].body for k in members]
        keys = (_Cell(entries[k].kind, static[b], classes[b]) for k, b in zip(members, bodies, strict=True))
        return collections.Counter(keys)

    among = cells(shapes)
    pair_count = sum(pairs for *_, pairs in _possible(among, ignored))
    # A search along the motion needs pairs that have slots of their own.
    in_motion = options.continuous or options.impact_events
    own_up_to = ONE_BY_ONE_UP_TO if in_motion else OWN_SLOTS_UP_TO
    few = options.broadphase == "auto" and pair_count <= own_up_to
    if options.broadphase == "none" or few or pair_count == 0:
        return None
    sizes = [reach[entries[k].body] for k in shapes]
    method = choose_method(moving, fixed, sizes) if options.broadphase == "auto" else options.broadphase
    planes = [k for k, entry in enumerate(entries) if collides[entry.body] and entry.kind == "plane"]
    together = cells(planes + shapes)
    on_planes = [
        (PAIRS[a.kind, b.kind].point_count, n) for a, b, n in _possible(together, ignored) if a.kind == "plane"
    ]
    many = sum(points * pairs for points, pairs in on_planes) > OWN_PLANE_POINTS * moving
    with_planes = pair_count + sum(pairs for _, pairs in on_planes)
    if many and not in_motion and _capacity(with_planes, moving, options) <= ONE_BY_ONE_UP_TO:
        shapes, pair_count, among = planes + shapes, with_planes, together
    capacity = _capacity(pair_count, moving, options)
    one_by_one = capacity <= ONE_BY_ONE_UP_TO
    parts = collections.Counter(entries[k].body for k in shapes if not static[entries[k].body])
    bodies = _Bodies(len(parts), max(parts.values()), max(sizes) / min(sizes), sum(r > 2.0 * min(sizes) for r in sizes))
    groups = _groups(among, ignored, bodies, capacity, one_by_one)
    return Broadphase(method, tuple(shapes), tuple(sorted(excluded)), capacity, groups, one_by_one, ignored)


def _possible(cells: Mapping[_Cell, int], ignored: Filter) -> Iterator[tuple[_Cell, _Cell, int]]:
    """Cells whose shapes may collide, and how many pairs these are; the order of the kinds is kept."""
    for (a, count_a), (b, count_b) in itertools.combinations_with_replacement(cells.items(), 2):
        if not (a.static and b.static) and not ignored.ignores_classes(a.filter_class, b.filter_class):
            yield a, b, count_a * (count_a - 1) // 2 if a == b else count_a * count_b


def _capacity(pair_count: int, moving: int, options: Options) -> int:
    """Pairs that the list has room for."""
    everything = pair_count if pair_count <= ONE_BY_ONE_UP_TO else max(PAIRS_PER_SHAPE * moving, FEWEST_PAIRS)
    return min(options.pair_capacity or everything, pair_count)


def _groups(
    cells: Mapping[_Cell, int], ignored: Filter, bodies: _Bodies, capacity: int, one_by_one: bool
) -> tuple[CompactGroup, ...]:
    """Groups by kinds and by the number of moving bodies, those with one first, as in `solver.table.make_tables`.

    There is room for `capacity` pairs, each with a turn of its own if `one_by_one`.
    """
    kinds = list(dict.fromkeys(cell.kind for cell in cells))
    count: collections.Counter[tuple[str, bool]] = collections.Counter()
    for cell, shapes in cells.items():
        count[cell.kind, cell.static] += shapes
    possible: collections.Counter[tuple[str, str, int]] = collections.Counter()
    for one, other, pairs in _possible(cells, ignored):
        possible[one.kind, other.kind, 1 if one.static or other.static else 2] += pairs
    groups = []
    for side_count in (1, 2):
        for a, b in itertools.combinations_with_replacement(kinds, 2):
            moving_a, moving_b = count[a, False], count[b, False]
            fixed_a, fixed_b = count[a, True], count[b, True]
            pairs = possible[a, b, side_count]
            if side_count == 2:
                widest = moving_a // 2 if a == b else min(moving_a, moving_b)
                partners = max(moving_a, moving_b)
            else:
                widest = moving_a if a == b else (moving_a if fixed_b else 0) + (moving_b if fixed_a else 0)
                partners = max(fixed_a, fixed_b)
            if pairs and (a, b) not in PAIRS:
                raise ValueError(
                    f"build: shapes of the kinds {a} and {b} can not collide with each other; pass collides=False for the "
                    "bodies of one of them, or name both in ignore_collisions"
                )
            if pairs:
                room = min(pairs, capacity)
                tiers = (Tier(room, 1),) if one_by_one else _tiers(widest, partners, side_count, bodies, room)
                groups.append(CompactGroup(a, b, PAIRS[a, b].point_count, side_count, tiers))
    return tuple(groups)


def _tiers(widest: int, partners: int, side_count: int, bodies: _Bodies, room: int) -> tuple[Tier, ...]:
    """Turns for a graph of contacts in which a body has a bounded number of neighbours.

    A turn is a set of pairs without a common body, so it needs no more columns than half the bodies, or all of them where
    the partners are static. A greedy colouring of a graph of greatest degree d takes few more than d turns, at most
    2 d - 1; a shape of size R has at most about 4 (1 + R / r)^2 neighbours of size r (area of the sphere of their centers),
    and a body as many for each of its shapes. There are at most as many turns as `room` for pairs.
    """
    packing = 4.0 * (1.0 + bodies.size_ratio) ** 2
    degree = min(partners, math.ceil(packing)) * bodies.most_shapes
    turns = min(room, degree if side_count == 1 else min(2 * degree - 1, degree + 8))
    widest = min(widest, bodies.count)
    tiers = [Tier(min(turns, FULL_TURNS), widest)]
    turns -= tiers[0].turn_count
    if turns > 0:
        tiers.append(Tier(min(turns, FULL_TURNS), max(widest // 4, min(widest, 4))))
        turns -= tiers[1].turn_count
    if turns > 0:
        tiers.append(Tier(turns, max(1, min(bodies.large_count, widest // 4))))
    return tuple(tiers)
