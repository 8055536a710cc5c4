"""The recorded tosses: read, checked, and their free flight."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

GRAVITY = 9.81
UP = np.array([0.0, 0.0, 1.0])
CLEARANCE = 0.06
"""Height of the lowest corner over the table, as a share of the half width, above which the cube surely flies."""

SHAPES = {
    "length": (),
    "position": (None, 3),
    "orientation": (None, 4),
    "velocity": (None, 3),
    "angular_velocity": (None, 3),
}
"""Arrays of the file, without the axis of tosses; None for that of frames."""


@dataclasses.dataclass(frozen=True)
class Tosses:
    """Tosses of one cube, frames padded with NaN.

    Attributes:
        length: (toss,) valid frames.
        position, orientation, velocity, angular_velocity: (toss, frame, 3 or 4), as in the file.
        dt: time between frames [s].
        mass: [kg].
        half_width: given half width [m], by which errors are counted.
    """

    length: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    dt: float
    mass: float
    half_width: float

    @property
    def count(self) -> int:
        """Number of tosses."""
        return len(self.length)

    def take(self, mask: np.ndarray) -> Tosses:
        """Some of the tosses."""
        return dataclasses.replace(self, **{name: getattr(self, name)[mask] for name in SHAPES})

    def seen(self, count: int) -> np.ndarray:
        """(toss, count) which frames after the first are valid."""
        return np.arange(1, count + 1)[None] < self.length[:, None]

    def lowest_corner(self) -> np.ndarray:
        """(toss, frame) height of the lowest corner of the cube as given [m]."""
        w, x, y, z = np.moveaxis(self.orientation, -1, 0)
        row = np.abs(2 * (x * z - w * y)) + np.abs(2 * (y * z + w * x)) + np.abs(1 - 2 * (x * x + y * y))
        return self.position[..., 2] - self.half_width * row

    def flight_length(self) -> np.ndarray:
        """(toss,) frames before the first touch, at least 3."""
        return np.maximum(np.argmax(self.lowest_corner() < CLEARANCE * self.half_width, axis=1), 3)

    def resting_half_width(self) -> float:
        """Median height of the centre in the last frame: the half width that the cube rests on."""
        return float(np.median(self.position[np.arange(self.count), self.length - 1, 2]))

    def gravity(self) -> float:
        """Acceleration of free fall in lengths as recorded, which are short by the ratio of the two half widths."""
        return GRAVITY * self.resting_half_width() / self.half_width

    def centre_of_mass(self) -> np.ndarray:
        """(3,) from the recorded centre of the cube, body frame [m].

        In flight the centre of mass follows a parabola and the recorded one turns about it: linear least squares over the
        flights of all tosses.
        """
        columns, sides = [], []
        for toss, frames in enumerate(self.flight_length()):
            time = np.arange(frames) * self.dt
            design = np.stack([np.ones(frames), time], 1)
            without_line = np.eye(frames) - design @ np.linalg.pinv(design)
            axes = as_rotation(self.orientation[toss, :frames]).as_matrix()
            risen = self.position[toss, :frames] + fall(self.gravity(), time)
            columns.append(np.tensordot(without_line, axes, 1).reshape(-1, 3))
            sides.append((without_line @ risen).ravel())
        return -np.linalg.lstsq(np.concatenate(columns), np.concatenate(sides), rcond=None)[0]

    def recorded_start(self, centre: np.ndarray, gravity: float) -> tuple[np.ndarray, ...]:
        """Position and velocity of the centre of mass, orientation and angular velocity in the first frame, (toss, 3 or 4).

        The recorded velocity is a backward difference and so that of half a frame earlier.

        Args:
            centre: of mass from the recorded centre, body frame [m].
            gravity: [m/s^2], in lengths as recorded.
        """
        rate = self.angular_velocity[:, 0]
        arm = as_rotation(self.orientation[:, 0]).apply(centre)
        velocity = self.velocity[:, 0] - fall(gravity, self.dt) / self.dt + np.cross(rate, arm)
        return self.position[:, 0] + arm, self.orientation[:, 0], velocity, rate

    def flight_start(self, centre: np.ndarray, gravity: float) -> tuple[np.ndarray, ...]:
        """The same from least squares over all frames of the flight: a parabola, and a turn at a constant rate."""
        rows = [self._flight(toss, frames, centre, gravity) for toss, frames in enumerate(self.flight_length())]
        return tuple(np.stack(parts) for parts in zip(*rows, strict=True))

    def _flight(self, toss: int, frames: int, centre: np.ndarray, gravity: float) -> tuple[np.ndarray, ...]:
        time = np.arange(frames) * self.dt
        design = np.stack([np.ones(frames), time], 1)
        seen = as_rotation(self.orientation[toss, :frames])
        begin, rate = seen[0], self.angular_velocity[toss, 0].copy()
        for _ in range(20):  # Gauss-Newton with the Jacobian of small turns: linear convergence
            error = (seen * (Rotation.from_rotvec(rate * time[:, None]) * begin).inv()).as_rotvec()
            turn, change = np.linalg.lstsq(design, error, rcond=None)[0]
            begin, rate = Rotation.from_rotvec(turn) * begin, rate + change
        risen = self.position[toss, :frames] + seen.apply(centre) + fall(gravity, time)
        position, velocity = np.linalg.lstsq(design, risen, rcond=None)[0]
        return position, begin.as_quat()[[3, 0, 1, 2]], velocity, rate


def as_rotation(orientation: np.ndarray) -> Rotation:
    """Of quaternions (..., 4), w first."""
    return Rotation.from_quat(orientation[..., [1, 2, 3, 0]])


def turned(orientation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """(toss, frame, 3) a vector of the body frame in the world; NaN where the orientation is."""
    seen = np.isfinite(orientation[..., 0])
    whole = np.where(seen[..., None], orientation, [1.0, 0.0, 0.0, 0.0])
    found = as_rotation(whole.reshape(-1, 4)).apply(vector).reshape(*seen.shape, 3)
    return np.where(seen[..., None], found, np.nan)


def fall(gravity: float, time: np.ndarray | float) -> np.ndarray:
    """How far things fall from rest, (..., 3)."""
    return np.multiply.outer(gravity * np.square(time) / 2, UP)


def load_tosses(path: Path) -> Tosses:
    """Reads and checks the file.

    Raises:
        FileNotFoundError: there is none; the message says where the data come from.
        ValueError: it is no NPZ file, or lacks an array or has one of the wrong shape.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: no such file; the tosses are those of github.com/DAIRLab/contact-nets (data/tosses_processed), "
            "converted as `python -m training.cube_toss --help` says"
        )
    try:
        with np.load(path, allow_pickle=False) as archive:
            content = {key: archive[key] for key in archive.files}
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not an NPZ file of plain arrays ({error})") from error
    for name in (*SHAPES, "dt", "mass", "half_width"):
        if name not in content:
            raise ValueError(f"{path}: the array '{name}' is missing")
    outer = content["position"].shape[:2]
    for name, inner in SHAPES.items():
        expected = (outer[0], *(outer[1] if size is None else size for size in inner))
        if content[name].shape != expected:
            raise ValueError(f"{path}: '{name}' must have shape {expected}, got {content[name].shape}")
    length = content["length"].astype(int)
    if outer[0] == 0 or length.min() < 4 or length.max() > outer[1]:
        raise ValueError(f"{path}: length must lie between 4 and the {outer[1]} frames of the arrays")
    position, orientation, velocity, angular_velocity = (content[name].astype(float) for name in list(SHAPES)[1:])
    dt, mass, half_width = (float(content[name]) for name in ("dt", "mass", "half_width"))
    return Tosses(length, position, orientation, velocity, angular_velocity, dt, mass, half_width)
