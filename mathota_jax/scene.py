"""`Scene`: the static structure of a model. Equal scenes share one compilation; what a scene lacks is not traced."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

from mathota_jax.options import Options
from mathota_jax.pair_filter import Filter


class ShapeEntry(NamedTuple):
    """One collision shape: row `index` of the parameters of its `kind`, fixed to body `body`."""

    kind: str
    body: int
    index: int


class PairGroup(NamedTuple):
    """All admissible pairs of two shape kinds, tested by one vectorised call.

    `shapes_a`/`shapes_b` are rows of the parameters of each kind, `bodies_a`/`bodies_b` the bodies they are fixed to.
    `window` is how many cells of a heightfield along each side are tested around a body, None for other kinds.
    """

    kind_a: str
    kind_b: str
    point_count: int
    shapes_a: tuple[int, ...]
    shapes_b: tuple[int, ...]
    bodies_a: tuple[int, ...]
    bodies_b: tuple[int, ...]
    window: int | None = None

    @property
    def slot_count(self) -> int:
        """Contact slots of the group: one for each pair and point, pair major."""
        return len(self.bodies_a) * self.point_count


class Tier(NamedTuple):
    """Turns of equal size in a sweep of the solver over a `CompactGroup`: each holds up to `pair_count` pairs."""

    turn_count: int
    pair_count: int


class CompactGroup(NamedTuple):
    """Pairs of two shape kinds that own contact slots only while they are close to each other.

    `side_count` is the number of moving bodies in each pair. The places of the pairs are numbered tier, turn, column.
    """

    kind_a: str
    kind_b: str
    point_count: int
    side_count: int
    tiers: tuple[Tier, ...]

    @property
    def place_count(self) -> int:
        """Pairs that can be close at the same time."""
        return sum(tier.turn_count * tier.pair_count for tier in self.tiers)

    @property
    def slot_count(self) -> int:
        """Contact slots of the group: one for each place and point, place major."""
        return self.place_count * self.point_count


class Broadphase(NamedTuple):
    """How the pairs that are close are found in every step, in scenes of too many pairs to give each its slots.

    Attributes:
      method: key of `collision.broadphase.BROADPHASES`.
      shapes: entries of `Scene.shapes` that take part, by kind; pairs refer to their place in this tuple.
      excluded: pairs of bodies that never collide.
      capacity: pairs that can be close at the same time.
      groups: where their contacts go.
      one_by_one: whether every pair has a turn of its own, or pairs without a common body share one.
      filter: which bodies ignore each other.
    """

    method: str
    shapes: tuple[int, ...]
    excluded: tuple[tuple[int, int], ...]
    capacity: int
    groups: tuple[CompactGroup, ...]
    one_by_one: bool
    filter: Filter


class JointEntry(NamedTuple):
    """One joint. `features` name the rows that it has beside those of its kind, in order.

    "locked": the coordinate is held; "lower", "upper": stops of the coordinate; "swing": cone about the axis; "damping":
    viscous resistance along each free motion; "spring": stiffness, damping and armature along the coordinate; "friction":
    dry resistance along each free motion; "velocity", "position": a motor of that kind, one entry for each.
    """

    kind: str
    parent: int
    child: int
    features: tuple[str, ...]


class MotorEntry(NamedTuple):
    """One motor; `kind` is "torque", "velocity" or "position"."""

    joint: int
    kind: str


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Static description of a scene: which bodies, shapes, pairs, joints and features exist.

    Attributes:
      static: for each body, whether it never moves.
      spherical: for each body, whether its inertia is the same about every axis.
      shapes: collision shapes in order of adding.
      faces: for each polyhedron, vertex indices of its polygonal faces, counter-clockwise seen from outside.
      pair_groups: admissible pairs by shape kinds (no static-static, no jointed, no excluded pair), but for those that
        the broadphase finds.
      joints: joints in order of adding.
      motors: what each entry of the action drives.
      friction: whether any admissible pair has friction; otherwise there are no tangent rows.
      restitution: whether any admissible pair bounces; otherwise there is no event code.
      options: the settings, `dt` excepted (a leaf of the model).
      body_names, joint_names: for messages and look-up.
      broadphase: None where every admissible pair has its own slots.
    """

    static: tuple[bool, ...]
    spherical: tuple[bool, ...]
    shapes: tuple[ShapeEntry, ...]
    faces: tuple[tuple[tuple[int, ...], ...], ...]
    pair_groups: tuple[PairGroup, ...]
    joints: tuple[JointEntry, ...]
    motors: tuple[MotorEntry, ...]
    friction: bool
    restitution: bool
    options: Options
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    broadphase: Broadphase | None = None

    @functools.cached_property
    def _key(self) -> tuple:
        return tuple(getattr(self, field.name) for field in dataclasses.fields(self))

    @functools.cached_property
    def _hash(self) -> int:
        return hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Scene) and self._hash == other._hash and self._key == other._key)

    @property
    def body_count(self) -> int:
        """Number of bodies, static ones included."""
        return len(self.static)

    @functools.cached_property
    def dynamic_bodies(self) -> tuple[int, ...]:
        """Bodies that move, in order; the solver's velocity blocks."""
        return tuple(body for body, is_static in enumerate(self.static) if not is_static)

    @property
    def static_slot_count(self) -> int:
        """Number of contact slots that belong to a pair: one for each admissible pair and contact point."""
        return sum(group.slot_count for group in self.pair_groups)

    @property
    def compact_groups(self) -> tuple[CompactGroup, ...]:
        """Groups of pairs that the broadphase finds."""
        return () if self.broadphase is None else self.broadphase.groups

    @property
    def slot_count(self) -> int:
        """Number of contact slots: those that belong to a pair, then those of the compact groups."""
        return self.static_slot_count + sum(group.slot_count for group in self.compact_groups)

    @functools.cached_property
    def jointed(self) -> frozenset[int]:
        """Bodies that have joints."""
        return frozenset(body for joint in self.joints for body in (joint.parent, joint.child))

    @functools.cached_property
    def all_spherical(self) -> bool:
        """Whether the inertia of every moving body is the same about every axis: then nothing asks for principal axes."""
        return all(self.spherical[body] for body in self.dynamic_bodies)

    @property
    def splits_at_impacts(self) -> bool:
        """Whether steps are split at their impacts."""
        return bool(self.options.impact_events and self.restitution and self.pair_groups)

    @functools.cached_property
    def rebounds_may_gain(self) -> bool:
        """Whether anything bounces whose rebound may take more energy than the impact had.

        Not one free ball on something static, or on another: the impulse of its contact changes no other rate of it.
        """
        several = bool(self.compact_groups) or sum(len(group.bodies_a) for group in self.pair_groups) > 1
        free_balls = all(
            self.static[body] or (kind == "sphere" and body not in self.jointed)
            for group in self.pair_groups
            for bodies, kind in ((group.bodies_a, group.kind_a), (group.bodies_b, group.kind_b))
            for body in bodies
        )
        return self.restitution and (several or not free_balls)

    @property
    def place_count(self) -> int:
        """Number of pairs that the compact groups hold."""
        return sum(group.place_count for group in self.compact_groups)

    @functools.cached_property
    def slot_bodies(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Bodies A and B of each contact slot that belongs to a pair."""
        return tuple(  # type: ignore[return-value]
            tuple(body for group in self.pair_groups for body in getattr(group, side) for _ in range(group.point_count))
            for side in ("bodies_a", "bodies_b")
        )
