"""Infinite plane (guide 2.4)."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from mathota_jax.geometry.inertia import MassProperties
from mathota_jax.geometry.shape import Bounds, Shape
from mathota_jax.geometry.validation import finite_number, finite_vector
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import Vec3


class Plane(Shape):
    """Static half space ``normal . x <= offset``; contacts push along the normal.

    Args:
        normal: Outward direction, world frame, three numbers, not all zero; normalised here.
        offset: Distance [m] of the plane from the origin along the unit normal.

    Raises:
        ValueError: if the normal is zero or an argument is not finite.
    """

    kind: ClassVar[str] = "plane"
    static_only: ClassVar[bool] = True

    def __init__(self, normal: Any, offset: Any = 0.0) -> None:
        vector = finite_vector("Plane.normal", normal)
        largest = np.abs(vector).max()
        if largest == 0:
            raise ValueError(f"Plane.normal must not be the zero vector, got {normal!r}")
        vector = vector / largest  # first, so that the squares neither overflow nor vanish
        self.normal = vector / np.linalg.norm(vector)
        self.offset = float(finite_number("Plane.offset", offset))

    def __repr__(self) -> str:
        return f"Plane(normal={tuple(self.normal.tolist())}, offset={self.offset})"

    def parameters(self) -> dict[str, np.ndarray]:
        """Float64 arrays, which become differentiable leaves of the model."""
        return {"normal": self.normal.copy(), "offset": np.array(self.offset)}

    @staticmethod
    def mass_of(parameters: dict[str, Any]) -> MassProperties:
        """Raises ValueError: a plane is infinite."""
        raise ValueError("Plane has neither volume nor inertia; add it with static=True")

    @staticmethod
    def bounds_of(parameters: dict[str, Any], pose: Pose) -> Bounds:
        """Everything."""
        infinite = Vec3(*[jnp.full_like(parameters["offset"], jnp.inf)] * 3)
        return Bounds(-infinite, infinite)

    @staticmethod
    def reach_of(parameters: dict[str, Any]) -> Any:
        """Infinite."""
        return parameters["offset"] * 0.0 + np.inf

    def inradius(self) -> float:
        """Infinite: a plane never is the smaller body of a pair."""
        return float("inf")
