"""Quotients near the singular point: value and both modes of derivative against the closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax.spatial.safe import safe_divide


@pytest.mark.parametrize("size", [1.0, 1e-15, 1e-25, 1e-36])
def test_quotient_of_small_numbers(size, gate):
    """Energies of bodies of a millimetre: numerator and denominator are small, the quotient is not."""
    top, bottom = jnp.float32(3 * size), jnp.float32(2 * size)
    gate("value / 1.5 - 1", safe_divide(top, bottom) / 1.5 - 1, 1e-6)
    _, forward = jax.jvp(safe_divide, (top, bottom), (top, -bottom))
    gate("derivative along (top, -bottom) / 3 - 1", forward / 3 - 1, 1e-6)
    reverse = jax.grad(safe_divide, argnums=(0, 1))(top, bottom)
    gate("gradient * size", np.array(reverse) * size / (0.5, -0.75) - 1, 1e-6)


def test_zero_divisor_has_no_derivative():
    for order in (jax.grad, lambda f, **k: jax.grad(jax.grad(f, **k), **k)):
        assert order(safe_divide, argnums=1)(1.0, 0.0) == 0.0
    assert safe_divide(jnp.float32(1.0), jnp.float32(0.0)) == 0.0
