"""Slopes of the laws of impulses against automatic differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax.solver.laws import Bounded, Cone
from mathota_jax.solver.slopes import slopes_of

TURNS, COLUMNS, WORLDS = 2, 3, 200


def law_of(kind, random):
    def between(low, high, *row):
        return jnp.asarray(random.uniform(low, high, (TURNS, *row, COLUMNS, WORLDS)))

    if kind == "cone":
        return Cone(between(0.5, 1.5), between(0.5, 1.5), between(0.2, 0.8), jnp.ones((TURNS, COLUMNS, WORLDS)))
    one = jnp.ones((TURNS, 1, COLUMNS, WORLDS))
    return Bounded(between(0.5, 1.5, 1), between(0.0, 0.5, 1), -one, one)


@pytest.mark.parametrize("kind", ["cone", "bounded"])
def test_slopes_are_those_of_the_law(float64, kind):
    random = np.random.default_rng(0)
    law = law_of(kind, random)
    shape = (TURNS, 3 if kind == "cone" else 1, COLUMNS, WORLDS)
    impulse, error, d_impulse, d_error, cotangent = (jnp.asarray(random.normal(size=shape)) for _ in range(5))
    impulse, error = (x.at[..., :5].set(0.0) for x in (impulse, error))  # at the apex of the cone
    slopes = slopes_of(law, impulse, error)
    _, truth = jax.jvp(law.update, (impulse, error), (d_impulse, d_error))
    np.testing.assert_allclose(slopes.update(d_impulse, d_error), truth, atol=1e-14)
    of_turn = jax.tree.map(lambda x: x[1], slopes)
    np.testing.assert_allclose(of_turn.update(d_impulse[1], d_error[1]), truth[1], atol=1e-14)
    _, pull = jax.vjp(law.update, impulse, error)
    for found, expected in zip(slopes.transposed(cotangent), pull(cotangent), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-14)
