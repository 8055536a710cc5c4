"""Bounds of a continuous action space."""

from dataclasses import dataclass
from typing import Any

import gymnasium
import jax.numpy as jnp
import numpy as np
from jax import Array


@dataclass(frozen=True)
class ActionBounds:
    """Lower and upper bounds of each action.

    Attributes:
        low: ``(action,)`` float32, finite.
        high: ``(action,)`` float32, finite.
    """

    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, space: Any) -> "ActionBounds":
        """The bounds of an action space.

        Raises:
            ValueError: Unless it is a bounded one-dimensional ``gymnasium.spaces.Box``.
        """
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1 or not space.is_bounded():
            raise ValueError(f"the action space must be a bounded one-dimensional Box, got {space}")
        return cls(space.low.astype(np.float32), space.high.astype(np.float32))

    @property
    def size(self) -> int:
        """Number of actions."""
        return self.low.shape[0]

    def from_unit(self, raw_action: Array) -> Array:
        """Clip to [-1, 1] and stretch to the bounds, ``(..., action) -> (..., action)``."""
        middle, half_range = (self.high + self.low) / 2, (self.high - self.low) / 2
        return jnp.clip(raw_action, -1.0, 1.0) * half_range + middle
