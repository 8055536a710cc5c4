"""`Scene`: the static structure of a model. Equal scenes share one compilation; what a scene lacks is not traced."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

from mathota_jax.options import Options


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


class JointEntry(NamedTuple):
    """One joint. `limited` and `damped` say whether its limit and damping rows exist."""

    kind: str
    parent: int
    child: int
    limited: bool
    damped: bool


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Static description of a scene: which bodies, shapes, pairs, joints and features exist.

    Attributes:
      static: for each body, whether it never moves.
      spherical: for each body, whether its inertia is the same about every axis.
      shapes: collision shapes in order of adding.
      faces: for each polyhedron, vertex indices of its polygonal faces, counter-clockwise seen from outside.
      pair_groups: admissible pairs by shape kinds (no static-static, no jointed, no excluded pair).
      joints: joints in order of adding.
      motors: joint that each entry of the action drives.
      friction: whether any admissible pair has friction; otherwise there are no tangent rows.
      restitution: whether any admissible pair bounces; otherwise there is no event code.
      options: the settings, `dt` excepted (a leaf of the model).
      body_names, joint_names: for messages and look-up.
    """

    static: tuple[bool, ...]
    spherical: tuple[bool, ...]
    shapes: tuple[ShapeEntry, ...]
    faces: tuple[tuple[tuple[int, ...], ...], ...]
    pair_groups: tuple[PairGroup, ...]
    joints: tuple[JointEntry, ...]
    motors: tuple[int, ...]
    friction: bool
    restitution: bool
    options: Options
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]

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
    def slot_count(self) -> int:
        """Number of contact slots: one for each admissible pair and contact point."""
        return sum(group.slot_count for group in self.pair_groups)

    @functools.cached_property
    def slot_bodies(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Bodies A and B of each contact slot."""
        return tuple(  # type: ignore[return-value]
            tuple(body for group in self.pair_groups for body in getattr(group, side) for _ in range(group.point_count))
            for side in ("bodies_a", "bodies_b")
        )
