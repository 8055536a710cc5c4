"""`spread` and `add_slices` against the ordinary broadcast and sum, and their transposes against each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from mathota_jax.spatial.spread import (
    FEW_SLICES,
    add_all_slices,
    add_scaled,
    add_slices,
    greatest,
    largest_slice,
    least,
    repeat_worlds,
    spread,
)


def product(matrix, vector):
    batch, columns, worlds = vector.shape
    return add_slices(matrix * spread(vector.reshape(batch, 1, columns, worlds), matrix.shape), 2)


def arguments():
    rng = np.random.default_rng(0)
    return jnp.asarray(rng.normal(size=(2, 3, 4, 5))), jnp.asarray(rng.normal(size=(2, 4, 5)))


def test_values_and_derivatives_are_those_of_einsum(float64):
    matrix, vector = arguments()
    np.testing.assert_allclose(product(matrix, vector), jnp.einsum("brcw,bcw->brw", matrix, vector), rtol=1e-14)
    check_grads(product, (matrix, vector), order=2, rtol=1e-8)


def test_under_vmap(float64):
    matrix, vector = arguments()
    mapped = jax.vmap(product, in_axes=(-1, -1), out_axes=-1)(matrix[..., None, :], vector[..., None, :])
    np.testing.assert_allclose(mapped[..., 0, :], product(matrix, vector), rtol=1e-14)


def test_worlds_are_left_alone():
    assert spread(jnp.zeros((1, 1)), (3, 7)).shape == (3, 1)


def test_transposes_have_no_reduction(float64):
    matrix, vector = arguments()
    cotangents = str(jax.make_jaxpr(lambda m, v, c: jax.vjp(product, m, v)[1](c))(matrix, vector, jnp.ones((2, 3, 5))))
    assert "reduce_sum" not in cotangents
    assert "add_slices" in cotangents


@pytest.mark.parametrize("shape", [(1, 1, 5), (2, 3, 4, 5), (FEW_SLICES, 2, 5), (3, FEW_SLICES + 1, 5)], ids=str)
def test_sum_and_maximum_over_all_but_the_worlds(float64, shape):
    values = jnp.asarray(np.random.default_rng(0).normal(size=shape))
    every_axis = tuple(range(len(shape) - 1))
    np.testing.assert_allclose(add_all_slices(values), np.asarray(values).sum(every_axis), rtol=1e-13)
    np.testing.assert_array_equal(largest_slice(values), np.asarray(values).max(every_axis))


@pytest.mark.parametrize("count", [1, 7, FEW_SLICES + 1])
def test_extremes_along_the_leading_axis(float64, count):
    values = np.random.default_rng(1).normal(size=(count, 2, 5))
    np.testing.assert_array_equal(greatest(jnp.asarray(values)), values.max(0))
    np.testing.assert_array_equal(least(jnp.asarray(values)), values.min(0))


@pytest.mark.parametrize("count", [1, 4, FEW_SLICES + 1])
@pytest.mark.parametrize("shared", [False, True])
def test_sum_of_scaled_values(float64, count, shared):
    rng = np.random.default_rng(2)
    values, factors = rng.normal(size=(3, 2, count, 1 if shared else 5)), rng.normal(size=(count, 5))
    truth = np.einsum("abnw,nw->abw", np.broadcast_to(values, (3, 2, count, 5)), factors)
    np.testing.assert_allclose(add_scaled(jnp.asarray(values), jnp.asarray(factors)), truth, rtol=1e-13, atol=1e-13)
    if not shared:
        check_grads(add_scaled, (values, factors), order=1, rtol=1e-8)


def test_repeated_worlds(float64):
    own, of_all = np.random.default_rng(3).normal(size=(3, 2, 5)), np.ones((3, 1))
    found = repeat_worlds((jnp.asarray(own), jnp.asarray(of_all)), 4, 5)
    np.testing.assert_array_equal(found[0], np.tile(own, 4))
    assert found[1].shape == (3, 1)
    check_grads(lambda x: repeat_worlds(x, 4, 5), (own,), order=1, rtol=1e-8)
