"""Levenberg-Marquardt from many starts at once: the device linearises all of them in one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mathota_jax.fit.normal_equations import Weights, cost, foreseen_decrease, normal_equations, solve, stack_starts
from mathota_jax.fit.objective import Objective

FIRST_DAMPING = 1e-3
LEAST_DAMPING = 1e-7
LARGEST_DAMPING = 1e8
TOLERANCE = 1e-6
"""Relative decrease of the cost below which a start has converged."""

ROUND_OFF = 1e-5
"""Relative decrease foreseen below which a refused step is put down to round-off of the cost (float32)."""

PROMISE = 0.01
"""Relative decrease foreseen above which a start whose every step is refused, be it ever so short, has not converged."""

Progress = Callable[[int, int, float], Any]
"""Called after each step with the steps done, their limit and the lowest cost."""


class Stage(NamedTuple):
    """One cost of a sequence of ever harder ones, and the most steps to spend on it."""

    weights: Weights
    step_limit: int


class Solution(NamedTuple):
    """What an optimiser found from each start.

    Attributes:
        unbounded: (b, entry).
        charts: (b, n, s, chart).
        cost: (b,) of the last stage; infinite where a start failed.
        converged: (b,).
        steps: number of steps of all stages together.
    """

    unbounded: np.ndarray
    charts: np.ndarray
    cost: np.ndarray
    converged: np.ndarray
    steps: int


def levenberg_marquardt(
    objective: Objective,
    unbounded: np.ndarray,
    free: np.ndarray,
    stages: Sequence[Stage],
    progress: Progress | None = None,
) -> Solution:
    """Minimises the costs of the stages one after the other.

    Args:
        objective: residuals and Jacobians.
        unbounded: (b, entry) starts.
        free: (s * chart,) which numbers of the beginnings are free.
        stages: each begins where the one before ended.
        progress: see `Progress`.
    """
    count = len(unbounded)
    unbounded, charts = unbounded.copy(), objective.zero_charts(count)
    found = objective.linearise(unbounded, charts)
    parts = [stack_starts(found, b) for b in range(count)]
    limit = sum(stage.step_limit for stage in stages)
    steps, costs, converged = 0, np.zeros(count), np.zeros(count, bool)
    for stage in stages:
        weights = stage.weights
        costs = np.asarray([cost(part.residual, part.gap, weights) for part in parts])
        damping, growth, promised = np.full(count, FIRST_DAMPING), np.full(count, 2.0), np.zeros(count)
        converged = ~np.isfinite(costs)
        stuck = np.zeros(count, bool)
        for _ in range(stage.step_limit):
            if (converged | stuck).all():
                break
            trial, trial_charts = unbounded.copy(), charts.copy()
            foreseen = np.zeros(count)
            for b in np.flatnonzero(~converged & ~stuck):
                equations = normal_equations(parts[b], weights, free)
                change, chart_change = solve(equations, damping[b])
                foreseen[b] = foreseen_decrease(equations, change, chart_change)
                trial[b] += change
                trial_charts[b].reshape(len(chart_change), -1)[:, free] += chart_change
            found = objective.linearise(trial, trial_charts)
            for b in map(int, np.flatnonzero(~converged & ~stuck)):
                part = stack_starts(found, b)
                new = cost(part.residual, part.gap, weights)
                if all(np.isfinite(leaf).all() for leaf in part) and new <= costs[b]:
                    converged[b] = costs[b] - new <= TOLERANCE * costs[b]
                    unbounded[b], charts[b], parts[b], costs[b] = trial[b], trial_charts[b], part, new
                    damping[b], growth[b], promised[b] = max(damping[b] / 5.0, LEAST_DAMPING), 2.0, 0.0
                else:
                    # Ever faster, as H. Nielsen (1999) has it: the way from Gauss-Newton to small steps is short.
                    damping[b] *= growth[b]
                    growth[b] *= 2.0
                    promised[b] = max(promised[b], foreseen[b])
                    ended = damping[b] > LARGEST_DAMPING or foreseen[b] <= ROUND_OFF * costs[b]
                    stuck[b] = ended and promised[b] > PROMISE * costs[b]
                    converged[b] = ended and not stuck[b]
            steps += 1
            if progress is not None:
                progress(steps, limit, float(costs.min()))
    return Solution(unbounded, charts, costs, converged & np.isfinite(costs), steps)
