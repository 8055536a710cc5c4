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
from jax import Array
from jax.core import Tracer
from jax.flatten_util import ravel_pytree

Loss = Callable[[Any], Array]


class Estimate(NamedTuple):
    """Estimated gradient of an expected loss.

    Attributes:
      gradient: pytree like the parameters.
      standard_error: () standard error of the estimate: Euclidean norm over its entries.
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

    Args:
      loss: as for `first_order`.
      parameters: likewise.
      key: likewise.
      deviation: likewise.
      pairs: likewise.
      tolerance: bias allowed, in standard errors of the zeroth order.

    Raises:
      ValueError: as `first_order`, or a negative tolerance.
    """
    if not tolerance >= 0:
        raise ValueError(f"mixed_order: tolerance must be at least 0, got {tolerance!r}")
    flat, unravel, spread, noise = _perturbations("mixed_order", parameters, key, deviation, pairs)
    first = _first(loss, flat, unravel, spread, noise)
    zeroth = _zeroth(loss, flat, unravel, spread, noise)
    # In units of the deviations the entries can be compared and their variances added.
    error_first, error_zeroth = (_standard_error(samples.gradients * spread) for samples in (first, zeroth))
    gap = jnp.linalg.norm((first.gradients - zeroth.gradients).mean(0) * spread)
    total = error_first**2 + error_zeroth**2
    least_variance = jnp.where(total > 0, error_zeroth**2 / jnp.where(total > 0, total, 1.0), 1.0)
    bound = tolerance * error_zeroth / jnp.where(gap > 0, gap, 1.0)
    share = jax.lax.stop_gradient(jnp.where(gap > 0, jnp.minimum(least_variance, bound), least_variance))
    mixed = share * first.gradients + (1 - share) * zeroth.gradients
    return _estimate(_Samples(mixed, first.losses), unravel, share)


def _perturbations(
    name: str, parameters: Any, key: Array, deviation: Any, pairs: int
) -> tuple[Array, Callable[[Array], Any], Array, Array]:
    """Flat parameters, their inverse, deviations (entry,) and standard normal noise (pair, entry)."""
    if isinstance(pairs, bool) or not isinstance(pairs, int) or pairs < 2:
        raise ValueError(f"{name}: pairs must be an integer of at least 2, got {pairs!r}")
    # Leaf by leaf: flattening makes floats of integers beside floats, and unravelling integers of what is added to them.
    for leaf in jax.tree.leaves(parameters):
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(f"{name}: the parameters must be floats, got {jnp.result_type(leaf)}")
    flat, unravel = ravel_pytree(parameters)
    if jax.tree.structure(deviation) == jax.tree.structure(parameters):
        spread = ravel_pytree(jax.tree.map(lambda s, p: jnp.broadcast_to(s, jnp.shape(p)), deviation, parameters))[0]
    else:
        spread = jnp.broadcast_to(jnp.asarray(deviation), flat.shape)
    if not isinstance(spread, Tracer) and not bool((spread > 0).all()):
        raise ValueError(f"{name}: every deviation must be positive, got {deviation!r}")
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


def _standard_error(gradients: Array) -> Array:
    """Of the mean over the pairs, norm over the entries."""
    return jnp.sqrt(jnp.sum(gradients.var(0, ddof=1)) / len(gradients))


def _estimate(samples: _Samples, unravel: Any, share: Array | float) -> Estimate:
    return Estimate(
        unravel(samples.gradients.mean(0)),
        _standard_error(samples.gradients),
        samples.losses.mean(),
        jnp.asarray(share, samples.losses.dtype),
    )
