"""How well the data determine the parameters: covariance, intervals, and warnings where they do not."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

from mathota_jax.fit.normal_equations import NormalEquations, information
from mathota_jax.fit.parameters import ParameterVector

UNSEEN = 1e-10
"""Share of its own information below which a direction of the parameters counts as not determined at all."""

CORRELATED = 0.95
"""Correlation above which two parameters are said to be hard to tell apart."""

VAGUE = 0.5
"""Half width of an interval over the estimate above which a parameter is said to be poorly determined."""

MISFIT, CHANCE = 1.2, 1e-4
"""The model is said not to explain the data where the residuals are this many times the noise given, and of right models
fewer than this share would have such residuals."""


class Uncertainty(NamedTuple):
    """How well the parameters are known.

    Attributes:
        covariance: (entry, entry) of the unbounded numbers; infinite where they are not determined.
        correlation: (entry, entry).
        lower, upper: (entry,) confidence interval of each value.
        noise_factor: root mean square of the residuals in units of the noise given.
        degrees_of_freedom: residuals less unknowns.
        warnings: sentences.
    """

    covariance: np.ndarray
    correlation: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    noise_factor: float
    degrees_of_freedom: int
    warnings: tuple[str, ...]


def uncertainty(
    vector: ParameterVector,
    unbounded: np.ndarray,
    equations: NormalEquations,
    square_sum: float,
    residual_count: int,
    start_unknowns: int,
    confidence: float,
) -> Uncertainty:
    """Covariance ``s^2 (J^T J)^-1`` of least squares, s^2 being the mean square of the residuals found.

    Honest where the residuals are independent and the model is right: then the interval of each parameter holds the
    truth in the given share of all repetitions. Unknown beginnings are accounted for. The interval is Student's in the
    unbounded number, mapped to the parameter, so that it keeps the bounds.

    Args:
        vector: parameters.
        unbounded: (entry,) estimate.
        equations: there.
        square_sum: of the residuals there.
        residual_count: number of residuals, what pulls beginnings towards the scene included.
        start_unknowns: number of free numbers of all beginnings.
        confidence: share such as 0.95.
    """
    warnings: list[str] = []
    known = information(equations)
    freedom = residual_count - vector.size - start_unknowns
    factor = float(np.sqrt(square_sum / freedom)) if freedom > 0 else np.nan
    if freedom <= 0:
        warnings.append(
            f"There are {residual_count} residuals for {vector.size + start_unknowns} unknowns: no noise can be estimated "
            "and there are no intervals."
        )
    inverse, undetermined = _inverse(known, np.diagonal(equations.parameters))
    covariance = inverse * factor**2
    deviation = np.sqrt(np.where(undetermined, np.inf, np.diagonal(covariance)))
    correlation = _correlation(covariance)
    quantile = float(stats.t.ppf(0.5 + confidence / 2, max(freedom, 1)))
    values = np.asarray(vector.values(unbounded), float)
    lower, upper = _intervals(vector, unbounded, covariance, deviation * quantile, quantile)
    for k, label in enumerate(vector.labels):
        if undetermined[k]:
            warnings.append(
                f"'{label}' is not determined: the residuals hardly depend on it, or other parameters undo it."
            )
        elif max(values[k] - lower[k], upper[k] - values[k]) > VAGUE * abs(values[k]):
            warnings.append(f"'{label}' is poorly determined: its interval is {lower[k]:.4g} to {upper[k]:.4g}.")
        for other in range(k):
            if not undetermined[[k, other]].any() and abs(correlation[k, other]) > CORRELATED:
                warnings.append(
                    f"'{vector.labels[other]}' and '{label}' are hard to tell apart: their correlation is "
                    f"{correlation[k, other]:.3f}."
                )
    warnings += _at_bounds(vector, unbounded)
    if freedom > 0 and factor > max(MISFIT, float(np.sqrt(stats.chi2.isf(CHANCE, freedom) / freedom))):
        warnings.append(
            f"The residuals are {factor:.3g} times the noise given: the model does not explain the data, or the noise is "
            "larger. The intervals grow with the residuals but take them for independent, so that they are too narrow "
            "where the model is wrong."
        )
    return Uncertainty(covariance, correlation, lower, upper, factor, max(freedom, 0), tuple(warnings))


def _inverse(known: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of the information, and which entries it does not determine.

    Args:
        known: (entry, entry) information on all entries together.
        own: (entry,) information on each entry if all else were known.
    """
    scale = np.where(own > 0, 1.0 / np.sqrt(np.where(own > 0, own, 1.0)), 0.0)
    shares, directions = np.linalg.eigh(known * scale[:, None] * scale[None])
    unseen = shares <= UNSEEN
    undetermined = (directions[:, unseen] ** 2).sum(1) > 1e-6
    safe = np.where(unseen, np.inf, shares)
    inverse = (directions / safe) @ directions.T * scale[:, None] * scale[None]
    inverse[undetermined] = 0.0
    inverse[:, undetermined] = 0.0
    inverse[undetermined, undetermined] = np.inf
    return inverse, undetermined


def _correlation(covariance: np.ndarray) -> np.ndarray:
    variance = np.diagonal(covariance)
    usable = np.isfinite(variance) & (variance > 0)
    scale = np.where(usable, 1.0 / np.sqrt(np.where(usable, variance, 1.0)), 0.0)
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    return finite * scale[:, None] * scale[None] + np.diag(np.where(usable, 0.0, 1.0))


def _intervals(
    vector: ParameterVector, unbounded: np.ndarray, covariance: np.ndarray, reach: np.ndarray, quantile: float
) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the intervals of the values: mapped where the map is elementwise, else by its Jacobian."""
    lower = np.asarray(vector.values(unbounded - reach), float)
    upper = np.asarray(vector.values(unbounded + reach), float)
    values = np.asarray(vector.values(unbounded), float)
    for place in vector.places:
        if place.transform.name == "consistent moments":
            part = slice(place.begin, place.end)
            second = np.exp(unbounded[part])
            slope = second[None] * (1.0 - np.eye(3))
            width = quantile * np.sqrt(np.diagonal(slope @ covariance[part, part] @ slope.T))
            lower[part], upper[part] = np.maximum(values[part] - width, 0.0), values[part] + width
    return lower, upper


def _at_bounds(vector: ParameterVector, unbounded: np.ndarray) -> list[str]:
    values = np.asarray(vector.values(unbounded), float)
    found = []
    for k, label in enumerate(vector.labels):
        place = next(place for place in vector.places if place.begin <= k < place.end)
        lower, upper = place.bounds
        width = upper - lower
        if place.transform.name == "logit" and min(values[k] - lower, upper - values[k]) < 0.01 * width:
            found.append(f"'{label}' is at one of its bounds ({values[k]:.4g}, bounds {lower:g} and {upper:g}).")
    return found
