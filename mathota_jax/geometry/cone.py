"""Solid cone."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from mathota_jax.geometry.cylinder import disc_half_extents
from mathota_jax.geometry.inertia import MassProperties, centered
from mathota_jax.geometry.shape import Bounds, Shape
from mathota_jax.geometry.validation import positive_number
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import Vec3


class Cone(Shape):
    """Solid cone along the local Y axis whose centroid is the body origin.

    The apex lies at ``y = 1.5 half_height``, the base disc at ``y = -0.5 half_height``.

    Args:
        radius: Radius of the base [m], positive.
        half_height: Half the height [m], positive.

    Raises:
        ValueError: if an argument is not a positive finite number.
    """

    kind: ClassVar[str] = "cone"

    def __init__(self, radius: Any, half_height: Any) -> None:
        self.radius = float(positive_number("Cone.radius", radius))
        self.half_height = float(positive_number("Cone.half_height", half_height))

    def __repr__(self) -> str:
        return f"Cone(radius={self.radius}, half_height={self.half_height})"

    def parameters(self) -> dict[str, np.ndarray]:
        """Float64 size arrays, which become differentiable leaves of the model."""
        return {"radius": np.array(self.radius), "half_height": np.array(self.half_height)}

    @staticmethod
    def mass_of(parameters: dict[str, Any]) -> MassProperties:
        """Moments 3/10 r^2 about the axis and 3/20 r^2 + 3/80 (2h)^2 across it, about the centroid."""
        r, h = parameters["radius"], parameters["half_height"]
        lateral = 0.15 * (r**2 + h**2)
        return centered(2.0 / 3.0 * np.pi * r**2 * h, [lateral, 0.3 * r**2, lateral])

    @staticmethod
    def bounds_of(parameters: dict[str, Any], pose: Pose) -> Bounds:
        """The base disc and the apex."""
        assert pose.rotation is not None
        axis, h = pose.rotation.column_y, parameters["half_height"]
        apex, base = pose.position + axis * (1.5 * h), pose.position - axis * (0.5 * h)
        disc = disc_half_extents(axis) * parameters["radius"]
        low, high = base - disc, base + disc
        return Bounds(Vec3(*map(jnp.minimum, apex, low)), Vec3(*map(jnp.maximum, apex, high)))

    @staticmethod
    def reach_of(parameters: dict[str, Any]) -> Any:
        """To the apex or to the rim, whichever is farther."""
        r, h = parameters["radius"], parameters["half_height"]
        apex, rim = 1.5 * h, (r**2 + 0.25 * h**2) ** 0.5
        # The larger of the two by arithmetic that NumPy and JAX share; where they are equal either derivative will do.
        return apex * (apex >= rim) + rim * (apex < rim)

    def inradius(self) -> float:
        """Distance [m] from the centroid to the base or to the side, whichever is nearer."""
        r, h = self.radius, self.half_height
        return min(0.5 * h, 0.75 * r * 2.0 * h / float(np.hypot(2.0 * h, r)))
