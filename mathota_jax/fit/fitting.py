"""`fit`: parameters of a scene from recorded motions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from numbers import Integral, Real
from typing import Any

import jax
import numpy as np

from mathota_jax.fit.initial_states import Motion
from mathota_jax.fit.least_squares import Progress, Solution, Stage, levenberg_marquardt
from mathota_jax.fit.normal_equations import Weights, stack_starts
from mathota_jax.fit.objective import Noise, Objective, Spread
from mathota_jax.fit.optimise import optimise, require_optax
from mathota_jax.fit.parameters import Parameter, parameter_vector
from mathota_jax.fit.result import FitResult, StartResult
from mathota_jax.fit.trajectories import Trajectories
from mathota_jax.fit.uncertainty import uncertainty
from mathota_jax.model import Model
from mathota_jax.state import State

STARTS = ("recorded", "free", "model")
FAR = 4.0
"""Spreads that a beginning may lie off the scene without a warning."""
CONTINUITY = (1.0, 10.0, 100.0)
"""Weights of the jumps between segments, one stage each: loose first, in the end a hundredth of the noise."""


def fit(
    model: Model,
    state: State,
    parameters: Sequence[Parameter | str],
    data: Trajectories,
    *,
    start: str = "free",
    noise: Noise | None = None,
    spread: Spread | None = None,
    substeps: int = 1,
    segments: int = 1,
    horizons: Sequence[float] = (1.0,),
    huber: float | None = None,
    start_count: int = 1,
    seed: int = 0,
    optimiser: Any = None,
    step_limit: int = 100,
    confidence: float = 0.95,
    progress: Progress | None = None,
) -> FitResult:
    """Fits parameters of a scene to recorded motions by least squares of positions and orientations.

    Args:
        model: the scene as built, with the values from which the fit starts.
        state: its initial state.
        parameters: what to fit; a name alone stands for ``Parameter(name)``.
        data: recorded motions; missing frames are NaN.
        start: where the simulation of each trajectory begins. "free": position, orientation and velocities of all moving
            bodies are unknowns of each trajectory. "recorded": in its first frame, velocities included, which must be
            complete; its noise then goes into the estimates. "model": in `state`, the same for all trajectories; then
            `position[body]`, `velocity[body]` and `angular_velocity[body]` may be parameters.
        noise: standard deviations of the channels.
        spread: standard deviations of what was not recorded at the beginning of a trajectory (orientations where there are
            positions alone, bodies that were not recorded) about `state`, with start="free".
        substeps: steps of the engine between two frames.
        segments: of multiple shooting (H. Bock and K. Plitt, 1984). Trajectories are cut into as many pieces, whose
            beginnings are unknowns, tied together ever tighter: long or chaotic motions then converge from far starts.
        horizons: increasing shares of the frames to fit, one after the other, the last one 1: short motions first.
        huber: residuals beyond this many standard deviations count linearly instead of squared; None for none. Intervals
            allow for it, see `residual_scale`.
        start_count: number of starts; those after the first are random (see `ParameterVector.random_starts`). They run
            side by side under `jax.vmap`, and the best is the result.
        seed: of the random starts.
        optimiser: an optax `GradientTransformation` for first-order steps by reverse mode; None for Levenberg-Marquardt
            by forward mode, which needs far fewer steps for few parameters.
        step_limit: most steps of all stages together.
        confidence: of the intervals.
        progress: called after each step with the steps done, their limit and the lowest cost.

    Returns:
        Estimates with intervals and warnings; deterministic for given arguments.

    Raises:
        ValueError: parameters, bounds or data that do not fit the scene, or settings out of range, before anything is
            compiled; or no start from which the simulation stays finite.
        ImportError: `optimiser` is given and optax is not installed.
    """
    if not isinstance(data, Trajectories):
        raise ValueError(f"fit: data must be Trajectories, got {_kind(data)}")
    if not isinstance(model, Model) or not isinstance(state, State):
        raise ValueError(f"fit: give model, state as `build` returns them, got {_kind(model)}, {_kind(state)}")
    noise = Noise() if noise is None else noise
    spread = Spread() if spread is None else spread
    for name, value, kind in (("noise", noise, Noise), ("spread", spread, Spread)):
        if not isinstance(value, kind):
            raise ValueError(f"fit: {name} must be a {kind.__name__}, such as {kind()}, got {value!r}")
    vector = parameter_vector(model, state, parameters)
    data.check_scene(model)
    _check_settings(
        data, vector.initial, start, substeps, segments, horizons, huber, start_count, seed, step_limit, confidence
    )
    if optimiser is not None:
        require_optax()
        if not hasattr(optimiser, "update"):
            raise ValueError(f"fit: optimiser must be one of optax, such as optax.adam(0.02), got {optimiser!r}")
    objective = Objective(model, state, vector, data, noise, segments, substeps, start, spread)
    if not objective.used:
        raise ValueError("fit: no recorded channel has a noise; nothing is compared")
    begin = vector.random_starts(start_count, seed)
    return solve(objective, begin, horizons, huber, optimiser, step_limit, confidence, progress)


def _kind(value: Any) -> str:
    return type(value).__name__


def solve(
    objective: Objective,
    begin: np.ndarray,
    horizons: Sequence[float] = (1.0,),
    huber: float | None = None,
    optimiser: Any = None,
    step_limit: int = 100,
    confidence: float = 0.95,
    progress: Progress | None = None,
) -> FitResult:
    """The optimisation of `fit` from the starts `begin` (b, entry), unbounded; compiled once for an objective."""
    free = np.ones((objective.segment_count, objective.chart_size), bool)
    free[0] = objective.start == "free"
    free = free.ravel()
    stages = _stages(objective, horizons, huber, step_limit)
    if optimiser is None:
        solution = levenberg_marquardt(objective, begin, free, stages, progress)
    else:
        solution = optimise(objective, begin, free, stages, optimiser, progress)
    if not np.isfinite(solution.cost).any():
        raise ValueError("fit: the simulation is not finite from any start; check the data, the starts and substeps")
    return _result(objective, solution, stages[-1].weights, free, confidence)


def _check_settings(
    data: Trajectories,
    initial: bool,
    start: str,
    substeps: int,
    segments: int,
    horizons: Sequence[float],
    huber: float | None,
    start_count: int,
    seed: int,
    step_limit: int,
    confidence: float,
) -> None:
    if start not in STARTS:
        raise ValueError(f"fit: start must be one of {', '.join(map(repr, STARTS))}, got {start!r}")
    if initial and (start != "model" or segments != 1):
        raise ValueError('fit: parameters of the initial state need start="model" and segments=1')
    for name, value, least in (
        ("substeps", substeps, 1),
        ("segments", segments, 1),
        ("start_count", start_count, 1),
        ("seed", seed, 0),
        ("step_limit", step_limit, 1),
    ):
        if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
            raise ValueError(f"fit: {name} must be a whole number of at least {least}, got {value!r}")
    if segments > data.frame_count - 1:
        raise ValueError(
            f"fit: segments must be at most the {data.frame_count - 1} frames after the first, got {segments}"
        )
    shares = list(horizons) if isinstance(horizons, Iterable) else []
    if not all(isinstance(share, Real) for share in shares):
        raise ValueError(f"fit: horizons must be numbers, got {horizons!r}")
    if not shares or shares[-1] != 1 or shares[0] <= 0 or any(b <= a for a, b in itertools.pairwise(shares)):
        raise ValueError(
            f"fit: horizons must be positive and increasing and end with 1, such as (0.3, 1.0), got {horizons!r}"
        )
    if segments > 1 and len(shares) > 1:
        raise ValueError("fit: give either several segments or several horizons, not both")
    if huber is not None and not (isinstance(huber, Real) and huber > 0 and math.isfinite(huber)):
        raise ValueError(f"fit: huber must be a positive number of standard deviations, got {huber!r}")
    if not (isinstance(confidence, Real) and 0 < confidence < 1):
        raise ValueError(f"fit: confidence must lie between 0 and 1, got {confidence!r}")


def _stages(objective: Objective, horizons: Sequence[float], huber: float | None, step_limit: int) -> list[Stage]:
    mask = objective.mask.astype(float)
    last = objective.data.frame_count - 1
    ties = CONTINUITY if objective.segment_count > 1 else (1.0,)
    cases = [(horizon, tie) for horizon in horizons for tie in ties]
    share = max(step_limit // len(cases), 1)
    stages = []
    for number, (horizon, tie) in enumerate(cases):
        within = objective.frame_of_residual <= math.ceil(horizon * last)
        weights = Weights(mask * within[None], tie * _gap_weights(objective), huber)
        limit = share if number < len(cases) - 1 else max(step_limit - share * (len(cases) - 1), 1)
        stages.append(Stage(weights, limit))
    return stages


def _gap_weights(objective: Objective) -> np.ndarray:
    """(chart,) a jump of one noise in a pose weighs 1; one in a velocity as much as what it does over a segment."""
    noise = objective.noise
    duration = objective.data.dt * (objective.segments.frames.shape[1] - 1)
    one = [1 / noise.position, 1 / noise.orientation, duration / noise.position, duration / noise.orientation]
    return np.tile(np.repeat(one, 3), len(objective.moving))


def _result(
    objective: Objective, solution: Solution, weights: Weights, free: np.ndarray, confidence: float
) -> FitResult:
    vector, data = objective.vector, objective.data
    best = int(np.argmin(solution.cost))
    ends, charts = vector.off_bounds(solution.unbounded), solution.charts[best]
    unbounded = ends[best]
    # All starts once more: the program for their number is compiled already.
    found = stack_starts(objective.linearise(ends, solution.charts), best)
    # Each segment after the first has as many ties as unknowns.
    start_unknowns = data.count * objective.chart_size if objective.start == "free" else 0
    found_out = uncertainty(vector, unbounded, found, weights, free, objective.pulls, start_unknowns, confidence)
    warnings = list(found_out.warnings)
    if not solution.converged[best]:
        warnings.append(
            f"Not converged after {solution.steps} steps: raise the limit, or start closer where no step lowers the cost."
        )
    warnings += [
        f"The {what} of '{body}', which was not recorded, begins up to {away:.2g} spreads off the scene: "
        "give a wider one (`spread`) if the scene's may be that wrong."
        for (body, what), away in objective.pulled(charts).items()
        if away > FAR
    ]
    near = solution.cost <= solution.cost[best] * 1.01 + 1e-12
    if len(near) > 1 and near.sum() == 1:
        warnings.append(f"Only one of {len(near)} starts reached the lowest cost; a lower one may exist.")
    values = np.asarray(vector.values(unbounded), float)
    model, state = vector.apply(objective.model, objective.state, np.asarray(unbounded, objective.state.position.dtype))
    return FitResult(
        labels=vector.labels,
        units=tuple(place.targets[0][0].unit for place in vector.places for _ in range(place.end - place.begin)),
        values=values,
        lower=found_out.lower,
        upper=found_out.upper,
        confidence=confidence,
        correlation=found_out.correlation,
        covariance=found_out.covariance,
        noise_factor=found_out.noise_factor,
        warnings=tuple(warnings),
        cost=float(solution.cost[best]),
        steps=solution.steps,
        converged=bool(solution.converged[best]),
        starts=tuple(
            StartResult(np.asarray(vector.values(u), float), float(c), bool(d))
            for u, c, d in zip(solution.unbounded, solution.cost, solution.converged, strict=True)
        ),
        model=model,
        state=state,
        initial=_initial(objective, unbounded, charts),
        residuals=objective.by_channel(np.asarray(found.residual, float)),
        data=data,
    )


def _initial(objective: Objective, unbounded: np.ndarray, charts: np.ndarray) -> Motion:
    """Motions at the beginning of each trajectory, leaves (trajectory, body, ...)."""
    begin = jax.tree.map(lambda leaf: leaf[:, 0], objective.start_arrays)
    dtype = objective.state.position.dtype
    return jax.tree.map(
        np.asarray,
        jax.vmap(objective.beginning, (None, 0, 0))(
            np.asarray(unbounded, dtype), np.asarray(charts[:, 0], dtype), begin
        ),
    )
