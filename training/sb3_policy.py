"""The deterministic policy that stable-baselines3 learns, with the statistics that normalize its observations."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from stable_baselines3 import PPO

WEIGHTS_FILE = "policy.zip"
STATISTICS_FILE = "normalization.npz"


@dataclass(frozen=True)
class SB3Policy:
    """Mean action of an SB3 model.

    Attributes:
        model: The trained model.
        observation_mean: ``(observation,)``; zeros if observations are not normalized.
        observation_variance: ``(observation,)``; ones if observations are not normalized.
    """

    model: PPO
    observation_mean: np.ndarray
    observation_variance: np.ndarray

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions within the bounds, ``(world, observation) -> (world, action)``."""
        scaled = (observations - self.observation_mean) / np.sqrt(self.observation_variance + 1e-8)
        actions, _ = self.model.predict(np.clip(scaled, -10.0, 10.0).astype(np.float32), deterministic=True)
        return actions

    def save(self, directory: Path) -> None:
        """Write SB3's own zip file and the statistics."""
        self.model.save(directory / WEIGHTS_FILE)
        np.savez(directory / STATISTICS_FILE, mean=self.observation_mean, variance=self.observation_variance)

    @classmethod
    def load(cls, directory: Path) -> "SB3Policy":
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: If the files are not there.
        """
        with np.load(directory / STATISTICS_FILE, allow_pickle=False) as statistics:
            mean, variance = statistics["mean"], statistics["variance"]
        return cls(PPO.load(directory / WEIGHTS_FILE, device="cpu"), mean, variance)
