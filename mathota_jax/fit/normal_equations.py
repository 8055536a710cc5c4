"""Gauss-Newton equations of shared parameters and of the beginnings of each trajectory, NumPy float64.

The matrix has the shape of an arrow: beginnings of different trajectories are coupled through the parameters alone, so
that eliminating them (Schur complement) leaves a system as small as the number of parameters.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mathota_jax.fit.objective import Linearised

NOISE = 64.0
"""Columns shorter than this many round-offs of the longest say nothing; 2e-6 of it were seen, by the mass of a free ball."""


class Weights(NamedTuple):
    """How much each residual counts.

    Attributes:
        residual: (n, s, m) factor of each, 0 for those left out.
        gap: (chart,) factor of the jumps between segments.
        huber: residuals beyond this many standard deviations count linearly (P. Huber, 1964); None for never.
    """

    residual: np.ndarray
    gap: np.ndarray
    huber: float | None


class NormalEquations(NamedTuple):
    """``H step = -gradient`` in blocks; p parameters, n trajectories, l free numbers of the beginnings of each.

    Attributes:
        parameters: (p, p) block.
        coupling: (n, p, l).
        starts: (n, l, l).
        gradient: (p,).
        start_gradient: (n, l).
    """

    parameters: np.ndarray
    coupling: np.ndarray
    starts: np.ndarray
    gradient: np.ndarray
    start_gradient: np.ndarray


def cost(residual: np.ndarray, gap: np.ndarray, weights: Weights) -> float:
    """Half the sum of squares, or of Huber's function; infinite where something is not finite."""
    scaled = weights.residual * np.asarray(residual, float)
    size = np.abs(scaled)
    if weights.huber is None:
        data = 0.5 * np.sum(size**2)
    else:
        limit = weights.huber
        data = np.sum(np.where(size <= limit, 0.5 * size**2, limit * (size - 0.5 * limit)))
    total = data + 0.5 * np.sum((weights.gap * np.asarray(gap, float)) ** 2)
    return float(total) if np.isfinite(total) else float("inf")


def robust_factor(residual: np.ndarray, weights: Weights) -> np.ndarray:
    """Square root of the weight of each residual in iteratively reweighted least squares, `weights.residual` included."""
    if weights.huber is None:
        return weights.residual
    size = np.abs(weights.residual * residual)
    return weights.residual * np.sqrt(np.minimum(1.0, weights.huber / np.maximum(size, weights.huber)))


def normal_equations(found: Linearised, weights: Weights, free: np.ndarray) -> NormalEquations:
    """Sums over the residuals of one start of the optimiser.

    Args:
        found: without the axis of starts.
        weights: of the residuals.
        free: (s * chart,) which numbers of the beginnings are free; they are columns of the blocks.
    """
    residual = np.asarray(found.residual, float)
    factor = robust_factor(residual, weights)
    residual = factor * residual
    by_parameters = _influence(factor[..., None] * np.asarray(found.by_parameters, float), found.by_parameters)
    size = by_parameters.shape[-1]
    flat = by_parameters.reshape(-1, size)
    matrix, gradient = flat.T @ flat, flat.T @ residual.ravel()
    count = len(residual)
    if not free.any():
        return NormalEquations(
            matrix, np.zeros((count, size, 0)), np.zeros((count, 0, 0)), gradient, np.zeros((count, 0))
        )
    by_start = factor[..., None] * np.asarray(found.by_start, float)
    segments, chart = by_start.shape[1], by_start.shape[-1]
    coupling = np.einsum("nsmp,nsmc->npsc", by_parameters, by_start)
    start_gradient = np.einsum("nsmc,nsm->nsc", by_start, residual)
    starts = np.zeros((count, segments, chart, segments, chart))
    for k in range(segments):
        starts[:, k, :, k] += np.einsum("nmc,nmd->ncd", by_start[:, k], by_start[:, k])
    if segments > 1:
        gap = weights.gap * np.asarray(found.gap, float)
        scale = weights.gap[:, None]
        columns = [
            scale * np.asarray(part, float) for part in (found.gap_by_parameters, found.gap_by_start, found.gap_by_next)
        ]
        columns[0] = _influence(columns[0], found.gap_by_parameters)
        jump_flat = columns[0].reshape(-1, size)
        matrix = matrix + jump_flat.T @ jump_flat
        gradient = gradient + jump_flat.T @ gap.ravel()
        for k in range(segments - 1):
            ends = [(k, columns[1][:, k]), (k + 1, columns[2][:, k])]
            for place, slope in ends:
                coupling[:, :, place] += np.einsum("ngp,ngc->npc", columns[0][:, k], slope)
                start_gradient[:, place] += np.einsum("ngc,ng->nc", slope, gap[:, k])
                for other, other_slope in ends:
                    starts[:, place, :, other] += np.einsum("ngc,ngd->ncd", slope, other_slope)
    length = segments * chart
    return NormalEquations(
        matrix,
        coupling.reshape(count, size, length)[:, :, free],
        starts.reshape(count, length, length)[:, free][:, :, free],
        gradient,
        start_gradient.reshape(count, length)[:, free],
    )


