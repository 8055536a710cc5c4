"""How well the data determine the parameters: covariance, intervals, and warnings where they do not."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from mathota_jax.fit.normal_equations import Weights, information, normal_equations
from mathota_jax.fit.objective import Linearised
from mathota_jax.fit.parameters import ParameterVector
from mathota_jax.fit.residual_scale import residual_scale

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
        covariance: (entry, entry) of the values; infinite where they are not determined.
        correlation: (entry, entry) of the values.
        lower, upper: (entry,) confidence interval of each value.
        noise_factor: size of the residuals in units of the noise given.
        warnings: sentences.
    """

    covariance: np.ndarray
    correlation: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    noise_factor: float
    warnings: tuple[str, ...]


def uncertainty(
    vector: ParameterVector,
    unbounded: np.ndarray,
    found: Linearised,
    weights: Weights,
    free: np.ndarray,
    pulls: np.ndarray,
    start_unknowns: int,
    confidence: float,
) -> Uncertainty:
    """Covariance ``s^2 (J^T J)^-1`` of the values, s^2 being the mean square of the residuals found; see `residual_scale`.

    Honest where the residuals are independent and the model is right: then the interval of each parameter holds the
    truth in the given share of all repetitions. Unknown beginnings are accounted for.

    Args:
        vector: parameters.
        unbounded: (entry,) estimate, off the bounds (`ParameterVector.off_bounds`).
        found: residuals and slopes there.
        weights: of the residuals, 0 or 1.
        free: (s * chart,) which numbers of the beginnings are free.
        pulls: (m,) which residuals pull beginnings towards the scene.
        start_unknowns: number of free numbers of all beginnings.
        confidence: share such as 0.95.
    """
    warnings: list[str] = []
    values, slope = np.asarray(vector.values(unbounded), float), _slope(vector, unbounded)
    # A unit for each value, in which the slopes of the residuals are of the size that the optimiser saw. Its own unbounded
    # numbers hide those of what is at a bound, and mix the three moments of a body.
    unit = np.maximum(np.abs(slope).sum(1), np.abs(_slope(vector, vector.start)).sum(1))
    found = _by_values(found, np.linalg.inv(slope) * unit)
    equations = normal_equations(found, weights._replace(huber=None), free)
    known = information(equations)
    residual, used = np.asarray(found.residual, float), weights.residual > 0
    freedom = int(used.sum()) - vector.size - start_unknowns
    scale = residual_scale(residual[used & ~pulls], residual[used & pulls], weights.huber, freedom)
    if freedom <= 0:
        warnings.append(
            f"There are {used.sum()} residuals for {vector.size + start_unknowns} unknowns: no noise can be estimated "
            "and there are no intervals."
        )
    inverse, undetermined = _inverse(known, np.diagonal(equations.parameters))
    covariance = inverse * scale.spread**2 * unit[:, None] * unit
    covariance[undetermined, undetermined] = np.inf
    deviation = np.sqrt(np.diagonal(covariance))
    correlation = _correlation(covariance)
    pull = normal_equations(found, weights, free).gradient
    step = -unit * pull / np.where(undetermined, np.inf, np.diagonal(known))
    bounds = _bounds_reached(vector, values, step, deviation)
    quantile = float(stats.t.ppf(0.5 + confidence / 2, scale.freedom))
    lower, upper = _intervals(vector, unbounded, deviation * quantile, np.diagonal(slope), np.isfinite(bounds))
    for k, label in enumerate(vector.labels):
        interval = f"its interval is {lower[k]:.4g} to {upper[k]:.4g}."
        if undetermined[k]:
            warnings.append(
                f"'{label}' is not determined: the residuals hardly depend on it, or other parameters undo it."
            )
        elif np.isfinite(bounds[k]):
            warnings.append(
                f"'{label}' is at its bound {bounds[k]:g}: the data want it beyond, or do not tell it from there; {interval}"
            )
        elif max(values[k] - lower[k], upper[k] - values[k]) > VAGUE * abs(values[k]):
            warnings.append(f"'{label}' is poorly determined: {interval}")
        for other in range(k):
            if not undetermined[[k, other]].any() and abs(correlation[k, other]) > CORRELATED:
                warnings.append(
                    f"'{vector.labels[other]}' and '{label}' are hard to tell apart: their correlation is "
                    f"{correlation[k, other]:.3f}."
                )
    chance = float(np.sqrt(stats.chi2.isf(CHANCE, scale.freedom) / scale.freedom))
    if scale.noise_factor > max(MISFIT, chance):
        warnings.append(
            f"The residuals are {scale.noise_factor:.3g} times the noise given: the model does not explain the data, or "
            "the noise is larger. The intervals grow with the residuals but take them for independent, so that they are "
            "too narrow where the model is wrong."
        )
    return Uncertainty(covariance, correlation, lower, upper, scale.noise_factor, tuple(warnings))


