"""Solid cylinder."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from mathota_jax.geometry.inertia import MassProperties, centered
from mathota_jax.geometry.shape import Bounds, Shape, around
from mathota_jax.geometry.validation import positive_number
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.safe import safe_sqrt
from mathota_jax.spatial.vector import Vec3


class Cylinder(Shape):
    """Solid cylinder centred at the body origin, axis along the local Y axis.

    Args:
        radius: Radius [m], positive.
        half_height: Half the height [m], positive.

    Raises:
        ValueError: if an argument is not a positive finite number.
    """

    kind: ClassVar[str] = "cylinder"

    def __init__(self, radius: Any, half_height: Any) -> None:
        self.radius = float(positive_number("Cylinder.radius", radius))
        self.half_height = float(positive_number("Cylinder.half_height", half_height))

    def __repr__(self) -> str:
        return f"Cylinder(radius={self.radius}, half_height={self.half_height})"

    def parameters(self) -> dict[str, np.ndarray]:
        """Float64 size arrays, which become differentiable leaves of the model."""
        return {"radius": np.array(self.radius), "half_height": np.array(self.half_height)}

    @staticmethod
    def mass_of(parameters: dict[str, Any]) -> MassProperties:
        """Moments r^2 / 2 about the axis and r^2 / 4 + h^2 / 3 across it, h being half the height."""
        r, h = parameters["radius"], parameters["half_height"]
        lateral = r**2 / 4.0 + h**2 / 3.0
        return centered(2.0 * np.pi * r**2 * h, [lateral, r**2 / 2.0, lateral])

    @staticmethod
    def bounds_of(parameters: dict[str, Any], pose: Pose) -> Bounds:
        """The shadow of the axis and that of the discs at its ends."""
        assert pose.rotation is not None
        axis = pose.rotation.column_y
        disc = disc_half_extents(axis) * parameters["radius"]
        return around(pose.position, disc + axis.map(jnp.abs) * parameters["half_height"])

    @staticmethod
    def reach_of(parameters: dict[str, Any]) -> Any:
        """To the rim."""
        return (parameters["radius"] ** 2 + parameters["half_height"] ** 2) ** 0.5

    def inradius(self) -> float:
        """The smaller of radius and half height [m]."""
        return min(self.radius, self.half_height)


def disc_half_extents(axis: Vec3) -> Vec3:
    """Half size of the axis-aligned bounds of a unit disc with the unit normal `axis`: the sine of its angle to each axis.

    The sine of a component comes from the two others; one minus its square would cancel.
    """
    x, y, z = (component * component for component in axis)
    return Vec3(safe_sqrt(y + z), safe_sqrt(z + x), safe_sqrt(x + y))
