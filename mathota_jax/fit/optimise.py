"""First-order optimisers of optax from many starts at once. Needs the extra `train`."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax.fit.least_squares import Progress, Solution, Stage
from mathota_jax.fit.normal_equations import foreseen_decrease, normal_equations, solve, stack_starts
from mathota_jax.fit.objective import Objective

AWAY = 0.1
"""Largest distance from a minimum, in standard deviations of the estimate, that counts as having reached it."""


def require_optax() -> Any:
    """The package optax.

    Raises:
        ImportError: it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module("optax")
    except ImportError as error:
        raise ImportError(
            f"first-order fits need the package 'optax' ({error}); install it with: pip install 'mathota-jax[train]'"
        ) from error


def optimise(
    objective: Objective,
    unbounded: np.ndarray,
    free: np.ndarray,
    stages: Sequence[Stage],
    optimiser: Any,
    progress: Progress | None = None,
) -> Solution:
    """Minimises the costs of the stages by gradients (reverse mode) and an optax optimiser.

    The cost is divided by the number of residuals, so that step sizes and clipping do not depend on the amount of data.

    Args:
        objective: residuals.
        unbounded: (b, entry) starts.
        free: (s * chart,) which numbers of the beginnings are free.
        stages: each begins where the one before ended.
        optimiser: `optax.GradientTransformation`.
        progress: see `least_squares.Progress`.
    """
    optax = require_optax()
    count = len(unbounded)
    dtype = objective.state.position.dtype
    variables = (jnp.asarray(unbounded, dtype), jnp.asarray(objective.zero_charts(count), dtype))
    mask = jnp.asarray(free, dtype).reshape(objective.segment_count, objective.chart_size)

    def costs(variables: Any, weights: Any, huber: Any, gap_weights: Any) -> tuple[Any, Any]:
        residual, gap = objective.residuals(*variables)
        scaled = weights * residual
        size = jnp.abs(scaled)
        near = jnp.minimum(size, huber)
        data = jnp.sum(0.5 * near**2 + jnp.where(size > huber, huber, 0.0) * (size - near), (1, 2, 3))
        each = (data + 0.5 * jnp.sum((gap_weights * gap) ** 2, (1, 2, 3))) / jnp.sum(weights > 0)
        return jnp.sum(each), each

    @jax.jit
    def update(variables: Any, memory: Any, weights: Any, huber: Any, gap_weights: Any) -> Any:
        slopes, each = jax.grad(costs, has_aux=True)(variables, weights, huber, gap_weights)
        slopes = (slopes[0], slopes[1] * mask)
        changes, memory = jax.vmap(optimiser.update)(slopes, memory, variables)
        return optax.apply_updates(variables, changes), memory, each

    limit, steps = sum(stage.step_limit for stage in stages), 0
    best, best_cost = variables, np.full(count, np.inf)
    for stage in stages:
        used = np.sum(stage.weights.residual > 0)
        settings = (
            jnp.asarray(stage.weights.residual, dtype),
            jnp.asarray(np.inf if stage.weights.huber is None else stage.weights.huber, dtype),
            jnp.asarray(stage.weights.gap, dtype),
        )
        memory = jax.vmap(optimiser.init)(variables)
        best, best_cost = variables, np.full(count, np.inf)
        for _ in range(stage.step_limit):
            before = variables
            variables, memory, each = update(variables, memory, *settings)
            each = np.where(np.isfinite(each), np.asarray(each, float) * used, np.inf)
            better = each < best_cost
            best_cost = np.where(better, each, best_cost)
            best = jax.tree.map(
                lambda new, old, better=better: jnp.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old),
                before,
                best,
            )
            steps += 1
            if progress is not None:
                progress(steps, limit, float(best_cost.min()))
        variables = best
    found, charts = (np.asarray(part, float) for part in best)
    settled = _settled(objective, found, charts, free, stages[-1], best_cost)
    return Solution(found, charts, best_cost, settled, steps)


def _settled(
    objective: Objective, unbounded: np.ndarray, charts: np.ndarray, free: np.ndarray, stage: Stage, costs: np.ndarray
) -> np.ndarray:
    """(b,) whether each start ended near a minimum, as a step of Gauss-Newton from there tells."""
    found = objective.linearise(unbounded, charts)
    settled = np.isfinite(costs)
    for b in map(int, np.flatnonzero(settled)):
        part = stack_starts(found, b)
        equations = normal_equations(part, stage.weights, free)
        # A step by one deviation changes the cost by half the mean square of the residuals.
        allowed = AWAY**2 * costs[b] / np.sum(stage.weights.residual > 0)
        settled[b] = foreseen_decrease(equations, *solve(equations, 0.0)) <= allowed
    return settled
