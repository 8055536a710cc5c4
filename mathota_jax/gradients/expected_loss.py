"""Gradients of expected losses: of first order, of order zero, and mixed.

Near contacts a loss can jump, and the mean of its derivatives is then not the derivative of its mean: a ball that clears a
wall or does not. The difference quotients of order zero do not mind jumps but scatter more. The mixed estimator weighs
both by their variances as long as they agree within their scatter (H. J. T. Suh, M. Simchowitz, K. Zhang, R. Tedrake, "Do
Differentiable Simulators Give Better Policy Gradients?", ICML 2022, https://arxiv.org/abs/2202.00817: the alpha-order
gradient).

All estimate the gradient of ``F(x) = E loss(x + deviation * w)``, w standard normal, at the parameters x.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.flatten_util import ravel_pytree

from mathota_jax.spatial.safe import safe_divide, safe_sqrt

Loss = Callable[[Any], Array]


class Estimate(NamedTuple):
    """Estimated gradient of an expected loss.

    Attributes:
      gradient: pytree like the parameters.
      standard_error: () standard error of the estimate: Euclidean norm over its entries. Of the scatter from key to key,
        not of a bias.
      value: () mean of the loss.
      first_order_share: () weight of the first-order gradient in the estimate, between 0 and 1.
    """

    gradient: Any
    standard_error: Array
    value: Array
    first_order_share: Array


class _Samples(NamedTuple):
    """Gradients of antithetic pairs of samples (pair, entry), and the losses (pair,), mean of the two."""

    gradients: Array
    losses: Array


def first_order(loss: Loss, parameters: Any, key: Array, *, deviation: Any, pairs: int = 64) -> Estimate:
    """Mean of the derivatives of the loss at perturbed parameters.

    Wrong, whatever the number of samples, where the loss jumps; the best choice where it is continuous.

    Args:
      loss: of the parameters, one number; differentiated in reverse mode and mapped over samples.
      parameters: pytree of floats.
      key: random key.
      deviation: standard deviation of the perturbation of each entry, in its unit: a number for all, or a pytree like the
        parameters.
      pairs: antithetic pairs of samples, at least 2.

    Raises:
      ValueError: `pairs` is less than 2 or a deviation, where known, is not positive.
    """
    flat, unravel, spread, noise = _perturbations("first_order", parameters, key, deviation, pairs)
    return _estimate(_first(loss, flat, unravel, spread, noise), unravel, 1.0)


def zeroth_order(loss: Loss, parameters: Any, key: Array, *, deviation: Any, pairs: int = 64) -> Estimate:
    """Mean of antithetic difference quotients ``(loss(x + s w) - loss(x - s w)) w / (2 s)``; arguments as `first_order`.

    Right for every loss of which the mean exists, also one that jumps; needs no derivative. The scatter grows with the
    number of parameters.
    """
    flat, unravel, spread, noise = _perturbations("zeroth_order", parameters, key, deviation, pairs)
    return _estimate(_zeroth(loss, flat, unravel, spread, noise), unravel, 0.0)


def mixed_order(
    loss: Loss, parameters: Any, key: Array, *, deviation: Any, pairs: int = 64, tolerance: float = 1.0
) -> Estimate:
    """First and zeroth order from the same samples, weighed by their variances; arguments as `first_order`.

    The share of the first order is that of least variance, ``s0^2 / (s0^2 + s1^2)``, but never so large that the two
    estimates, should they differ because the first order is wrong, pull the result by more than `tolerance` standard
    errors of the zeroth order away from it (Suh et al. bound the bias by a confidence interval in the same way). So the
    estimate is right in the limit of many samples also where the loss jumps.

    Each half of the pairs is weighed by the share that the other half asks for (cross-fitting: V. Chernozhukov et al.,
    "Double/debiased machine learning for treatment and structural parameters", 2018). A share is thus independent of the
    samples that it weighs: where the first order is right the estimate has no bias, and `standard_error` is that of a sum
    with known weights. Where it is wrong the difference is known to the scatter of a half only, so that the mean pull
    reaches 1.25 `tolerance` where the difference is about 3 standard errors.

    Args:
      loss: as for `first_order`.
      parameters: likewise.
      key: likewise.
      deviation: likewise.
      pairs: likewise, but at least 4: two in each half.
      tolerance: bias allowed, in standard errors of the zeroth order.

    Raises:
      ValueError: as `first_order`, or a negative tolerance.
    """
    if not tolerance >= 0:
        raise ValueError(f"mixed_order: tolerance must be at least 0, got {tolerance!r}")
    flat, unravel, spread, noise = _perturbations("mixed_order", parameters, key, deviation, pairs, fewest=4)
    first = _first(loss, flat, unravel, spread, noise)
    zeroth = _zeroth(loss, flat, unravel, spread, noise)
    halves = [
        _half(first.gradients[part], zeroth.gradients[part], spread, tolerance)
        for part in (slice(None, pairs // 2), slice(pairs // 2, None))
    ]
    crossed = list(zip(halves, reversed(halves), strict=True))
    mixed = jnp.concatenate([half.weighed_by(other.share) for half, other in crossed])
    share = sum(len(half.first) / pairs * other.share for half, other in crossed)
    return Estimate(unravel(mixed.mean(0)), _cross_fitted_error(halves), first.losses.mean(), jnp.asarray(share))


class _Half(NamedTuple):
    """Half of the samples of a mixed estimate, and the share of the first order that it asks for.

    Attributes:
      first: (pair, entry) gradients of first order.
      zeroth: (pair, entry) of order zero.
      share: () for the other half; without derivative.
      share_influence: (pair,) of each pair on it: by their mean the share deviates from its expectation, in linear order
        (infinitesimal jackknife: B. Efron, "The Jackknife, the Bootstrap and Other Resampling Plans", 1982, chapter 6).
    """

    first: Array
    zeroth: Array
    share: Array
    share_influence: Array

    @property
    def difference(self) -> Array:
        """(pair, entry) of the orders."""
        return self.first - self.zeroth

    def weighed_by(self, share: Array) -> Array:
        """(pair, entry) mixed gradients."""
        return self.zeroth + share * self.difference


def _half(first: Array, zeroth: Array, spread: Array, tolerance: float) -> _Half:
    # In units of the deviations the entries can be compared and their variances added.
    known = jax.lax.stop_gradient((first * spread, zeroth * spread))
    share, slope = jax.value_and_grad(_share)(jnp.ones(len(first), first.dtype), *known, tolerance)
    return _Half(first, zeroth, share, len(first) * slope)


def _share(weights: Array, first: Array, zeroth: Array, tolerance: float) -> Array:
    """Share of the first order that half of the samples, of equal weights (pair,), asks for."""
    weights = weights / weights.sum()
    means = [weights @ gradients for gradients in (first, zeroth)]
    squared_first, squared_zeroth = (
        weights @ jnp.sum((gradients - mean) ** 2, 1) / (len(weights) - 1)
        for gradients, mean in zip((first, zeroth), means, strict=True)
    )
    total, gap = squared_first + squared_zeroth, jnp.sum((means[0] - means[1]) ** 2)
    least_variance = jnp.where(total > 0, safe_divide(squared_zeroth, total), 1.0)
    # The squared standard error of all samples is half of that of one half.
    bound = tolerance * safe_sqrt(safe_divide(0.5 * squared_zeroth, gap))
    return jnp.where(gap > 0, jnp.minimum(least_variance, bound), least_variance)


def _cross_fitted_error(halves: list[_Half]) -> Array:
    """Standard error of the mean of two halves, each weighed by the share that the other asks for.

    With the shares taken as constants it is that of the mixed samples, which is right if the orders agree. If they differ
    by a gap, a pair also moves the estimate by its influence on the share of the other half, times the gap. The square of
    a measured gap is too large by its variance, which is taken off as far as it goes.
    """
    pairs = sum(len(half.first) for half in halves)
    squared = jnp.zeros((), halves[0].first.dtype)
    for half, other in zip(halves, reversed(halves), strict=True):
        gap = other.difference.mean(0)
        certain = jnp.maximum(1.0 - safe_divide(_squared_error(other.difference), jnp.sum(gap**2)), 0.0)
        by_share = len(other.first) / len(half.first) * half.share_influence[:, None] * safe_sqrt(certain) * gap
        squared += (len(half.first) / pairs) ** 2 * _squared_error(half.weighed_by(other.share) + by_share)
    return jnp.sqrt(squared)


def _perturbations(
    name: str, parameters: Any, key: Array, deviation: Any, pairs: int, fewest: int = 2
) -> tuple[Array, Callable[[Array], Any], Array, Array]:
    """Flat parameters, their inverse, deviations (entry,) and standard normal noise (pair, entry)."""
    if isinstance(pairs, bool) or not isinstance(pairs, int) or pairs < fewest:
        raise ValueError(f"{name}: pairs must be an integer of at least {fewest}, got {pairs!r}")
    # Leaf by leaf: flattening makes floats of integers beside floats, and unravelling integers of what is added to them.
    for leaf in jax.tree.leaves(parameters):
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(f"{name}: the parameters must be floats, got {jnp.result_type(leaf)}")
    # With NumPy: under `jax.jit` what JAX computes is not known, also of arrays that are.
    for leaf in jax.tree.leaves(deviation):
        if not isinstance(leaf, Tracer) and not (np.asarray(leaf) > 0).all():
            raise ValueError(f"{name}: every deviation must be positive, got {deviation!r}")
    flat, unravel = ravel_pytree(parameters)
    if jax.tree.structure(deviation) == jax.tree.structure(parameters):
        spread = ravel_pytree(jax.tree.map(lambda s, p: jnp.broadcast_to(s, jnp.shape(p)), deviation, parameters))[0]
    else:
        spread = jnp.broadcast_to(jnp.asarray(deviation), flat.shape)
    return flat, unravel, spread.astype(flat.dtype), jax.random.normal(key, (pairs, flat.size), flat.dtype)


def _both_signs(function: Callable[[Array], Any], flat: Array, spread: Array, noise: Array) -> Any:
    """The function at ``x + s w`` and ``x - s w``, leaves (pair, 2, ...)."""
    points = flat + spread * jnp.stack([noise, -noise], axis=1)
    found = jax.vmap(function)(points.reshape(-1, flat.size))
    return jax.tree.map(lambda x: x.reshape(-1, 2, *x.shape[1:]), found)


def _first(loss: Loss, flat: Array, unravel: Any, spread: Array, noise: Array) -> _Samples:
    losses, gradients = _both_signs(jax.value_and_grad(lambda x: loss(unravel(x))), flat, spread, noise)
    return _Samples(gradients.mean(1), losses.mean(1))


def _zeroth(loss: Loss, flat: Array, unravel: Any, spread: Array, noise: Array) -> _Samples:
    losses = _both_signs(lambda x: loss(unravel(x)), flat, spread, noise)
    difference = (losses[:, 0] - losses[:, 1])[:, None]
    return _Samples(difference * noise / (2.0 * spread), losses.mean(1))


def _squared_error(gradients: Array) -> Array:
    """Squared standard error of the mean over the pairs, sum over the entries."""
    return jnp.sum(gradients.var(0, ddof=1)) / len(gradients)


def _estimate(samples: _Samples, unravel: Any, share: float) -> Estimate:
    return Estimate(
        unravel(samples.gradients.mean(0)),
        jnp.sqrt(_squared_error(samples.gradients)),
        samples.losses.mean(),
        jnp.asarray(share, samples.losses.dtype),
    )
