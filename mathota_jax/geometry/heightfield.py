"""Terrain as a grid of heights."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from mathota_jax.geometry.inertia import MassProperties
from mathota_jax.geometry.shape import Bounds, Shape, around
from mathota_jax.geometry.validation import finite_array, positive_number
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import Mat3, Vec3


class Heightfield(Shape):
    """Static surface over a grid in the local x-z plane, solid below; local Y is up.

    ``heights[i, j]`` is the height at ``x = (i - (rows - 1) / 2) cell_size``, ``z = (j - (columns - 1) / 2) cell_size``:
    the grid is centred at the body origin. The diagonal from ``(i, j)`` to ``(i + 1, j + 1)`` cuts each cell into two
    triangles.

    Below its border the solid ends in four vertical walls, however far down. A body whose lowest point is level with the
    border, to 2 % of its size, meets no wall but slides onto the field.

    Args:
        heights: Heights [m], shape ``(rows, columns)``, at least 2 x 2, finite.
        cell_size: Distance [m] of neighbouring grid points, positive.

    Raises:
        ValueError: if the grid is too small, a height is not finite or the cell size is not positive.
    """

    kind: ClassVar[str] = "heightfield"
    static_only: ClassVar[bool] = True

    def __init__(self, heights: Any, cell_size: Any) -> None:
        self.heights = finite_array("Heightfield.heights", heights)
        if self.heights.ndim != 2 or min(self.heights.shape) < 2:
            raise ValueError(
                f"Heightfield.heights must have shape (rows, columns), at least (2, 2), got {self.heights.shape}"
            )
        self.cell_size = float(positive_number("Heightfield.cell_size", cell_size))

    def __repr__(self) -> str:
        return f"Heightfield(heights=<{self.heights.shape[0]} x {self.heights.shape[1]}>, cell_size={self.cell_size})"

    def parameters(self) -> dict[str, np.ndarray]:
        """Float64 arrays, which become differentiable leaves of the model."""
        return {"heights": self.heights.copy(), "cell_size": np.array(self.cell_size)}

    @staticmethod
    def mass_of(parameters: dict[str, Any]) -> MassProperties:
        """Raises ValueError: there is no bottom."""
        raise ValueError("Heightfield has neither volume nor inertia; add it with static=True")

    @staticmethod
    def bounds_of(parameters: dict[str, Any], pose: Pose) -> Bounds:
        """Bounds of the box over the grid between the lowest and the highest point of the surface.

        Smallest where the pose turns by quarter turns only; elsewhere the surface may stay clear of the sides. Heights
        of shape (rows, columns, element, world).
        """
        assert pose.rotation is not None
        heights = parameters["heights"]
        low, high = heights.min((0, 1)), heights.max((0, 1))
        half_x, half_z = (0.5 * (count - 1) * parameters["cell_size"] for count in heights.shape[:2])
        middle, half_y = 0.5 * (high + low), 0.5 * (high - low)
        center = pose.position + pose.rotation.column_y * middle
        reach = Mat3(*(column.map(jnp.abs) for column in pose.rotation)).apply(Vec3(half_x, half_y, half_z))
        return around(center, reach)

    @staticmethod
    def reach_of(parameters: dict[str, Any]) -> Any:
        """To the farthest grid point."""
        heights = parameters["heights"]
        rows, columns = heights.shape[:2]
        along = (np.arange(rows) - 0.5 * (rows - 1)) ** 2
        across = (np.arange(columns) - 0.5 * (columns - 1)) ** 2
        flat = (along[:, None] + across).reshape(rows, columns, *[1] * (heights.ndim - 2)).astype(heights.dtype)
        return (heights**2 + flat * parameters["cell_size"] ** 2).max((0, 1)) ** 0.5

    def inradius(self) -> float:
        """Infinite: a heightfield never is the smaller body of a pair."""
        return float("inf")
