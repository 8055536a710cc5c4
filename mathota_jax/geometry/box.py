"""Solid box (guide 2.3)."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from mathota_jax.geometry.inertia import MassProperties, centered
from mathota_jax.geometry.shape import Bounds, Shape, around
from mathota_jax.geometry.validation import finite_vector
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import Mat3, Vec3, dot


class Box(Shape):
    """Solid box centred at the body origin, edges along the body axes.

    Args:
        half_extents: Half the edge lengths [m], three positive numbers.

    Raises:
        ValueError: if `half_extents` is not three positive finite numbers.
    """

    kind: ClassVar[str] = "box"

    def __init__(self, half_extents: Any) -> None:
        self.half_extents = finite_vector("Box.half_extents", half_extents)
        if np.any(self.half_extents <= 0):
            raise ValueError(f"Box.half_extents must be positive, got {half_extents!r}")

    def __repr__(self) -> str:
        return f"Box(half_extents={tuple(self.half_extents.tolist())})"

    def parameters(self) -> dict[str, np.ndarray]:
        """Float64 size arrays, which become differentiable leaves of the model."""
        return {"half_extents": self.half_extents.copy()}

    @staticmethod
    def mass_of(parameters: dict[str, Any]) -> MassProperties:
        """Moments (hy^2 + hz^2) / 3, ... (guide 2.3)."""
        half = parameters["half_extents"]
        x, y, z = half[0], half[1], half[2]
        return centered(8.0 * x * y * z, [(y**2 + z**2) / 3.0, (z**2 + x**2) / 3.0, (x**2 + y**2) / 3.0])

    @staticmethod
    def bounds_of(parameters: dict[str, Any], pose: Pose) -> Bounds:
        """Sum of the shadows of the half edges (C. Ericson, "Real-Time Collision Detection", 2005, section 4.2.6)."""
        assert pose.rotation is not None
        return around(
            pose.position, Mat3(*(column.map(jnp.abs) for column in pose.rotation)).apply(parameters["half_extents"])
        )

    @staticmethod
    def reach_of(parameters: dict[str, Any]) -> Any:
        """Half the diagonal."""
        half = parameters["half_extents"]
        half = half if isinstance(half, Vec3) else Vec3(*half)
        return dot(half, half) ** 0.5

    def inradius(self) -> float:
        """The smallest half extent [m]."""
        return float(self.half_extents.min())
