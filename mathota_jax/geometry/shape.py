"""What every shape offers. One formula serves the builder (NumPy) and derivatives by sizes (JAX)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mathota_jax.geometry.inertia import MassProperties, principal_axes
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import Vec3


class Bounds(NamedTuple):
    """Axis-aligned box in the world frame."""

    low: Vec3
    high: Vec3


class Solid(ABC):
    """Something with a volume of uniform density."""

    @abstractmethod
    def mass_properties(self) -> MassProperties:
        """Volume, centre of mass and inertia in the shape's own frame, NumPy float64."""

    @abstractmethod
    def bounding_radius(self) -> float:
        """Radius [m] of the smallest sphere about the shape's origin that contains the shape."""

    @abstractmethod
    def inradius(self) -> float:
        """Radius [m] of the largest sphere about the centre of mass inside the shape: its characteristic length."""

    def volume(self) -> float:
        """Volume [m^3]."""
        return float(self.mass_properties().volume)

    def center_of_mass(self) -> np.ndarray:
        """Centre of mass in the shape's own frame, shape ``(3,)`` [m]."""
        return np.asarray(self.mass_properties().center_of_mass)

    def unit_inertia(self) -> np.ndarray:
        """Principal moments about the centre of mass for unit mass, shape ``(3,)`` [m^2].

        In the order of the axes of the shape's own frame that are closest to the principal axes.
        """
        return principal_axes(np.asarray(self.mass_properties().unit_inertia))[0]


class Shape(Solid):
    """Convex shape, plane or heightfield of one kind, with the formulas that depend on its sizes alone.

    The static methods take the sizes by name. `mass_of` takes natural arrays of NumPy or JAX (one shape; `jax.vmap` for
    more). `bounds_of` and `reach_of` belong to the engine: worlds last, components of shape ``(element, world)``.
    """

    kind: ClassVar[str]
    static_only: ClassVar[bool] = False

    @abstractmethod
    def parameters(self) -> dict[str, np.ndarray]:
        """Float64 size arrays, which become differentiable leaves of the model."""

    @staticmethod
    @abstractmethod
    def mass_of(parameters: dict[str, Any]) -> MassProperties:
        """Volume, centre of mass and inertia as a function of the sizes."""

    @staticmethod
    @abstractmethod
    def bounds_of(parameters: dict[str, Any], pose: Pose) -> Bounds:
        """Smallest axis-aligned box that contains the shape."""

    @staticmethod
    @abstractmethod
    def reach_of(parameters: dict[str, Any]) -> Any:
        """Radius [m] of the smallest sphere about the shape's origin that contains the shape."""

    def mass_properties(self) -> MassProperties:
        """Volume, centre of mass and inertia in the shape's own frame, NumPy float64."""
        return self.mass_of(self.parameters())

    def bounding_radius(self) -> float:
        """Radius [m] of the smallest sphere about the shape's origin that contains the shape."""
        return float(self.reach_of(self.parameters()))


def around(center: Vec3, half: Vec3) -> Bounds:
    """Bounds of given half size about a centre."""
    return Bounds(center - half, center + half)
