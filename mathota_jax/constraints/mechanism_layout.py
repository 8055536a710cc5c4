"""Which bodies of a scene are links of mechanisms, found when the scene is traced."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import numpy as np

from mathota_jax.constraints.contact_room import Places, places_for
from mathota_jax.constraints.joint_layout import JointGroup, joint_groups, joint_row_count
from mathota_jax.scene import Scene
from mathota_jax.solver.tree import GROUND, Tree

_Slots = tuple[tuple[int, ...], tuple[int, ...]]

LEAST_JOINTS = 3
"""Joints of the smallest mechanism beside rows that are swept in turn with it: two converge in a few sweeps, which are
cheaper (an arm of two links with limits takes half the time, its gradient too). Elsewhere one is enough, and so it is with
small steps, whose few sweeps leave even one open by its length where it hits a wall."""

STIFF = ("spring", "position")
"""Features of joints that may hold almost as a joint does."""

MOST_CLOSING = 96
"""Rows that close loops in the largest mechanism: they are solved as a dense system. What has more is left to the sweeps."""


class Link(NamedTuple):
    """A body of a mechanism.

    Attributes:
      block: its velocity block.
      parent: place of its parent among the links, `GROUND` for none.
      slots: of the rows that hold translations, and of those that hold rotations, relative to the parent.
      is_child: whether the joint, too, calls it the child.
    """

    block: int
    parent: int
    slots: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())
    is_child: bool = True


class Closing(NamedTuple):
    """A joint that closes a loop of links.

    Attributes:
      parent, child: places among the links of what the joint calls so, `GROUND` for none.
      slots: as of a `Link`.
    """

    parent: int
    child: int
    slots: tuple[tuple[int, ...], tuple[int, ...]]

    @property
    def rows(self) -> tuple[int, ...]:
        """All slots."""
        return (*self.slots[0], *self.slots[1])


@dataclasses.dataclass(frozen=True)
class Layout:
    """The links of all mechanisms of a scene, parents first, and the joints that no tree of links has."""

    links: tuple[Link, ...]
    block_count: int
    closings: tuple[Closing, ...] = ()

    @functools.cached_property
    def blocks(self) -> tuple[int, ...]:
        """Velocity block of each link."""
        return tuple(link.block for link in self.links)

    @functools.cached_property
    def is_link(self) -> np.ndarray:
        """(block,) whether a moving body is a link."""
        return np.isin(np.arange(self.block_count), self.blocks)

    @functools.cached_property
    def alone(self) -> tuple[int, ...]:
        """Velocity blocks of the others."""
        return tuple(np.flatnonzero(~self.is_link).tolist())

    @functools.cached_property
    def tree(self) -> Tree:
        """The links as the solver sees them."""
        floating = (place for place, link in enumerate(self.links) if link.parent == GROUND and not any(link.slots))
        return Tree(tuple(link.parent for link in self.links), tuple(floating))

    @functools.cached_property
    def trees(self) -> tuple[tuple[int, ...], ...]:
        """The links of each tree, which follow one another."""
        starts = [place for place, link in enumerate(self.links) if link.parent == GROUND]
        ends = [*starts[1:], len(self.links)]
        return tuple(tuple(range(a, b)) for a, b in zip(starts, ends, strict=True))

    @functools.cached_property
    def floating_trees(self) -> tuple[tuple[int, ...], ...]:
        """Those that hang on nothing."""
        return tuple(links for links in self.trees if links[0] in self.tree.floating)

    @functools.cached_property
    def slots(self) -> tuple[int, ...]:
        """All slots, in the order in which `held` says which impulse of which link they are."""
        return tuple(slot for link in self.links for rows in link.slots for slot in rows)

    @functools.cached_property
    def closing_slots(self) -> tuple[int, ...]:
        """Slots of the rows that close loops, joint by joint."""
        return tuple(slot for closing in self.closings for slot in closing.rows)

    @functools.cached_property
    def held(self) -> np.ndarray:
        """(6, link) which of the three translations and three rotations of each link are held."""
        return np.array([[row < len(link.slots[part]) for link in self.links] for part in range(2) for row in range(3)])

    @functools.cached_property
    def row_slots(self) -> np.ndarray:
        """(6, link) slot of each; any one where nothing is held."""
        return np.array(
            [
                [link.slots[part][row] if row < len(link.slots[part]) else self.slots[0] for link in self.links]
                for part in range(2)
                for row in range(3)
            ]
        )


@functools.cache
def layout(scene: Scene) -> Layout | None:
    """The mechanisms of a scene; None where there is none, or where joints are left to the solver."""
    options = scene.options
    # Between impacts bodies follow paths of constant force, which a closing of the joints would leave.
    if scene.splits_at_impacts or not options.exact_joints:
        return None
    found = _of_trees(scene, 1)
    if found is None or options.solver in ("soft_step", "converged") or _has_no_others(scene, found):
        return found
    if _contact_places(scene, found) is not None or _has_stiff_drives(scene, found):
        return found
    return _of_trees(scene, LEAST_JOINTS)


def _of_trees(scene: Scene, least: int) -> Layout | None:
    """All trees of at least so many joints; None if there is none."""
    held, ends = _held_joints(scene)
    links: list[Link] = []
    closing: list[int] = []
    for joints in _components(ends, len(scene.dynamic_bodies)):
        spanning = _spanning(joints, ends, held)
        beside = [joint for joint in joints if joint not in spanning]
        if len(joints) >= least and sum(len(rows) for joint in beside for rows in held[joint]) <= MOST_CLOSING:
            _grow(links, [joint for joint in joints if joint in spanning], ends, held)
            closing += beside
    if not links:
        return None
    places = {GROUND: GROUND, **{link.block: place for place, link in enumerate(links)}}
    closings = []
    for joint in closing:
        parent, child = ends[joint]
        closings.append(Closing(places[parent], places[child], held[joint]))
    return Layout(tuple(links), len(scene.dynamic_bodies), tuple(closings))


def _spanning(joints: list[int], ends: dict[int, tuple[int, ...]], held: dict[int, _Slots]) -> set[int]:
    """Joints of a tree that spans all bodies of some connected ones: of each loop, one that holds least is left out."""
    by_rows = sorted(joints, key=lambda joint: -sum(map(len, held[joint])))
    grounded = [joint for joint in by_rows if GROUND in ends[joint]]
    found, label = set(grounded[:1]), {block: block for joint in joints for block in ends[joint]}
    for joint in by_rows:
        first, second = (_root(label, block) for block in ends[joint])
        if joint not in grounded and first != second:
            found.add(joint)
            label[first] = second
    return found


def _has_no_others(scene: Scene, found: Layout) -> bool:
    """Whether the scene has no other rows than those of some mechanisms."""
    return not scene.slot_count and _row_count(found) == joint_row_count(scene)


def _has_stiff_drives(scene: Scene, found: Layout) -> bool:
    """Whether these mechanisms have springs or servos, beside one another or other rows, that sweeps could not settle.

    An arm of two links on servos, with stops, went round at 1e6 rad/s.
    """
    stiff = any(feature in STIFF for group in joint_groups(scene) for feature in group.features)
    return scene.options.solver == "pgs" and stiff and len(_bounded_slots(scene, found)) > 1


def _contact_places(scene: Scene, found: Layout) -> Places | None:
    """`contact_places`, with these mechanisms."""
    if scene.options.solver != "pgs" or not scene.slot_count:
        return None
    bounded = len(_bounded_slots(scene, found))
    if _row_count(found) + bounded != joint_row_count(scene) or not _contacts_on_links(scene, found):
        return None
    return places_for(scene, _link_bodies(scene, found), bounded)


def _contacts_on_links(scene: Scene, found: Layout) -> bool:
    bodies = {body for side in scene.slot_bodies for body in side}
    close = () if scene.broadphase is None else scene.broadphase.shapes
    return not _link_bodies(scene, found).isdisjoint(bodies | {scene.shapes[entry].body for entry in close})


def _link_bodies(scene: Scene, found: Layout) -> frozenset[int]:
    return frozenset(scene.dynamic_bodies[block] for block in found.blocks)


def _row_count(found: Layout) -> int:
    return len(found.slots) + len(found.closing_slots)


@functools.cache
def looped_slots(scene: Scene) -> tuple[tuple[int, int, bool], ...]:
    """Joint, slot and whether it holds a rotation, of each row that always holds in a closed loop of joints."""
    held, ends = _held_joints(scene)
    found = []
    for joints in _components(ends, len(scene.dynamic_bodies)):
        nodes = {block for joint in joints for block in ends[joint]}  # the ground is one of them
        if len(joints) >= len(nodes):
            found += [(joint, slot, bool(part)) for joint in joints for part in range(2) for slot in held[joint][part]]
    return tuple(found)


def covers(scene: Scene) -> bool:
    """Whether the scene has no other rows than those that mechanisms hold."""
    found = layout(scene)
    return found is not None and _has_no_others(scene, found)


def takes_small_steps(scene: Scene) -> bool:
    """Whether a step is one of small ones: not where mechanisms are solved at once, which no small step does better."""
    return scene.options.solver == "soft_step" and not covers_with_bounds(scene)


def covers_with_bounds(scene: Scene) -> bool:
    """Whether it has no others than those and rows with bounds on mechanisms."""
    found = layout(scene)
    if found is None or scene.slot_count:
        return False
    return _row_count(found) + len(bounded_slots(scene)) == joint_row_count(scene)


@functools.cache
def contact_places(scene: Scene) -> Places | None:
    """Room for all contacts of a scene where they are solved with the joints held, like all rows that do not always hold.

    None where they are not.
    """
    found = layout(scene)
    return None if found is None else _contact_places(scene, found)


def takes_contacts(scene: Scene) -> bool:
    """Whether all contacts of a scene are solved with the joints held."""
    return contact_places(scene) is not None


def links_with_swept_contacts(scene: Scene) -> list[str] | None:
    """Names of the links whose contacts the default solver sweeps in turn with their joints; None where it does not."""
    found = layout(scene)
    if found is None or scene.options.solver != "pgs" or takes_contacts(scene) or not _contacts_on_links(scene, found):
        return None
    return [scene.body_names[body] for body in sorted(_link_bodies(scene, found))]


@functools.cache
def bounded_slots(scene: Scene) -> tuple[int, ...]:
    """Slots of the rows with bounds, or soft ones, that act on nothing but links."""
    found = layout(scene)
    return () if found is None else _bounded_slots(scene, found)


def _bounded_slots(scene: Scene, found: Layout) -> tuple[int, ...]:
    block_of = {body: block for block, body in enumerate(scene.dynamic_bodies)}
    links = set(found.blocks)
    slots = [
        group.slots(row).start + place
        for group in joint_groups(scene)
        for place, joint in enumerate(group.joints)
        for row in range(group.row_count)
        if {block_of[body] for body in (scene.joints[joint].parent, scene.joints[joint].child) if body in block_of}
        <= links
    ]
    return tuple(sorted(set(slots) - set(found.slots) - set(found.closing_slots)))


def _held_joints(scene: Scene) -> tuple[dict[int, _Slots], dict[int, tuple[int, ...]]]:
    """Of each joint that holds anything: its slots as in `held_slots`, and its velocity blocks or `GROUND`."""
    block_of = {body: block for block, body in enumerate(scene.dynamic_bodies)}
    groups = joint_groups(scene)
    held = {joint: held_slots(group, place) for group in groups for place, joint in enumerate(group.joints)}
    held = {joint: slots for joint, slots in held.items() if any(slots)}
    bodies = {joint: (scene.joints[joint].parent, scene.joints[joint].child) for joint in held}
    return held, {joint: tuple(block_of.get(body, GROUND) for body in pair) for joint, pair in bodies.items()}


def held_slots(group: JointGroup, place: int) -> _Slots:
    """Slots of the rows of a joint that hold translations, and rotations, whatever happens."""
    kind, row = group.kind, group.kind.fixed_row_count
    rows: tuple[list[int], list[int]] = ([*range(kind.fixed_translations)], [*range(kind.fixed_translations, row)])
    for feature in group.features:
        if feature == "locked":
            assert kind.coordinate is not None
            rows[kind.coordinate.angular].append(row)
        row += kind.free_count if feature in ("damping", "friction") else 1
    translations, rotations = (tuple(group.slots(row).start + place for row in part) for part in rows)
    return translations, rotations


def _components(ends: dict[int, tuple[int, ...]], block_count: int) -> list[list[int]]:
    """Joints that are connected through moving bodies."""
    label = {block: block for block in range(block_count)}
    for blocks in ends.values():
        if GROUND not in blocks:
            label[_root(label, blocks[0])] = _root(label, blocks[1])
    found: dict[int, list[int]] = {}
    for joint, blocks in ends.items():
        found.setdefault(_root(label, max(blocks)), []).append(joint)
    return list(found.values())


def _root(label: dict[int, int], block: int) -> int:
    """What stands for all blocks that are connected with this one."""
    while label[block] != block:
        block = label[block]
    return block


def _grow(
    links: list[Link],
    joints: list[int],
    ends: dict[int, tuple[int, ...]],
    held: dict[int, _Slots],
) -> None:
    """Adds the links of one tree."""
    grounded = [joint for joint in joints if GROUND in ends[joint]]
    if grounded:
        trunk = [(grounded[0], GROUND)]
    else:
        first = min(block for joint in joints for block in ends[joint])
        links.append(Link(first, GROUND))
        trunk = [(joint, len(links) - 1) for joint in reversed(joints) if first in ends[joint]]
    waiting = set(joints)
    while trunk:
        # Depth first, see `solver.tree`.
        joint, parent = trunk.pop()
        waiting.remove(joint)
        inner = GROUND if parent == GROUND else links[parent].block
        is_child = ends[joint][0] == inner
        outer = ends[joint][is_child]
        links.append(Link(outer, parent, held[joint], is_child))
        trunk += [(other, len(links) - 1) for other in reversed(joints) if other in waiting and outer in ends[other]]
