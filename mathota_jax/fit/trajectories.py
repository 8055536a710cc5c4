"""Recorded motions to fit to, checked before anything is compiled."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from mathota_jax.model import Model

UNIT_TOLERANCE = 0.01
"""How far from 1 the length of a recorded quaternion may be; within it is normalised."""

CHANNELS = {"position": 3, "orientation": 4, "velocity": 3, "angular_velocity": 3}
"""What can be recorded of a body, with its number of components."""


@dataclasses.dataclass(frozen=True)
class Trajectories:
    """Motions of some bodies of one scene, recorded at a constant rate. NaN stands for what is missing.

    Frame 0 is the initial state. Trajectories of different lengths are padded with NaN.

    Attributes:
        bodies: names of the recorded bodies, in the order of the body axes.
        dt: time between two frames [s].
        position: (trajectory, frame, body, 3) centres of mass [m], world frame; single components may be NaN.
        orientation: (trajectory, frame, body, 4) unit quaternions (w, x, y, z), world from body, or None.
        velocity: (trajectory, frame, body, 3) of the centres of mass [m/s], world frame, or None.
        angular_velocity: (trajectory, frame, body, 3) [rad/s], world frame, or None.
        action: (trajectory, frame - 1, motor) actions between frames, or None for no effort.

    Raises:
        ValueError: wrong shapes, no trajectory, fewer than two frames, a channel of a body that is NaN throughout, a
            trajectory with nothing after its first frame, infinite numbers, quaternions that are not of unit length.
    """

    bodies: tuple[str, ...]
    dt: float
    position: np.ndarray
    orientation: np.ndarray | None = None
    velocity: np.ndarray | None = None
    angular_velocity: np.ndarray | None = None
    action: np.ndarray | None = None

    def __post_init__(self) -> None:
        set_field = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731 - the dataclass is frozen
        set_field("bodies", (self.bodies,) if isinstance(self.bodies, str) else tuple(self.bodies))
        if len(set(self.bodies)) != len(self.bodies) or not self.bodies:
            raise ValueError(f"trajectories: bodies must be different names, at least one, got {self.bodies}")
        if np.ndim(self.dt) != 0 or np.asarray(self.dt).dtype.kind not in "iuf":
            raise ValueError(f"trajectories: dt must be one number of seconds, got {self.dt!r}")
        set_field("dt", float(self.dt))
        if not (self.dt > 0 and math.isfinite(self.dt)):
            raise ValueError(f"trajectories: dt must be a positive number of seconds, got {self.dt}")
        position = _numbers("position", self.position)
        if position.ndim != 4:
            raise ValueError(
                f"trajectories: position must have shape (trajectory, frame, body, 3), got {position.shape}"
            )
        for name, width in CHANNELS.items():
            value = getattr(self, name)
            if value is not None:
                set_field(name, self._channel(name, width, _numbers(name, value), position.shape[:2]))
        if self.action is not None:
            set_field("action", self._actions(position.shape[:2]))
        self._check_content()

    @property
    def count(self) -> int:
        """Number of trajectories."""
        return self.position.shape[0]

    @property
    def frame_count(self) -> int:
        """Frames of the longest trajectory."""
        return self.position.shape[1]

    @property
    def channels(self) -> dict[str, np.ndarray]:
        """What was recorded, by name."""
        return {name: getattr(self, name) for name in CHANNELS if getattr(self, name) is not None}

    def take(self, indices: Any) -> Trajectories:
        """Some of the trajectories, by index or mask."""
        picked = {name: value[indices] for name, value in self.channels.items()}
        action = None if self.action is None else self.action[indices]
        return dataclasses.replace(self, **picked, action=action)

    def check_scene(self, model: Model) -> None:
        """Compares bodies and motors with those of a scene.

        Raises:
            ValueError: a body that the scene does not have or that is static; actions for another number of motors.
        """
        scene = model.scene
        for body in self.bodies:
            if body not in scene.body_names:
                known = ", ".join(f"'{name}'" for name in scene.body_names)
                raise ValueError(f"trajectories: the scene has no body '{body}'; known: {known}")
            if scene.static[scene.body_names.index(body)]:
                raise ValueError(f"trajectories: body '{body}' is static; leave it out")
        if self.action is not None and self.action.shape[-1] != len(scene.motors):
            raise ValueError(
                f"trajectories: action must have one entry for each of the {len(scene.motors)} motors of the scene, got "
                f"{self.action.shape[-1]}"
            )

    def _channel(self, name: str, width: int, value: np.ndarray, outer: tuple[int, ...]) -> np.ndarray:
        expected = (*outer, len(self.bodies), width)
        if value.shape != expected:
            raise ValueError(
                f"trajectories: {name} must have shape {expected} (trajectory, frame, body, {width}), got {value.shape}"
            )
        if name != "orientation":
            return value
        missing = np.isnan(value)
        if np.any(missing.any(-1) & ~missing.all(-1)):
            trajectory, frame, body = np.argwhere(missing.any(-1) & ~missing.all(-1))[0]
            raise ValueError(
                f"trajectories: orientation of '{self.bodies[body]}' in frame {frame} of trajectory {trajectory} is NaN "
                "in part; a missing one is NaN in all four components"
            )
        length = np.linalg.norm(value, axis=-1, keepdims=True)
        if np.any(np.abs(length - 1.0) > UNIT_TOLERANCE):
            trajectory, frame, body, _ = np.argwhere(np.abs(length - 1.0) > UNIT_TOLERANCE)[0]
            raise ValueError(
                f"trajectories: orientation of '{self.bodies[body]}' in frame {frame} of trajectory {trajectory} has the "
                f"length {length[trajectory, frame, body, 0]:.4g}; it must be a unit quaternion (w, x, y, z)"
            )
        return value / length

    def _actions(self, outer: tuple[int, ...]) -> np.ndarray:
        action = _numbers("action", self.action)
        if action.ndim != 3 or action.shape[:2] != (outer[0], outer[1] - 1):
            raise ValueError(
                f"trajectories: action must have shape ({outer[0]}, {outer[1] - 1}, motor), one for each time between two "
                f"frames, got {action.shape}"
            )
        if np.isnan(action).any():
            raise ValueError("trajectories: action must not hold NaN; use 0 for no effort")
        return action

    def _check_content(self) -> None:
        count, frames = self.position.shape[:2]
        if count == 0:
            raise ValueError("trajectories: there is no trajectory")
        if frames < 2:
            raise ValueError(f"trajectories: each needs at least 2 frames, got {frames}")
        for name, value in self.channels.items():
            present = np.asarray(np.isfinite(value).any(axis=(0, 1, 3)))
            for body, found in zip(self.bodies, present.tolist(), strict=True):
                if not found:
                    raise ValueError(
                        f"trajectories: {name} of '{body}' is NaN in every frame; leave out the body or the channel"
                    )
        later = [np.isfinite(value[:, 1:]).any((1, 2, 3)) for value in self.channels.values()]
        empty = ~np.any(later, axis=0)
        if empty.any():
            raise ValueError(
                f"trajectories: trajectory {int(np.argmax(empty))} holds nothing after its first frame; leave it out"
            )


def _numbers(name: str, value: Any) -> np.ndarray:
    if np.iscomplexobj(value):
        raise ValueError(f"trajectories: {name} must be an array of real numbers, got complex ones")
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"trajectories: {name} must be an array of numbers ({error})") from error
    if np.isinf(array).any():
        raise ValueError(f"trajectories: {name} holds infinite numbers; use NaN for what is missing")
    return array
