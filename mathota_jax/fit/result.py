"""What a fit found."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from mathota_jax.fit.initial_states import Motion
from mathota_jax.fit.trajectories import Trajectories
from mathota_jax.model import Model
from mathota_jax.state import State


class StartResult(NamedTuple):
    """Where one start ended: values (entry,), cost, and whether it converged."""

    values: np.ndarray
    cost: float
    converged: bool


@dataclasses.dataclass(frozen=True)
class FitResult:
    """Estimates of a fit.

    Attributes:
        labels: names of the values; those of a parameter with several end in [0], [1], ...
        units: of the values.
        values: (entry,) estimates.
        lower, upper: (entry,) ends of the confidence intervals; those of a value that the data do not determine reach to
            its bounds or to infinity, and those of one at a bound end there.
        confidence: of the intervals.
        correlation: (entry, entry) of the estimates.
        covariance: (entry, entry) of the estimates; infinite where they are not determined.
        noise_factor: root mean square of the residuals in units of the noise given; with `huber` an estimate of the same
            that far residuals hardly move.
        warnings: what the user should know before believing the values.
        cost: half the sum of squared residuals, or of Huber's function of them.
        steps: of the optimiser.
        converged: whether the cost had stopped falling.
        starts: of all starts, the given one first.
        model, state: the scene with the estimates in place, `dt` being that of the fit.
        initial: beginning of each trajectory: position, orientation, velocity and angular velocity of all bodies, leaves
            (trajectory, body, ...).
        residuals: channel -> (trajectory, frame, body, 3) simulated minus recorded, in units of the noise; rotation
            vectors for the orientation; NaN where nothing was recorded.
        data: what was fitted.
    """

    labels: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    confidence: float
    correlation: np.ndarray
    covariance: np.ndarray
    noise_factor: float
    warnings: tuple[str, ...]
    cost: float
    steps: int
    converged: bool
    starts: tuple[StartResult, ...]
    model: Model
    state: State
    initial: Motion
    residuals: dict[str, np.ndarray]
    data: Trajectories

    def __getitem__(self, label: str) -> float:
        """Estimate of one value by its label."""
        return float(self.values[self._index(label)])

    def interval(self, label: str) -> tuple[float, float]:
        """Confidence interval of one value by its label."""
        index = self._index(label)
        return float(self.lower[index]), float(self.upper[index])

    def _index(self, label: str) -> int:
        if label not in self.labels:
            raise KeyError(f"no value is called {label!r}; known: {', '.join(self.labels)}")
        return self.labels.index(label)

    def __str__(self) -> str:
        lines = [
            f"{label}: {value:.6g} {unit}".rstrip() + f"  ({self.confidence:.0%}: {low:.6g} to {high:.6g})"
            for label, value, unit, low, high in zip(
                self.labels, self.values, self.units, self.lower, self.upper, strict=True
            )
        ]
        state = "converged" if self.converged else "NOT converged"
        lines.append(f"{state} in {self.steps} steps; residuals {self.noise_factor:.3g} times the noise given")
        return "\n".join([*lines, *(f"warning: {warning}" for warning in self.warnings)])
