"""Maps between parameters with bounds and the unbounded numbers that optimisers move."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Transform(NamedTuple):
    """A smooth one-to-one map, increasing where it is elementwise.

    Attributes:
        name: for messages and reports.
        to_value: unbounded array -> parameter of the same shape, JAX.
        to_unbounded: its inverse, NumPy float64.
        elementwise: whether each number is mapped alone.
    """

    name: str
    to_value: Callable[[Any], Any]
    to_unbounded: Callable[[Any], np.ndarray]
    elementwise: bool = True


def identity() -> Transform:
    """All real numbers."""
    return Transform("identity", lambda u: u, lambda value: np.asarray(value, float))


def log(lower: float = 0.0) -> Transform:
    """Above `lower`; equal steps are equal ratios of the distance to it."""
    return Transform("log", lambda u: lower + jnp.exp(u), lambda value: np.log(np.asarray(value, float) - lower))


def softplus(lower: float = 0.0) -> Transform:
    """Above `lower`; close to the identity where the parameter is large, to `log` near the bound."""

    def inverse(value: Any) -> np.ndarray:
        above = np.asarray(value, float) - lower
        return above + np.log(-np.expm1(-above))

    return Transform("softplus", lambda u: lower + jax.nn.softplus(u), inverse)


def logit(lower: float, upper: float) -> Transform:
    """Between two bounds."""

    def inverse(value: Any) -> np.ndarray:
        share = (np.asarray(value, float) - lower) / (upper - lower)
        return np.log(share) - np.log1p(-share)

    def to_value(u: Any) -> Any:
        # From the nearer bound: 1 less a sigmoid near 1 loses its slope in float32.
        width = upper - lower
        return jnp.where(u < 0, lower + width * jax.nn.sigmoid(u), upper - width * jax.nn.sigmoid(-u))

    return Transform("logit", to_value, inverse)


def moments() -> Transform:
    """Principal moments of inertia (3,) that some mass distribution has.

    A body whose density has the second moments ``s`` along its principal axes has the moments of inertia
    ``(s_y + s_z, s_z + s_x, s_x + s_y)``. These are consistent (positive, and each at most the sum of the other two) if
    and only if every ``s`` is positive, so the unbounded numbers are ``log s``: the diagonal case of the log-Cholesky
    pseudo-inertia of C. Rucker and P. Wensing, "Smooth Parameterization of Rigid-Body Inertia", RA-L 2022.
    """

    def to_value(u: Any) -> Any:
        second = jnp.exp(u)
        return jnp.sum(second) - second

    def inverse(value: Any) -> np.ndarray:
        value = np.asarray(value, float)
        return np.log(value.sum() / 2 - value)

    return Transform("consistent moments", to_value, inverse, elementwise=False)


NAMES = ("identity", "log", "softplus", "logit")
"""What a user may ask for by name."""
