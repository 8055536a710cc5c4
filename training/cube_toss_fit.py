"""Parameters of the cube from tosses: gradients over the first impacts, then a search over whole tosses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mathota_jax.fit import FitResult, Noise, Parameter, Trajectories, fit
from training.cube_toss_data import GRAVITY, Tosses
from training.cube_toss_model import SUBSTEPS, CubeParameters, prediction_errors, scene, start_of

WINDOW = 12
"""Frames from just before the first touch that gradients see: later ones depend on the start chaotically."""

FIRST = CubeParameters(friction=0.18, restitution=0.125, inertia=8.1e-4, corner_radius=5e-3, half_width=0.0)
"""Where the fit begins; friction, restitution and inertia are those published with the data."""

SPREAD = (0.01, 0.06, 1e-4, 2e-3)
"""Standard deviations of the first round of the search: friction, restitution, inertia, corner radius."""

ROUND_SIZE = 30
ELITE = 6
WEIGHTS = (1 / 11.0, 1 / 13.0)
"""Of position and rotation errors in the objective of the search: about as much of each."""


class Estimate(NamedTuple):
    """Parameters, and the friction that the first impacts alone show with its interval."""

    parameters: CubeParameters
    first_friction: float
    friction_interval: tuple[float, float]


def fit_tosses(tosses: Tosses, settings: Sequence[str], rounds: int, seed: int = 0) -> list[Estimate]:
    """Fits friction, restitution, inertia and corner radius, for each setting.

    Gradients of whole tosses explode: near an edge or corner balance a small change turns up another face. So least
    squares with a robust loss sees a short window about the first impact of each toss, and the cross-entropy method
    (R. Rubinstein, 1999), which needs no gradient, refines what it found by the errors over whole tosses.
    """
    first = FIRST._replace(half_width=tosses.resting_half_width())
    result = fit_first_impacts(tosses, first)
    friction, restitution, factor = (float(value) for value in result.values)
    begin = first._replace(friction=friction, restitution=restitution, inertia=first.inertia * factor)
    interval = (float(result.lower[0]), float(result.upper[0]))
    return [
        Estimate(_refined(tosses, start_of(tosses, setting), begin, rounds, seed), friction, interval)
        for setting in settings
    ]


def _refined(
    tosses: Tosses, start: tuple[np.ndarray, ...], begin: CubeParameters, rounds: int, seed: int
) -> CubeParameters:
    """The parameters of least errors over whole tosses, near given ones."""

    def objective(row: np.ndarray) -> float:
        position, rotation = prediction_errors(tosses, start, begin._replace(**_named(row)))
        return WEIGHTS[0] * position.mean() + WEIGHTS[1] * rotation.mean()

    best = cross_entropy(objective, np.asarray(begin[:4]), np.asarray(SPREAD), rounds, seed)
    return begin._replace(**_named(best))


def fit_first_impacts(tosses: Tosses, first: CubeParameters) -> FitResult:
    """Friction, restitution and factor of the inertia from a window about the first impact of each toss."""
    data = first_impacts(tosses)
    model, state = scene(tosses.dt, tosses.mass, first)
    parameters = [
        Parameter(("friction[cube]", "friction[table]"), 0.02, 1.0),
        Parameter(("restitution[cube]", "restitution[table]"), 0.01, 0.9),
        Parameter("inertia_scale[cube]", 0.5, 3.0),
    ]
    noise = Noise(position=2e-3, orientation=np.radians(1.0))
    return fit(model, state, parameters, data, start="recorded", noise=noise, substeps=SUBSTEPS, huber=2.0)


def first_impacts(tosses: Tosses) -> Trajectories:
    """Windows that begin one frame before the first touch, on the path of the fitted flight."""
    position, orientation, velocity, rate = tosses.flight_start()
    begin = tosses.flight_length() - 1
    time = begin * tosses.dt
    frames = begin[:, None] + np.arange(WINDOW + 1)
    inside = np.minimum(frames, tosses.position.shape[1] - 1)
    rows = np.arange(tosses.count)[:, None]
    windows = {name: getattr(tosses, name)[rows, inside][:, :, None] for name in ("position", "orientation")}
    channels = {name: np.where(np.isfinite(value), value, np.nan) for name, value in windows.items()}
    fall = np.outer(GRAVITY * time**2 / 2, [0.0, 0.0, 1.0])
    channels["position"][:, 0, 0] = position + velocity * time[:, None] - fall
    turned = Rotation.from_rotvec(rate * time[:, None]) * Rotation.from_quat(orientation[:, [1, 2, 3, 0]])
    channels["orientation"][:, 0, 0] = turned.as_quat()[:, [3, 0, 1, 2]]
    speed = np.full_like(channels["position"], np.nan)
    speed[:, 0, 0] = velocity - np.outer(GRAVITY * time, [0.0, 0.0, 1.0])
    spin = np.full_like(speed, np.nan)
    spin[:, 0, 0] = rate
    return Trajectories(("cube",), tosses.dt, **channels, velocity=speed, angular_velocity=spin)


def cross_entropy(
    objective: Callable[[np.ndarray], float],
    center: np.ndarray,
    spread: np.ndarray,
    rounds: int,
    seed: int,
    size: int = ROUND_SIZE,
) -> np.ndarray:
    """Minimum of a function of positive numbers: normal samples, refitted to the best of them in each round."""
    random = np.random.default_rng(seed)
    for _ in range(rounds):
        samples = np.vstack([center, center + spread * random.normal(size=(size - 1, len(center)))])
        samples = np.clip(samples, 1e-3 * center, None)
        values = np.asarray([objective(sample) for sample in samples])
        best = samples[np.argsort(values)[:ELITE]]
        center, spread = best.mean(0), best.std(0)
    return center


def _named(row: np.ndarray) -> dict[str, float]:
    return dict(zip(CubeParameters._fields, (float(value) for value in row), strict=False))
