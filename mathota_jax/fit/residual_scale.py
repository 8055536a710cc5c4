"""How large the residuals are, and how far they spread the estimates: least squares, and M-estimates of Huber's kind."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats


class ResidualScale(NamedTuple):
    """What the residuals of a fit tell of the noise.

    Attributes:
        noise_factor: the noise in units of the one given; the root mean square of the residuals where none is clipped.
        spread: its square times ``(J^T J)^-1`` is the covariance of the estimates.
        freedom: degrees of freedom with which the two are known.
    """

    noise_factor: float
    spread: float
    freedom: float


def residual_scale(recorded: np.ndarray, pulled: np.ndarray, huber: float | None, freedom: int) -> ResidualScale:
    """Scale of residuals in units of the noise given.

    With ``psi`` clipping at `huber`, the covariance of an M-estimate is ``(K / mean psi')^2 sum psi^2 / (n - p)
    (J^T J)^-1``, where ``K = 1 + p / n var psi' / (mean psi')^2`` (P. Huber, Robust Statistics, 1981, section 7.6);
    without clipping that is least squares. Least squares of the weighted residuals instead would take what is clipped for
    known: at 0.3 standard deviations the intervals are half as wide as the estimates scatter.

    Args:
        recorded: (n,) residuals of what was recorded.
        pulled: residuals of what pulls beginnings towards the scene; 0 where nothing else tells of them, so that they
            count among the unknowns they hold but not in the means.
        huber: residuals beyond this many standard deviations count linearly; None for none.
        freedom: number of all residuals less unknowns.
    """
    if freedom <= 0:
        return ResidualScale(np.nan, np.nan, 1.0)
    limit = np.inf if huber is None else huber
    square = (
        float(np.sum(np.clip(recorded, -limit, limit) ** 2) + np.sum(np.clip(pulled, -limit, limit) ** 2)) / freedom
    )
    if huber is None:
        return ResidualScale(np.sqrt(square), np.sqrt(square), freedom)
    count = len(recorded)
    inside = max(float(np.mean(np.abs(recorded) <= limit)), 1.0 / count)
    spread = np.sqrt(square) / inside * (1.0 + (1.0 - freedom / count) * (1.0 - inside) / inside)
    return ResidualScale(spread * np.sqrt(_efficiency(huber)), spread, max(inside * freedom, 1.0))


def _efficiency(huber: float) -> float:
    """Variance of the mean over that of Huber's estimate, of normal errors (P. Huber, 1964)."""
    inside = 2.0 * stats.norm.cdf(huber) - 1.0
    square = inside - 2.0 * huber * stats.norm.pdf(huber) + 2.0 * huber**2 * stats.norm.sf(huber)
    return float(inside**2 / square)
