"""A scene in numbers that every engine reads: bodies, hinges, and the starts of its worlds."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from mathota_jax import Plane
from tests.scenes import GRAVITY

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Body:
    """One body, world frame, gravity along -Y unless the scene says otherwise; planes do not move.

    Attributes:
      shape: a shape of mathota_jax whose centre of mass is its origin.
      mass: [kg]; None for a body that never moves.
      friction: Coulomb coefficient, the same for all bodies of a scene, so that no rule of combination matters.
      restitution: likewise.
      collides: False for bodies that joints alone hold.
    """

    shape: Any
    mass: float | None = 1.0
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    orientation: tuple[float, ...] = UPRIGHT
    velocity: tuple[float, ...] = (0.0, 0.0, 0.0)
    angular_velocity: tuple[float, ...] = (0.0, 0.0, 0.0)
    friction: float = 0.0
    restitution: float = 0.0
    collides: bool = True


@dataclasses.dataclass(frozen=True)
class World:
    """Bodies, and hinges along Z that hang each moving body from the one before it (the first from the world).

    Attributes:
      bodies: static ones first.
      gravity: [m/s^2].
      anchors: one point a moving body, or none for a scene without joints.
    """

    bodies: tuple[Body, ...]
    gravity: tuple[float, float, float] = (0.0, -GRAVITY, 0.0)
    anchors: tuple[tuple[float, float, float], ...] = ()

    @property
    def moving(self) -> tuple[Body, ...]:
        """Bodies with a mass."""
        return tuple(body for body in self.bodies if body.mass is not None)

    def start(self, count: int) -> Motion:
        """The bodies as they are given, in `count` equal worlds."""

        def leaf(name: str) -> np.ndarray:
            values = np.array([getattr(body, name) for body in self.moving], float)
            return np.repeat(values[None], count, axis=0)

        return Motion(*(leaf(field.name) for field in dataclasses.fields(Motion)))


@dataclasses.dataclass(frozen=True)
class Motion:
    """Moving bodies at one time, (world, body, component), or at several with a leading axis; world frame.

    Attributes:
      position: of the centres of mass [m].
      orientation: quaternions (w, x, y, z).
      velocity: of the centres of mass [m/s].
      angular_velocity: [rad/s].
    """

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray

    def map(self, change: Callable[[np.ndarray], np.ndarray]) -> Motion:
        """The same of every leaf."""
        return Motion(*(change(getattr(self, field.name)) for field in dataclasses.fields(self)))

    @property
    def finite(self) -> bool:
        """Whether nothing is NaN or infinite."""
        return all(np.isfinite(getattr(self, field.name)).all() for field in dataclasses.fields(self))


def stack(motions: list[Motion]) -> Motion:
    """Leading axis: time, or world."""
    return Motion(
        *(np.stack([getattr(motion, field.name) for motion in motions]) for field in dataclasses.fields(Motion))
    )


def plane(friction: float, restitution: float = 0.0, normal: tuple[float, float, float] = (0, 1, 0), offset: float = 0):
    """A plane as a body."""
    return Body(Plane(normal=normal, offset=offset), None, friction=friction, restitution=restitution)
