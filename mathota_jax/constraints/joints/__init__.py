"""Joints: one file each, composed of the row parts in `frames`; `JOINTS` is the registry."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array

from mathota_jax.constraints.assembly import Side
from mathota_jax.constraints.joints import hinge, slider
from mathota_jax.constraints.joints.frames import JointFrames, JointRow


class JointKind(NamedTuple):
    """What the engine knows of a kind of joint.

    Attributes:
      declaration: class that users pass to `SceneBuilder.add_joint`.
      fixed_rows: rows of the motions that the joint forbids.
      fixed_row_count: their number.
      free_sides: Jacobian of the free coordinate.
      coordinate: value of the free coordinate, 0 as built.
      angular: whether the free coordinate is an angle.
    """

    declaration: type
    fixed_rows: Callable[[JointFrames], list[JointRow]]
    fixed_row_count: int
    free_sides: Callable[[JointFrames], tuple[Side, Side]]
    coordinate: Callable[[JointFrames], Array]
    angular: bool


def _kind(declaration: type, module: Any, angular: bool) -> JointKind:
    return JointKind(declaration, module.fixed_rows, 5, module.free_sides, module.coordinate, angular)


JOINTS: dict[str, JointKind] = {
    "hinge": _kind(hinge.Hinge, hinge, angular=True),
    "slider": _kind(slider.Slider, slider, angular=False),
}
