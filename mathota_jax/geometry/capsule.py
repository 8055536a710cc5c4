"""Solid capsule (guide 2.2)."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from mathota_jax.geometry.inertia import MassProperties, centered
from mathota_jax.geometry.shape import Bounds, Shape, around
from mathota_jax.geometry.validation import positive_number
from mathota_jax.spatial.pose import Pose


class Capsule(Shape):
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

    @staticmethod
    def mass_of(parameters: dict[str, Any]) -> MassProperties:
        """Cylinder plus sphere.

        Exact: a cylinder plus two hemispheres, whose centres of mass lie 3r/8 beyond the ends of the segment (parallel
        axes). Guide 2.2 gives an approximation with an undefined mass.
        """
        r, h = parameters["radius"], parameters["half_height"]
        cylinder = 2.0 * h / (2.0 * h + 4.0 / 3.0 * r)
        caps = 1.0 - cylinder
        axial = cylinder * r**2 / 2.0 + caps * 0.4 * r**2
        lateral = cylinder * (r**2 / 4.0 + h**2 / 3.0) + caps * (0.4 * r**2 + h**2 + 0.75 * h * r)
        return centered(np.pi * r**2 * (2.0 * h + 4.0 / 3.0 * r), [lateral, axial, lateral])

    @staticmethod
    def bounds_of(parameters: dict[str, Any], pose: Pose) -> Bounds:
        """The shadow of the segment, and the radius to every side."""
        assert pose.rotation is not None
        half = pose.rotation.column_y.map(lambda c: jnp.abs(c) * parameters["half_height"] + parameters["radius"])
        return around(pose.position, half)

    @staticmethod
    def reach_of(parameters: dict[str, Any]) -> Any:
        """To the top of a cap."""
        return parameters["radius"] + parameters["half_height"]

    def inradius(self) -> float:
        """The radius [m]."""
        return self.radius