def _influence(slopes: np.ndarray, source: Any) -> np.ndarray:
    """Weighted slopes (..., p) without the columns that are nothing but round-off of the number type of `source`.

    The mass of a body that has met nothing yet would be changed by any factor for a millionth of the residual.
    """
    length = np.linalg.norm(slopes.reshape(-1, slopes.shape[-1]), axis=0)
    noise = NOISE * np.finfo(np.asarray(source).dtype).eps * length.max(initial=0.0)
    return np.where(length > noise, slopes, 0.0)


def solve(equations: NormalEquations, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Marquardt's step of the parameters (p,) and of the free numbers of the beginnings (n, l).

    The damping multiplies the diagonal (D. Marquardt, 1963), raised where a column has no influence at all.
    """
    matrix = _damped(equations.parameters, damping)
    if not equations.starts.shape[-1]:
        return -np.linalg.solve(matrix, equations.gradient), np.zeros_like(equations.start_gradient)
    starts = _damped(equations.starts, damping)
    coupling = equations.coupling
    eliminated = np.linalg.solve(starts, np.swapaxes(coupling, 1, 2))  # (n, l, p)
    inner = np.linalg.solve(starts, equations.start_gradient[..., None])[..., 0]
    schur = matrix - np.einsum("npl,nlq->pq", coupling, eliminated)
    step = -np.linalg.solve(schur, equations.gradient - np.einsum("npl,nl->p", coupling, inner))
    return step, -(inner + eliminated @ step)


def foreseen_decrease(equations: NormalEquations, step: np.ndarray, start_step: np.ndarray) -> float:
    """Of the cost, by a step that `solve` gives."""
    return float(-0.5 * (equations.gradient @ step + np.sum(equations.start_gradient * start_step)))


def information(equations: NormalEquations) -> np.ndarray:
    """What is known of the parameters (p, p) when the beginnings are unknown: the Schur complement."""
    if not equations.starts.shape[-1]:
        return equations.parameters
    # Directions of the beginnings that nothing shows (the spin of a ball without friction) must not matter.
    inverse = np.linalg.pinv(_scaled(equations.starts), rcond=1e-12, hermitian=True)
    scale = _scale(equations.starts)
    coupling = equations.coupling * scale[:, None]
    return equations.parameters - np.einsum("npl,nlk,nqk->pq", coupling, inverse, coupling)


def _damped(matrix: np.ndarray, damping: float) -> np.ndarray:
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    floor = np.maximum(diagonal.max(-1, keepdims=True) * 1e-12, np.finfo(float).tiny)
    return matrix + np.eye(matrix.shape[-1]) * (damping * diagonal + floor)[..., None, :]


def _scale(matrix: np.ndarray) -> np.ndarray:
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    return np.where(diagonal > 0, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)


def _scaled(matrix: np.ndarray) -> np.ndarray:
    scale = _scale(matrix)
    return matrix * scale[..., None, :] * scale[..., :, None]


def stack_starts(found: Any, index: int) -> Linearised:
    """The part of a `Linearised` that belongs to one start, as NumPy arrays."""
    return Linearised(*(np.asarray(leaf[index]) for leaf in found))
