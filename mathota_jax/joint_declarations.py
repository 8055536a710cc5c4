"""What a builder has been told of joints and motors, checked, in NumPy float64."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from mathota_jax.constraints.joints import JOINTS
from mathota_jax.constraints.joints.kind import OUT_OF_REACH, JointKind
from mathota_jax.declarations import Body, number, positive
from mathota_jax.geometry.validation import finite_vector
from mathota_jax.rotation import frame_with_axis, relative_rotation, rotate_back

OPEN = np.asarray([-OUT_OF_REACH, OUT_OF_REACH])

MOTOR_KINDS = ("torque", "velocity", "position")


@dataclasses.dataclass
class Joint:
    """A joint; anchors from the centres of mass and frames in the body frames. `Model` says what the numbers are."""

    name: str
    kind: str
    parent: int
    child: int
    anchor_parent: np.ndarray
    anchor_child: np.ndarray
    frame_parent: np.ndarray
    frame_child: np.ndarray
    limits: np.ndarray = dataclasses.field(default_factory=OPEN.copy)
    swing: float = math.pi
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    armature: float = 0.0

    @property
    def features(self) -> tuple[str, ...]:
        """Features beside motors, see `JointEntry`."""
        lower, upper = self.limits
        locked = lower == upper
        elastic = self.stiffness > 0 or self.armature > 0
        present = {
            "locked": locked,
            "lower": not locked and lower > self.least,
            "upper": not locked and upper < OUT_OF_REACH,
            "swing": self.swing < math.pi,
            "damping": self.damping > 0 and not elastic,
            "spring": elastic,
            "friction": self.friction > 0,
        }
        return tuple(feature for feature, is_present in present.items() if is_present)

    @property
    def least(self) -> float:
        """Coordinate below which there is no need for a stop: no length is negative."""
        return 0.0 if self.kind == "distance" else -OUT_OF_REACH


@dataclasses.dataclass
class Motor:
    """A motor on the coordinate of a joint."""

    joint: int
    kind: str
    limit: float
    gear: float
    cap: float
    stiffness: float
    damping: float


def kind_of(label: str, joint: Any) -> str:
    """Key in `JOINTS` of a joint declaration."""
    found = next((key for key, value in JOINTS.items() if isinstance(joint, value.declaration)), None)
    if found is None:
        known = ", ".join(value.declaration.__name__ for value in JOINTS.values())
        raise ValueError(f"{label}: must be one of {known}, got {joint!r}")
    return found


def declare_joint(name: str, kind_name: str, joint: Any, parent: int, child: int, bodies: list[Body]) -> Joint:
    """A joint between two bodies at their present poses."""
    label, kind = f"joint '{name}'", JOINTS[kind_name]
    ends = [bodies[body] for body in (parent, child)]
    points = _anchors(label, joint, ends[1])
    frame = frame_with_axis(_axis(label, joint))
    anchors = [rotate_back(end.orientation, point - end.position) for end, point in zip(ends, points, strict=True)]
    frames = [relative_rotation(end.orientation, frame) for end in ends]
    declared = Joint(name, kind_name, parent, child, anchors[0], anchors[1], frames[0], frames[1])
    length = float(np.linalg.norm(points[1] - points[0]))
    if hasattr(joint, "lengths"):
        declared.limits = _lengths(label, joint.lengths, length)
    elif kind.coordinate is not None:
        key = "twist" if hasattr(joint, "twist") else "limits"
        declared.limits = _limits(label, key, getattr(joint, key), kind.coordinate.angular)
    if getattr(joint, "swing", None) is not None:
        declared.swing = number(f"{label}: swing", joint.swing, 0.0, math.pi)
    for option in ("damping", "friction", "stiffness", "armature"):
        if hasattr(joint, option):
            setattr(declared, option, number(f"{label}: {option}", getattr(joint, option), 0.0, math.inf))
    if hasattr(joint, "rest"):
        built = length if hasattr(joint, "lengths") else 0.0
        declared.rest = built if joint.rest is None else number(f"{label}: rest", joint.rest, -math.inf, math.inf)
    _check_freedom(label, declared, kind)
    return declared


def declare_motor(label: str, joint: Joint, index: int, kind: str, given: dict[str, Any]) -> Motor:
    """A motor on the joint of an index."""
    if kind not in MOTOR_KINDS:
        known = ", ".join(f'"{known}"' for known in MOTOR_KINDS)
        raise ValueError(f"{label}: kind must be one of {known}, got {kind!r}")
    if JOINTS[joint.kind].free_count != 1 or "locked" in joint.features:
        raise ValueError(
            f"{label}: a {JOINTS[joint.kind].declaration.__name__} without a single free coordinate can not be driven"
        )
    if given["cap"] is not None and kind == "torque":
        raise ValueError(f'{label}: cap is for kinds "velocity" and "position"; limit and gear bound a torque')
    for option in ("stiffness", "damping"):
        if given[option] and kind != "position":
            raise ValueError(f'{label}: {option} is for kind "position", got kind {kind!r}')
    motor = Motor(
        joint=index,
        kind=kind,
        limit=positive(f"{label}: limit", given["limit"]),
        gear=number(f"{label}: gear", given["gear"], -math.inf, math.inf),
        cap=OUT_OF_REACH if given["cap"] is None else positive(f"{label}: cap", given["cap"]),
        stiffness=number(f"{label}: stiffness", given["stiffness"], 0.0, math.inf),
        damping=number(f"{label}: damping", given["damping"], 0.0, math.inf),
    )
    if kind == "position" and motor.stiffness == 0:
        raise ValueError(f"{label}: a position motor needs a positive stiffness, got 0")
    return motor


def _anchors(label: str, joint: Any, child: Body) -> tuple[np.ndarray, np.ndarray]:
    """Anchors of the parent and the child, world frame."""
    if joint.anchor is None and not hasattr(joint, "axis") and not hasattr(joint, "child_anchor"):
        return child.position, child.position
    anchor = finite_vector(f"{label}: anchor", joint.anchor)
    if not hasattr(joint, "child_anchor"):
        return anchor, anchor
    if joint.child_anchor is None:
        return anchor, child.position
    return anchor, finite_vector(f"{label}: child_anchor", joint.child_anchor)


def _axis(label: str, joint: Any) -> np.ndarray:
    limited = [key for key in ("swing", "twist") if getattr(joint, key, None) is not None]
    if not hasattr(joint, "axis") or (joint.axis is None and hasattr(joint, "swing")):
        if limited:
            raise ValueError(f"{label}: {' and '.join(limited)} refer to an axis; give one")
        return np.asarray([1.0, 0.0, 0.0])
    axis = finite_vector(f"{label}: axis", joint.axis)
    if not np.any(axis):
        raise ValueError(f"{label}: axis must not be the zero vector")
    return axis


def _limits(label: str, key: str, value: Any, angular: bool) -> np.ndarray:
    """Lower and upper limit of a coordinate, out of reach where there is none."""
    if value is None:
        return OPEN.copy()
    pair = _pair(label, key, value)
    if angular and any(math.isfinite(limit) and abs(limit) > math.pi for limit in pair):
        raise ValueError(f"{label}: {key} of an angle must lie between -pi and pi rad, got {value!r}")
    return np.clip(pair, -OUT_OF_REACH, OUT_OF_REACH)


def _lengths(label: str, value: Any, built: float) -> np.ndarray:
    """Smallest and largest length."""
    value = built if value is None else value
    pair = _pair(label, "lengths", (value, value) if np.ndim(value) == 0 else value)
    if pair[0] < 0:
        raise ValueError(f"{label}: lengths must not be negative, got {value!r}")
    if pair[1] == 0:
        raise ValueError(f"{label}: a length of 0 has no direction; use BallAndSocket, or anchors that are apart")
    return np.clip(pair, 0.0, OUT_OF_REACH)


def _pair(label: str, key: str, value: Any) -> np.ndarray:
    try:
        pair = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        pair = np.zeros(0)
    if pair.shape != (2,) or np.any(np.isnan(pair)):
        raise ValueError(f"{label}: {key} must be a pair (lower, upper) of numbers, got {value!r}")
    if pair[0] > pair[1]:
        raise ValueError(f"{label}: {key}: lower limit {pair[0]:g} is larger than upper limit {pair[1]:g}; swap them")
    return pair


def _check_freedom(label: str, joint: Joint, kind: JointKind) -> None:
    """What acts along the coordinate needs it to be free."""
    if "locked" not in joint.features:
        return
    for option in ("damping", "friction", "stiffness", "armature"):
        if kind.free_count == 1 and getattr(joint, option) > 0:
            raise ValueError(f"{label}: {option} has no effect where equal limits hold the coordinate; leave it out")
