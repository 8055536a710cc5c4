"""Solid box (guide 2.3)."""

from typing import Any, ClassVar

import numpy as np

from mathota_jax.geometry.validation import finite_vector


class Box:
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

    def volume(self) -> float:
        """Volume [m^3]."""
        return 8.0 * float(np.prod(self.half_extents))

    def unit_inertia(self) -> np.ndarray:
        """Principal moments about the centre for unit mass, shape ``(3,)`` [m^2]: (hy^2 + hz^2) / 3, ... (2.3)."""
        squares = self.half_extents**2
        return (squares.sum() - squares) / 3.0

    def bounding_radius(self) -> float:
        """Radius [m] of the smallest centred sphere that contains the shape."""
        return float(np.linalg.norm(self.half_extents))

    def inradius(self) -> float:
        """Radius [m] of the largest centred sphere inside the shape: the characteristic length of the body."""
        return float(self.half_extents.min())
