"""What the engine knows of a kind of joint."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from jax import Array

from mathota_jax.constraints.joints.frames import JointFrames
from mathota_jax.constraints.joints.rows import JointRow, Sides

OUT_OF_REACH = 1e9
"""Limit [m] and cap [N] that stand for none: an infinite one would turn into NaN in derivatives."""


class Coordinate(NamedTuple):
    """A scalar coordinate of a joint.

    Attributes:
      value: of each joint, 0 as built (but for a length).
      sides: its Jacobian.
      angular: whether it is an angle, in (-pi, pi].
    """

    value: Callable[[JointFrames], Array]
    sides: Callable[[JointFrames], Sides]
    angular: bool


class JointKind(NamedTuple):
    """What the engine knows of a kind of joint.

    Attributes:
      declaration: class that users pass to `SceneBuilder.add_joint`.
      fixed_rows: rows of the motions that the joint forbids.
      fixed_row_count: their number.
      fixed_translations: how many of them, the first ones, hold translations; the others hold rotations.
      coordinate: that limits act on, and springs and motors if it is the joint's only freedom; None for none.
      free_sides: Jacobians of the motions that damping and dry friction resist.
      free_count: their number.
      swing_row: stop of a cone about the axis, given its half angle (joint, world).
    """

    declaration: type
    fixed_rows: Callable[[JointFrames], list[JointRow]]
    fixed_row_count: int
    fixed_translations: int
    coordinate: Coordinate | None = None
    free_sides: Callable[[JointFrames], list[Sides]] = lambda frames: []
    free_count: int = 0
    swing_row: Callable[[JointFrames, Array], JointRow] | None = None

    def row_count(self, features: tuple[str, ...]) -> int:
        """Number of rows of a joint with the given features."""
        along_all = sum(feature in ("damping", "friction") for feature in features)
        return self.fixed_row_count + len(features) + along_all * (self.free_count - 1)


def scalar_kind(
    declaration: type,
    fixed_rows: Callable[[JointFrames], list[JointRow]],
    fixed_row_count: int,
    fixed_translations: int,
    coordinate: Coordinate,
) -> JointKind:
    """A kind whose only freedom, or only interest, is one coordinate."""
    return JointKind(
        declaration,
        fixed_rows,
        fixed_row_count,
        fixed_translations,
        coordinate,
        lambda frames: [coordinate.sides(frames)],
        1,
    )
