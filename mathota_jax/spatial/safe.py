"""Norms and quotients whose value and derivatives stay finite at the singular point.

Every function replaces its singular argument *before* the singular operation (the "double where"), because a
`where` after it would still multiply an infinite derivative by zero and return NaN. Arguments so small that the
derivative of the operation would overflow count as zero.
"""

import jax.numpy as jnp
from jax import Array


def safe_sqrt(squared: Array) -> Array:
    """Square root with derivative 0 (not infinity) at 0. Elementwise, any shape."""
    positive = squared > jnp.finfo(squared.dtype).tiny
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


def safe_divide(numerator: Array, denominator: Array) -> Array:
    """Quotient that is 0, with derivative 0, where the denominator is 0. Elementwise, broadcasting."""
    # The derivative divides by the square of the denominator, which must not underflow.
    nonzero = jnp.abs(denominator) > jnp.sqrt(jnp.finfo(denominator.dtype).tiny)
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1.0), 0.0)
