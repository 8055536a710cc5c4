"""How many contacts find room in the dense matrix of the rows that are solved with the joints of mechanisms held.

Each point of a pair with slots of its own has rows there, as long as there is room for these and for what the broadphase may
find. In larger scenes all contacts share places, which those take that touch.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from mathota_jax.scene import Scene

MOST_ROWS = 192
"""Rows of contacts and with bounds of the largest scene in which they are solved with the joints held: the system behind
their derivative grows with their square, and so does their matrix where there are as many ways to move."""

FEWEST_TOUCHING = 8
"""Least room for what touches at the same time: one for each shape of a link, and more for free ones, which lie in heaps."""

TOUCHING_A_FREE_SHAPE = 4
"""Of those, for each moving shape that is on no link. A sphere in a heap has six neighbours, which is three pairs each."""

POINTS_OF_A_PLACE = 2
"""At most. A pair with more points takes several places, which are solved in turn."""


class Places(NamedTuple):
    """Room for contacts that touch.

    Attributes:
      count: number of places.
      points: of each.
      for_all: whether pairs with slots of their own take places, too; otherwise each of their points has rows.
    """

    count: int
    points: int
    for_all: bool


def places_for(scene: Scene, links: frozenset[int], bounded: int) -> Places | None:
    """The room in a scene; None where it is too little.

    Args:
      scene: with contacts.
      links: bodies of its mechanisms.
      bounded: rows with bounds on their joints, which need room, too.
    """
    room = (MOST_ROWS - bounded) // rows_of_a_point(scene)
    found = _for_close(scene, links, room)
    return _for_all(scene, links, room) if found is None else found


def rows_of_a_point(scene: Scene) -> int:
    """Of a contact."""
    return 3 if scene.friction else 1


def _for_close(scene: Scene, links: frozenset[int], room: int) -> Places | None:
    """Room for what the broadphase may find, beside all points of other pairs."""
    most = max((group.point_count for group in scene.compact_groups), default=0)
    points = min(most, POINTS_OF_A_PLACE)
    bodies = _close_bodies(scene)
    on_links = sum(body in links for body in bodies)
    wanted = on_links + TOUCHING_A_FREE_SHAPE * (len(bodies) - on_links)
    pairs = min(scene.place_count, scene.options.touching_capacity or max(FEWEST_TOUCHING, wanted))
    count = min(pairs * places_of_pair(most, points), _places_of_close(scene, points))
    return Places(count, points, False) if scene.static_slot_count + count * points <= room else None


def _for_all(scene: Scene, links: frozenset[int], room: int) -> Places | None:
    """As many as there is room for, if each shape of a link finds one, and what is on no link all that it may need."""
    most = max(group.point_count for group in (*scene.pair_groups, *scene.compact_groups))
    points = min(most, POINTS_OF_A_PLACE)
    each, room = places_of_pair(most, points), room // points
    own = [(not links.isdisjoint(bodies), places_of_pair(count, points)) for bodies, count in _own_pairs(scene)]
    every = sum(count for _, count in own) + _places_of_close(scene, points)
    if scene.options.touching_capacity is not None:
        count = min(scene.options.touching_capacity * each, every)
        return Places(count, points, True) if count <= room else None
    bodies = _close_bodies(scene) or [
        *{body for pair, _ in _own_pairs(scene) for body in pair if not scene.static[body]}
    ]
    on_links = sum(body in links for body in bodies)
    close_to_free = TOUCHING_A_FREE_SHAPE * each * (len(bodies) - on_links) if scene.place_count else 0
    least = max(FEWEST_TOUCHING, on_links) + close_to_free + sum(count for on_link, count in own if not on_link)
    return Places(min(room, every), points, True) if room >= min(least, every) else None


def places_of_pair(point_count: int, points: int) -> int:
    """How many places a pair takes."""
    return -(-point_count // points) if points else 0


def _places_of_close(scene: Scene, points: int) -> int:
    """Places of all pairs that the broadphase may list at a time."""
    return sum(group.place_count * places_of_pair(group.point_count, points) for group in scene.compact_groups)


def _close_bodies(scene: Scene) -> list[int]:
    """Of each moving shape whose pairs the broadphase finds."""
    entries = () if scene.broadphase is None else scene.broadphase.shapes
    return [scene.shapes[entry].body for entry in entries if not scene.static[scene.shapes[entry].body]]


def _own_pairs(scene: Scene) -> Iterator[tuple[tuple[int, int], int]]:
    """Bodies and points of each pair with slots of its own."""
    for group in scene.pair_groups:
        for pair in zip(group.bodies_a, group.bodies_b, strict=True):
            yield pair, group.point_count
