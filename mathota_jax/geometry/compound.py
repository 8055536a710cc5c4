"""Several convex shapes on one body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mathota_jax.geometry.inertia import MassProperties, combine
from mathota_jax.geometry.shape import Shape, Solid
from mathota_jax.geometry.validation import finite_vector, unit_quaternion


class Part(NamedTuple):
    """A shape held in the body frame at a position (3,) [m] and orientation, quaternion (w, x, y, z)."""

    shape: Shape
    position: np.ndarray
    orientation: np.ndarray

    @property
    def rotation(self) -> np.ndarray:
        """Rotation matrix (3, 3), body frame from shape frame."""
        return Rotation.from_quat(self.orientation[[1, 2, 3, 0]]).as_matrix()


class Compound(Solid):
    """Convex shapes of one density, fixed to each other. Its centre of mass need not be the origin.

    Args:
        parts: Pairs ``(shape, pose)``; a pose is ``(position [m], quaternion (w, x, y, z))`` in the body frame. Volume
            that parts share counts once for each of them.

    Raises:
        ValueError: if there is no part, a shape is infinite or itself a compound, or a pose is not valid.
    """

    def __init__(self, parts: Sequence[tuple[Shape, tuple[Any, Any]]]) -> None:
        name = "Compound.parts"
        try:
            pairs = [(shape, (position, orientation)) for shape, (position, orientation) in parts]
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be pairs (shape, (position, quaternion)), got {parts!r}") from error
        if not pairs:
            raise ValueError(f"{name} must hold at least one pair (shape, (position, quaternion)), got none")
        made = []
        for index, (shape, (position, orientation)) in enumerate(pairs):
            label = f"{name}[{index}]"
            if not isinstance(shape, Shape) or shape.static_only:
                raise ValueError(
                    f"{label}: shape must be a convex shape with a volume, got {shape!r}; "
                    "flatten nested compounds, and give planes and heightfields a body each"
                )
            made.append(
                Part(
                    shape,
                    finite_vector(f"{label}: position", position),
                    unit_quaternion(f"{label}: quaternion", orientation),
                )
            )
        self.parts: tuple[Part, ...] = tuple(made)

    def __repr__(self) -> str:
        return f"Compound([{', '.join(repr(part.shape) for part in self.parts)}])"

    def mass_properties(self) -> MassProperties:
        """Volume, centre of mass and inertia in the body frame, NumPy float64."""
        return combine([(part.shape.mass_properties(), part.position, part.rotation) for part in self.parts])

    def bounding_radius(self) -> float:
        """Radius [m] of a sphere about the origin that contains all parts."""
        return max(float(np.linalg.norm(part.position)) + part.shape.bounding_radius() for part in self.parts)

    def inradius(self) -> float:
        """The smallest inradius [m] of the parts: tolerances that suit the thinnest suit them all."""
        return min(part.shape.inradius() for part in self.parts)
