"""Fixed: no relative motion is free (guide 9.3)."""

from __future__ import annotations

import dataclasses
from typing import Any

from mathota_jax.constraints.joints.frames import JointFrames
from mathota_jax.constraints.joints.kind import JointKind
from mathota_jax.constraints.joints.rows import JointRow, orientation_rows, point_rows


@dataclasses.dataclass(frozen=True)
class Fixed:
    """Joint that holds the child as it is to the parent, like a weld.

    Args:
      parent, child: handles or names of the two bodies; the parent may be static.
      anchor: (3,) point [m] at which forces of the joint act, world frame at build time; None for the child's centre of
        mass.
    """

    parent: Any
    child: Any
    anchor: Any = None


def fixed_rows(frames: JointFrames) -> list[JointRow]:
    """Three rows hold the anchors together, three the orientation."""
    return [*point_rows(frames), *orientation_rows(frames)]


KIND = JointKind(Fixed, fixed_rows, 6, 3)
