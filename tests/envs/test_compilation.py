"""Programs compiled sooner: the same results, with options that XLA knows, and without those that it does not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_envs import compilation
from mathota_envs.compilation import compiled_sooner


def hypotenuse(scale, x, y):
    return scale * jnp.sqrt(x * x + y * y)


def test_the_options_are_known_to_this_version():
    assert compilation._known_options() == dict(compilation.SOONER)


@pytest.mark.parametrize("options", [compilation.SOONER, {"xla_no_such_option": True}])
def test_results_are_the_same(options, monkeypatch):
    monkeypatch.setattr(compilation, "SOONER", options)
    x, y = np.random.default_rng(0).normal(size=(2, 100)).astype(np.float32)
    function = compiled_sooner(hypotenuse)
    for scale in (1, 2):
        np.testing.assert_allclose(function(scale, x, y), hypotenuse(scale, x, y), rtol=1e-6)


def test_errors_of_the_function_are_its_own():
    def fails(_, x):
        raise jax.errors.JaxRuntimeError(f"of the function, {x.shape}")

    with pytest.raises(jax.errors.JaxRuntimeError, match=r"of the function, \(2,\)"):
        compiled_sooner(fails)(0, jnp.ones(2))
