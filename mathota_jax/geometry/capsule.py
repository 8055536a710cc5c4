"""Solid capsule (guide 2.2)."""

from typing import Any, ClassVar

import numpy as np

from mathota_jax.geometry.validation import positive_number


class Capsule:
    """All points within `radius` of a segment of length ``2 * half_height`` along the local Y axis.

    Args:
        radius: Radius [m], positive.
        half_height: Half the length [m] of the segment, the caps not included, positive.

    Raises:
        ValueError: if an argument is not a positive finite number.
    """

    kind: ClassVar[str] = "capsule"

    def __init__(self, radius: Any, half_height: Any) -> None:
        self.radius = float(positive_number("Capsule.radius", radius))
        self.half_height = float(positive_number("Capsule.half_height", half_height))

    def __repr__(self) -> str:
        return f"Capsule(radius={self.radius}, half_height={self.half_height})"

    def parameters(self) -> dict[str, np.ndarray]:
        """Float64 size arrays, which become differentiable leaves of the model."""
        return {"radius": np.array(self.radius), "half_height": np.array(self.half_height)}

    def volume(self) -> float:
        """Volume [m^3]: cylinder plus sphere."""
        return np.pi * self.radius**2 * (2.0 * self.half_height + 4.0 / 3.0 * self.radius)

    def unit_inertia(self) -> np.ndarray:
        """Principal moments about the centre for unit mass, shape ``(3,)`` [m^2].

        Exact: a cylinder plus two hemispheres, whose centres of mass lie 3r/8 beyond the ends of the segment (parallel
        axes). Guide 2.2 gives an approximation with an undefined mass.
        """
        r, h = self.radius, self.half_height
        cylinder = 2.0 * h / (2.0 * h + 4.0 / 3.0 * r)
        caps = 1.0 - cylinder
        axial = cylinder * r**2 / 2.0 + caps * 0.4 * r**2
        lateral = cylinder * (r**2 / 4.0 + h**2 / 3.0) + caps * (0.4 * r**2 + h**2 + 0.75 * h * r)
        return np.array([lateral, axial, lateral])

    def bounding_radius(self) -> float:
        """Radius [m] of the smallest centred sphere that contains the shape."""
        return self.radius + self.half_height

    def inradius(self) -> float:
        """Radius [m] of the largest centred sphere inside the shape: the characteristic length of the body."""
        return self.radius
