"""How a spring and damper act over a step so that a lone coordinate moves as the exact oscillator does.

The coordinate q with rate u and inertia 1/K obeys ``u' = K f - delta u / dt - kappa q / dt^2``, where delta and kappa are
damping and stiffness times K dt and K dt^2. Over a step the impulse is ``-k dt q_start - (r u_end + w u_start) / K`` while
q moves by ``dt (u_start + u_end) / 2``. The first term makes the rest under a constant force exact. The two weights r and
w make the eigenvalues of the step those of the exact motion, ``exp(x)`` for the roots x of ``x^2 + delta x + kappa``; with
``G = (1 - e^x1) (1 - e^x2) / kappa`` and ``D = e^(x1 + x2)`` they are ``r = 1 / G - 1``, ``w = 1 - D / G + kappa / 2``.
This is the exponentially fitted method (W. Liniger and R. Willoughby, SIAM J. Numer. Anal. 7, 1970) for both roots.

A coordinate that is coupled to others has another inertia than the row alone sees. To leading order the weights do not
depend on K: then the frequency still is of fourth order, and the damping of second. An oscillation by more than
`FASTEST` a step is not resolved: it is slowed to that and damped the more the faster it is, so that a spring of any
stiffness comes to rest at its place; without this, half a turn a step would be unstable.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from mathota_jax.spatial.safe import safe_sqrt
from mathota_jax.spatial.settle import compute_once

FASTEST = 1.0
"""Largest phase of an undamped oscillation in one step [rad]: six steps a period."""

SERIES = 0.25
"""Below this size of the roots the power series is exact to round-off."""


def oscillator_weights(stiffness: Array, damping: Array) -> tuple[Array, Array]:
    """Weights r and w of the rate at the end and at the start of a step; arguments kappa and delta, at least 0."""
    small = (damping < SERIES) & (stiffness < SERIES * SERIES)
    direct, decay = _direct(jnp.where(small, 1.0, stiffness), jnp.where(small, 1.0, damping))
    series = _series(jnp.where(small, stiffness, 0.0), jnp.where(small, damping, 0.0))
    log_g, log_d = jnp.where(small, series, direct), jnp.where(small, -damping, decay)
    log_g, log_d = compute_once((log_g, log_d), log_g)
    return jnp.expm1(-log_g), 0.5 * stiffness - jnp.expm1(log_d - log_g)


def _series(stiffness: Array, damping: Array) -> Array:
    """Log G as the sum over both roots of ``log((e^x - 1) / x) = x/2 + x^2/24 - x^4/2880 + x^6/181440 - ...``."""
    second = damping * damping - 2.0 * stiffness  # sums of powers of the roots
    squared = stiffness * stiffness
    fourth = second * second - 2.0 * squared
    sixth = second * (second * second - 3.0 * squared)
    eighth = fourth * fourth - 2.0 * squared * squared
    return -0.5 * damping + second / 24.0 - fourth / 2880.0 + sixth / 181440.0 - eighth / 9676800.0


def _direct(stiffness: Array, damping: Array) -> tuple[Array, Array]:
    """Log G and log D where the roots are not small."""
    half = 0.5 * damping
    discriminant = half * half - stiffness
    overdamped = discriminant > 0.01
    # Two real roots: G is the product of (1 - e^-x) / x over both.
    root = safe_sqrt(jnp.where(overdamped, discriminant, 1.0))
    fast = half + root
    slow = stiffness / fast
    real = _log_mean_decay(fast) + _log_mean_decay(slow)
    # Complex or nearly equal roots: G kappa = (1 - e^p)^2 + 2 e^p (1 - cos omega), where 1 - cos is smooth in omega^2.
    squared = jnp.where(overdamped, 0.0, -discriminant)
    far = squared > 0.01
    phase = safe_sqrt(jnp.where(far, squared, 1.0))
    excess = jnp.where(far, jnp.maximum(phase - FASTEST, 0.0), 0.0)
    sine = jnp.sin(0.5 * jnp.minimum(phase, FASTEST))
    near = jnp.where(far, 0.0, squared)
    one_less_cosine = near * (0.5 - near * (1.0 / 24.0 - near * (1.0 / 720.0 - near / 40320.0)))
    one_less_cosine = jnp.where(far, 2.0 * sine * sine, one_less_cosine)
    power = -half - excess
    decayed = jnp.expm1(power)
    numerator = decayed * decayed + 2.0 * jnp.exp(power) * one_less_cosine
    complex_roots = jnp.log(jnp.where(overdamped, 1.0, numerator / jnp.where(overdamped, 1.0, stiffness)))
    return jnp.where(overdamped, real, complex_roots), jnp.where(overdamped, -damping, 2.0 * power)


def _log_mean_decay(x: Array) -> Array:
    """``log((1 - e^-x) / x)`` for x >= 0."""
    small = x < 1e-3
    safe = jnp.where(small, 1.0, x)
    return jnp.where(small, x * (x / 24.0 - 0.5), jnp.log(-jnp.expm1(-safe) / safe))


def end_weight(decay: Array) -> Array:
    """Weight of the velocity at the end of a step, against that at its start, in the mean that viscous damping acts on.

    With ``theta = 1 / (1 - exp(-decay)) - 1 / decay`` a lone coordinate under a constant force moves exactly as
    ``u' = f - c u`` says: this is r / delta above without a spring. The weight lies between 1/2 (second order for small
    steps) and 1 (stable for large ones).
    """
    small = decay < 0.1  # there the quotients cancel and the series is exact to round-off
    squared = decay * decay
    series = 0.5 + decay * (1.0 / 12.0 - squared * (1.0 / 720.0 - squared / 30240.0))
    usual = jnp.where(small, 1.0, decay)
    return jnp.where(small, series, -1.0 / jnp.expm1(-usual) - 1.0 / usual)
