"""Norms and quotients whose value and derivatives stay finite at the singular point.

Every function replaces its singular argument *before* the singular operation (the "double where"), because a
`where` after it would still multiply an infinite derivative by zero and return NaN. Arguments so small that the
derivative of the operation would overflow count as zero.
"""

import jax
import jax.numpy as jnp
from jax import Array


def safe_sqrt(squared: Array) -> Array:
    """Square root with derivative 0 (not infinity) at 0. Elementwise, any shape."""
    positive = squared > jnp.finfo(squared.dtype).tiny
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


@jax.custom_jvp
def safe_divide(numerator: Array, denominator: Array) -> Array:
    """Quotient that is 0, with derivative 0, where the denominator is 0. Elementwise, broadcasting."""
    return _quotient(numerator, denominator)


@safe_divide.defjvp
def _safe_divide_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    # By the quotient, not by the square of the denominator: energies of bodies of a millimetre would underflow.
    quotient = safe_divide(*primals)
    return quotient, _quotient(tangents[0] - quotient * tangents[1], primals[1])


def _quotient(numerator: Array, denominator: Array) -> Array:
    nonzero = jnp.abs(denominator) > jnp.finfo(denominator.dtype).tiny
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1.0), 0.0)
