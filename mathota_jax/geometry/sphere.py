"""Solid sphere (guide 2.1)."""

from typing import Any, ClassVar

import numpy as np

from mathota_jax.geometry.inertia import MassProperties, centered
from mathota_jax.geometry.shape import Bounds, Shape, around
from mathota_jax.geometry.validation import positive_number
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import Vec3


class Sphere(Shape):
    """Solid sphere centred at the body origin.

    Args:
        radius: Radius [m], positive.

    Raises:
        ValueError: if the radius is not a positive finite number.
    """

    kind: ClassVar[str] = "sphere"

    def __init__(self, radius: Any) -> None:
        self.radius = float(positive_number("Sphere.radius", radius))

    def __repr__(self) -> str:
        return f"Sphere(radius={self.radius})"

    def parameters(self) -> dict[str, np.ndarray]:
        """Float64 size arrays, which become differentiable leaves of the model."""
        return {"radius": np.array(self.radius)}

    @staticmethod
    def mass_of(parameters: dict[str, Any]) -> MassProperties:
        """Moments 2/5 r^2 (guide 2.1)."""
        r = parameters["radius"]
        return centered(4.0 / 3.0 * np.pi * r**3, [0.4 * r**2] * 3)

    @staticmethod
    def bounds_of(parameters: dict[str, Any], pose: Pose) -> Bounds:
        """The radius to every side."""
        r = parameters["radius"]
        return around(pose.position, Vec3(r, r, r))

    @staticmethod
    def reach_of(parameters: dict[str, Any]) -> Any:
        """The radius."""
        return parameters["radius"]

    def inradius(self) -> float:
        """The radius [m]."""
        return self.radius
