"""Solid sphere (guide 2.1)."""

from typing import Any, ClassVar

import numpy as np

from mathota_jax.geometry.validation import positive_number


class Sphere:
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

    def volume(self) -> float:
        """Volume [m^3]."""
        return 4.0 / 3.0 * np.pi * self.radius**3

    def unit_inertia(self) -> np.ndarray:
        """Principal moments about the centre for unit mass, shape ``(3,)`` [m^2]: 2/5 r^2 (guide 2.1)."""
        return np.full(3, 0.4 * self.radius**2)

    def bounding_radius(self) -> float:
        """Radius [m] of the smallest centred sphere that contains the shape."""
        return self.radius

    def inradius(self) -> float:
        """Radius [m] of the largest centred sphere inside the shape: the characteristic length of the body."""
        return self.radius
