"""Parameters of the cube from tosses by gradient: free flights, first impacts, then whole motions."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from mathota_jax import Model, State
from mathota_jax.fit import FitResult, Noise, Parameter, Trajectories, fit
from training.cube_toss_data import UP, Tosses, as_rotation, fall, turned
from training.cube_toss_model import (
    SUBSTEPS,
    CubeParameters,
    Start,
    as_arrays,
    prediction_errors,
    scene,
    simulate,
    start_of,
)

WINDOW = 12
"""Frames from just before the first touch that the fit of first impacts sees."""

HORIZON = 148
"""Frames (1 s) that the last stage sees: later ones the cube mostly lies still."""

FIRST_HORIZONS = (30, 60)
"""Frames (0.2 s, 0.4 s) that the stages before it see: about the first impact, and the next ones."""

PUBLISHED = {"friction": 0.18, "restitution": 0.125, "inertia": np.full(3, 8.1e-4)}
"""Values published with the data, where the fit begins."""

CORNER_RADIUS = 4e-3
"""First guess [m]."""

FITTED = ("friction", "restitution", "inertia", "corner_radius")
"""What impacts tell; the other parameters come from free flights and from rest."""

UNCERTAINTY = np.array([0.05, 0.2, 0.05, 0.05, 0.05, 0.25])
"""How far, as shares, the numbers of `FITTED` may be off: the unit of steps."""

WEIGHTS = (1 / 11.0, 1 / 13.0)
"""Of position [%] and rotation [degree] errors: about as much of each."""


class Estimate(NamedTuple):
    """Parameters, and the friction that the first impacts alone show with its interval."""

    parameters: CubeParameters
    first_friction: float
    friction_interval: tuple[float, float]


def fit_tosses(tosses: Tosses, settings: Sequence[str], steps: int = 12) -> list[Estimate]:
    """Fits the cube, for each setting.

    Rest tells the size, free flights the centre of mass, the first impacts roughly the rest, and whole motions all that
    impacts tell, over longer and longer horizons: each stage begins where the one before ended.
    """
    first = first_guess(tosses)
    result = fit_first_impacts(tosses, first)
    friction, restitution, factor = (float(value) for value in result.values)
    begin = first._replace(friction=friction, restitution=restitution, inertia=first.inertia * factor)
    interval = (float(result.lower[0]), float(result.upper[0]))
    return [
        Estimate(fit_whole_motions(tosses, start_of(tosses, setting, begin), begin, steps), friction, interval)
        for setting in settings
    ]


def fit_whole_motions(tosses: Tosses, start: Start, begin: CubeParameters, steps: int) -> CubeParameters:
    """The parameters of least mean errors, from given ones, as `refine` finds them.

    Whole motions alone lead to one of many minima: after several impacts a small change is felt as another face. A first
    stage over fewer frames leads near the right one; of several such stages the one is taken that ends with the least
    errors, of these tosses.
    """
    found = []
    for horizon in FIRST_HORIZONS:
        near = refine(tosses, start, begin, horizon, steps)
        found.append(refine(tosses, start, near, HORIZON, steps))
    return min(found, key=lambda parameters: mean_errors(tosses, start, parameters, HORIZON))


def first_guess(tosses: Tosses) -> CubeParameters:
    """What rest and free flight tell, and published values."""
    return CubeParameters(
        **PUBLISHED,
        corner_radius=CORNER_RADIUS,
        half_width=tosses.resting_half_width(),
        centre_of_mass=tosses.centre_of_mass(),
        gravity=tosses.gravity(),
    )


def fit_first_impacts(tosses: Tosses, first: CubeParameters) -> FitResult:
    """Friction, restitution and factor of the inertia from a window about the first impact of each toss."""
    data = first_impacts(tosses, first)
    model, state = scene(tosses.dt, tosses.mass, first)
    parameters = [
        Parameter(("friction[cube]", "friction[table]"), 0.02, 1.0),
        Parameter(("restitution[cube]", "restitution[table]"), 0.01, 0.9),
        Parameter("inertia_scale[cube]", 0.5, 3.0),
    ]
    noise = Noise(position=2e-3, orientation=np.radians(1.0))
    return fit(model, state, parameters, data, start="recorded", noise=noise, substeps=SUBSTEPS, huber=2.0)


def first_impacts(tosses: Tosses, known: CubeParameters) -> Trajectories:
    """Windows, of the centre of mass, that begin one frame before the first touch, on the path of the fitted flight."""
    start = Start(*tosses.flight_start(known.centre_of_mass, known.gravity))
    begin = tosses.flight_length() - 1
    time = begin * tosses.dt
    inside = np.minimum(begin[:, None] + np.arange(WINDOW + 1), tosses.position.shape[1] - 1)
    rows = np.arange(tosses.count)[:, None]
    orientation = tosses.orientation[rows, inside]
    position = tosses.position[rows, inside] + turned(orientation, known.centre_of_mass)
    turn = Rotation.from_rotvec(start.angular_velocity * time[:, None])
    orientation[:, 0] = (turn * as_rotation(start.orientation)).as_quat()[:, [3, 0, 1, 2]]
    position[:, 0] = start.position + start.velocity * time[:, None] - fall(known.gravity, time)
    speed, spin = np.full_like(position, np.nan), np.full_like(position, np.nan)
    speed[:, 0] = start.velocity - np.multiply.outer(known.gravity * time, UP)
    spin[:, 0] = start.angular_velocity
    names = ("position", "orientation", "velocity", "angular_velocity")
    channels = {
        name: value[:, :, None] for name, value in zip(names, (position, orientation, speed, spin), strict=True)
    }
    return Trajectories(("cube",), tosses.dt, **channels)


def mean_errors(tosses: Tosses, start: Start, parameters: CubeParameters, horizon: int) -> float:
    """Weighted sum of the mean errors of position and rotation over some frames; infinite where they are not finite."""
    found = prediction_errors(tosses, start, parameters, min(horizon, tosses.position.shape[1] - 1))
    total = sum(weight * error.mean() for weight, error in zip(WEIGHTS, found, strict=True))
    return float(total) if np.isfinite(total) else np.inf


def refine(tosses: Tosses, start: Start, begin: CubeParameters, horizon: int, steps: int) -> CubeParameters:
    """The parameters of least mean errors, near given ones.

    Levenberg-Marquardt in the logarithms of `FITTED`, with two kinds of weights. One over the error makes the sum of
    squares that of the distances (iteratively reweighted least squares), which a few lost tosses do not rule. And near an
    edge or corner balance a small change turns up another face: there the derivative is large and foretells nothing, so
    that a frame counts the less the further the uncertainty of the parameters moves it.
    """
    model, state = scene(tosses.dt / SUBSTEPS, tosses.mass, begin)
    horizon = min(horizon, tosses.position.shape[1] - 1)
    seen = tosses.seen(horizon)
    frames = (
        np.where(seen[..., None], tosses.position[:, 1 : horizon + 1], 0.0),
        np.where(seen[..., None], tosses.orientation[:, 1 : horizon + 1], [1.0, 0.0, 0.0, 0.0]),
    )
    recorded = tuple(jnp.asarray(frame, model.dt.dtype) for frame in frames)
    share = seen / seen.sum(1, keepdims=True) / tosses.count
    start = as_arrays(model, start)

    best, damping = mean_errors(tosses, start, begin, horizon), 1e-2
    for _ in range(steps):
        errors, slopes = _linearise(model, state, as_arrays(model, begin), start, recorded, 2 * tosses.half_width)
        matrix, gradient = _normal_equations(np.asarray(errors, float), np.asarray(slopes, float), share)
        previous = best
        while damping < 1e3:
            change = -np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), gradient)
            other = _moved(begin, np.clip(change, -1.0, 1.0) * UNCERTAINTY)
            found = mean_errors(tosses, start, other, horizon)
            if found < best:
                begin, best, damping = other, found, damping / 4
                break
            damping *= 6
        if best > (1 - 1e-4) * previous:
            break
    return begin


@functools.partial(jax.jit, static_argnames="width")
def _linearise(model: Model, state: State, known: CubeParameters, start: Start, recorded: Any, width: float) -> Any:
    """Errors (toss, frame, 6) of position [%] and rotation [degree], and their derivatives by steps, (6, toss, ...)."""

    def errors(change: Any) -> Any:
        moved = _moved(known, change * UNCERTAINTY)
        position, orientation = simulate(model, state, moved, start, recorded[0].shape[1])
        turn = _turn(recorded[1], orientation)
        return jnp.concatenate([(position - recorded[0]) * (100 / width), jnp.degrees(turn)], axis=-1)

    found, along = jax.linearize(errors, jnp.zeros(len(UNCERTAINTY), model.dt.dtype))
    return found, jax.lax.map(along, jnp.eye(len(UNCERTAINTY), dtype=model.dt.dtype))


def _normal_equations(error: np.ndarray, slopes: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    matrix = gradient = 0.0
    for part, weight in ((slice(0, 3), WEIGHTS[0]), (slice(3, 6), WEIGHTS[1])):
        own, slope = error[..., part], slopes[..., part]
        reach = (slope**2).sum((0, -1))
        usable = np.isfinite(reach) & (share > 0)
        slope = np.where(usable[..., None], slope, 0.0)
        factor = np.where(usable, weight * share / np.sqrt((own**2).sum(-1) + 1.0 + np.where(usable, reach, 0.0)), 0.0)
        matrix = matrix + np.einsum("tf,ptfi,qtfi->pq", factor, slope, slope)
        gradient = gradient + np.einsum("tf,ptfi,tfi->p", factor, slope, own)
    return matrix, gradient


def _moved(known: CubeParameters, logarithms: Any) -> CubeParameters:
    """Parameters of which those `FITTED` are changed by factors."""
    factors = jnp.exp(logarithms)
    by_name = dict(zip(FITTED, (factors[0], factors[1], factors[2:5], factors[5]), strict=True))
    return known._replace(**{name: jnp.asarray(getattr(known, name)) * factor for name, factor in by_name.items()})


def _turn(first: Any, second: Any) -> Any:
    """Rotation vector (..., 3) from one orientation to another."""
    w = jnp.sum(first * second, -1, keepdims=True)
    vector = (
        first[..., :1] * second[..., 1:] - second[..., :1] * first[..., 1:] + jnp.cross(second[..., 1:], first[..., 1:])
    )
    vector = jnp.where(w < 0, -vector, vector)
    length = jnp.sqrt(jnp.sum(vector**2, -1, keepdims=True) + 1e-12)
    return 2 * jnp.arctan2(length, jnp.abs(w)) * vector / length