def _slope(vector: ParameterVector, unbounded: np.ndarray) -> np.ndarray:
    """(entry, entry) of the values by the unbounded numbers."""
    return np.asarray(jax.jacfwd(vector.values)(jnp.asarray(unbounded)), float)


def _by_values(found: Linearised, change: np.ndarray) -> Linearised:
    """Slopes by other numbers, by which the unbounded ones have the slope `change` (entry, entry).

    They keep the number type, which says how much of them is round-off.
    """
    parts = (np.asarray(part) for part in (found.by_parameters, found.gap_by_parameters))
    by_parameters, gap_by_parameters = ((part.astype(float) @ change).astype(part.dtype) for part in parts)
    return found._replace(by_parameters=by_parameters, gap_by_parameters=gap_by_parameters)


def _inverse(known: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of the information, 0 for entries that it does not determine, and which these are.

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
    return inverse, undetermined


def _correlation(covariance: np.ndarray) -> np.ndarray:
    variance = np.diagonal(covariance)
    usable = np.isfinite(variance) & (variance > 0)
    scale = np.where(usable, 1.0 / np.sqrt(np.where(usable, variance, 1.0)), 0.0)
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    return finite * scale[:, None] * scale[None] + np.diag(np.where(usable, 0.0, 1.0))


def _intervals(
    vector: ParameterVector, unbounded: np.ndarray, reach: np.ndarray, slope: np.ndarray, at_bound: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the intervals: bounds, or infinity, of what is not determined.

    Those of the unbounded numbers are mapped, so that they keep the bounds. At a bound, where the map is as flat as it is
    curved, and where it is not elementwise, they are linear in the value.

    Args:
        vector: parameters.
        unbounded: (entry,) estimate.
        reach: (entry,) half widths in the value; infinite where it is not determined.
        slope: (entry,) of the values by the unbounded numbers, used where the map is elementwise.
        at_bound: (entry,).
    """
    values = np.asarray(vector.values(unbounded), float)
    lower, upper = values - reach, values + reach
    for place in vector.places:
        part = slice(place.begin, place.end)
        if place.transform.elementwise:
            mapped = reach[part] / slope[part]
            for ends, end in ((lower, unbounded[part] - mapped), (upper, unbounded[part] + mapped)):
                ends[part] = np.where(at_bound[part], ends[part], np.asarray(place.transform.to_value(end), float))
        lower[part], upper[part] = np.clip(lower[part], *place.bounds), np.clip(upper[part], *place.bounds)
    return lower, upper


def _bounds_reached(vector: ParameterVector, values: np.ndarray, step: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """(entry,) the bound that the data do not tell the value from, being less than its deviation away; else NaN.

    Measured from where each alone, without bounds, would go: the optimiser stops short of bounds. Values that move by
    ratios (`log`) are told from 0 by any factor, so that they must want to go as far.

    Args:
        vector: parameters.
        values: (entry,) estimates.
        step: (entry,) to the least squares of each value alone, if there were no bounds.
        deviation: (entry,) standard deviations; infinite where a value is not determined.
    """
    found = np.full(vector.size, np.nan)
    for place in vector.places:
        for k in range(place.begin, place.end):
            near = 0.0 if place.transform.name == "log" else deviation[k]
            lower, upper = place.bounds
            reached = [
                bound
                for bound, room in ((lower, values[k] + step[k] - lower), (upper, upper - values[k] - step[k]))
                if np.isfinite(deviation[k]) and np.isfinite(bound) and room <= near
            ]
            # Where both are as near, the data tell of neither.
            if place.transform.elementwise and len(reached) == 1:
                found[k] = reached[0]
    return found
