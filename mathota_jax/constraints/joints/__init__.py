"""Joints: one file each, composed of the row parts in `rows`; `JOINTS` is the registry."""

from __future__ import annotations

from mathota_jax.constraints.joints import ball_and_socket, distance, fixed, hinge, slider
from mathota_jax.constraints.joints.kind import JointKind

JOINTS: dict[str, JointKind] = {
    "ball_and_socket": ball_and_socket.KIND,
    "hinge": hinge.KIND,
    "slider": slider.KIND,
    "fixed": fixed.KIND,
    "distance": distance.KIND,
}
