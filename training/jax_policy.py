"""The deterministic policy that backend ``jax`` learns, as plain arrays that can be saved and loaded."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from training.actions import ActionBounds
from training.networks import action_mean
from training.normalization import RunningMoments, normalize

ARRAYS_FILE = "policy.npz"


@dataclass(frozen=True)
class JaxPolicy:
    """Mean action of a Gaussian actor.

    Attributes:
        layers: Per layer ``{"weight": (in, out), "bias": (out,)}``.
        observation_mean: ``(observation,)``.
        observation_variance: ``(observation,)``.
        bounds: Of the action space.
    """

    layers: list[dict[str, np.ndarray]]
    observation_mean: np.ndarray
    observation_variance: np.ndarray
    bounds: ActionBounds

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions within the bounds, ``(world, observation) -> (world, action)``, float32."""
        return np.asarray(
            _mean_action(
                self.layers,
                self.observation_mean,
                self.observation_variance,
                self.bounds.low,
                self.bounds.high,
                observations,
            )
        )

    def save(self, directory: Path) -> None:
        """Write the arrays to ``directory``."""
        arrays: dict[str, Any] = {
            "observation_mean": self.observation_mean,
            "observation_variance": self.observation_variance,
            "action_low": self.bounds.low,
            "action_high": self.bounds.high,
        }
        for index, layer in enumerate(self.layers):
            arrays[f"layer_{index}_weight"] = layer["weight"]
            arrays[f"layer_{index}_bias"] = layer["bias"]
        np.savez(directory / ARRAYS_FILE, **arrays)

    @classmethod
    def load(cls, directory: Path) -> "JaxPolicy":
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: If the arrays are not there.
        """
        with np.load(directory / ARRAYS_FILE, allow_pickle=False) as arrays:
            layer_count = sum(name.endswith("_weight") for name in arrays.files)
            layers = [
                {"weight": arrays[f"layer_{index}_weight"], "bias": arrays[f"layer_{index}_bias"]}
                for index in range(layer_count)
            ]
            bounds = ActionBounds(arrays["action_low"], arrays["action_high"])
            return cls(layers, arrays["observation_mean"], arrays["observation_variance"], bounds)


@jax.jit
def _mean_action(
    layers: Any, observation_mean: Any, observation_variance: Any, low: Any, high: Any, observations: Any
) -> jax.Array:
    moments = RunningMoments(observation_mean, observation_variance, jnp.zeros(()))
    mean = action_mean({"actor": layers}, normalize(moments, observations))
    return ActionBounds(low, high).from_unit(mean)
