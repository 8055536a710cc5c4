"""`map_filled`: the values of the function where the table is filled, 0 behind, and its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax.spatial.chunk_derivatives import Chunked, tangents
from mathota_jax.spatial.chunks import MOST, map_filled


def repeated_square(rows):
    return {"twice": jnp.repeat(rows["x"] ** 2, 2, axis=0), "sum": rows["x"].sum(-1) + rows["number"]}


def table(count):
    x = np.random.default_rng(count).normal(size=(count, 3))
    return {"x": jnp.asarray(x, jnp.float32), "number": jnp.arange(count, dtype=jnp.float32)}


@pytest.mark.parametrize("count", [1, 5, 13, 17, 45, 66])  # 13 and 17 do not divide into equal chunks of a good size
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_filled_rows_are_exact_and_empty_chunks_are_zero(count, share):
    filled = int(share * count)
    rows = table(count)
    found = jax.jit(lambda rows, n: map_filled(repeated_square, rows, n))(rows, jnp.int32(filled))
    truth = repeated_square(rows)
    assert {name: value.shape for name, value in found.items()} == {n: value.shape for n, value in truth.items()}
    np.testing.assert_array_equal(found["twice"][: 2 * filled], truth["twice"][: 2 * filled])
    np.testing.assert_array_equal(found["sum"][:filled], truth["sum"][:filled])
    behind = -(-filled // MOST) * MOST + MOST
    assert not found["twice"][2 * behind :].any()
    assert not found["sum"][behind:].any()


def test_derivatives_are_those_of_the_filled_rows():
    rows, filled = table(45), 9

    def total(x):
        found = map_filled(repeated_square, {**rows, "x": x}, jnp.int32(filled))
        return found["twice"][: 2 * filled].sum()

    truth = np.zeros((45, 3))
    truth[:filled] = 4 * np.asarray(rows["x"])[:filled]
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(derivative(total))(rows["x"]), truth, rtol=1e-6)


def test_empty_rows_are_not_evaluated():
    """Nothing that an empty chunk would give reaches the result or its derivative."""

    def bad_where_zero(x):
        return jnp.sqrt(x) / x

    x = jnp.concatenate([jnp.ones(9), jnp.zeros(36)])[:, None]
    value, derivative = jax.value_and_grad(lambda x: map_filled(bad_where_zero, x, jnp.int32(9)).sum())(x)
    assert value == 9
    assert np.isfinite(np.asarray(derivative)).all()


def test_what_the_function_closes_over_has_derivatives_too():
    """Numbers and places, in reverse mode through a loop."""
    rows = jnp.arange(12.0)

    def total(weight, places):
        def body(carry, _):
            weight_now, places_now = jnp.cos(carry) * weight, places + 1
            found = map_filled(lambda x: x * weight_now[places_now], rows, jnp.int32(12))
            return carry + found.sum(), None

        return jax.lax.scan(body, jnp.zeros(()), None, length=2)[0]

    def derivative(weight, places):
        _, pull = jax.vjp(jax.jit(lambda weight: total(weight, places)), weight)
        return pull(jnp.ones(()))[0]

    weight, places = jnp.asarray([5.0, 0.02]), jnp.zeros((), jnp.int32)
    s = float(rows.sum())
    # c_1 = s w, c_2 = c_1 + s w cos(c_1)
    inner = 0.02 * s
    expected = s + s * np.cos(inner) - inner * s * np.sin(inner)
    np.testing.assert_allclose(jax.jit(derivative)(weight, places), [0.0, expected], rtol=1e-5)


def heap(x, weight):
    """Sum of w^2 x^3 of the filled rows, of a table with room for many more."""
    return map_filled(lambda rows: {"cube": weight**2 * rows**3, "sign": rows > 0}, x, jnp.int32(3))["cube"][:3].sum()


@pytest.mark.parametrize("wrap", [lambda f: f, jax.checkpoint], ids=["plain", "checkpoint"])
def test_second_derivatives_in_any_order(wrap):
    """Forwards and backwards, one over the other: w^2 6 x, and 6 w x^2 by both."""
    x, weight = jnp.asarray([0.5, -1.0, 2.0] + [3.0] * 30), jnp.asarray(1.5)
    by_x = np.diag(np.where(np.arange(33) < 3, 6 * 1.5**2 * np.asarray(x), 0.0))
    mixed = np.where(np.arange(33) < 3, 6 * 1.5 * np.asarray(x) ** 2, 0.0)
    for outer in (jax.jacfwd, jax.jacrev):
        for inner in (jax.jacfwd, jax.jacrev):
            found = jax.jit(outer(inner(wrap(heap), 0), (0, 1)))(x, weight)
            np.testing.assert_allclose(found[0], by_x, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(found[1], mixed, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("used", [0, 2, 5])
def test_a_sum_over_the_chunks_in_use(used):
    """As JAX differentiates the sum itself, forwards and backwards."""
    rng = np.random.default_rng(0)
    rows, change, weight = (jnp.asarray(rng.normal(size=size)) for size in ((5, 3), (5, 3), ()))

    def truth(rows, weight):
        return jnp.sum(weight * rows[:used] ** 2, axis=0)

    chunked = Chunked(
        lambda weight, row: [weight * row**2], 1, 5, (jax.ShapeDtypeStruct((3,), jnp.float32),), summed=True
    )
    leaves = [weight, rows]
    for way in (chunked.in_loop, chunked.at_once, chunked.one_by_one):
        np.testing.assert_allclose(way(leaves, jnp.int32(used))[0], truth(rows, weight), rtol=1e-6, atol=1e-7)

    def forwards(change, by_weight):
        return tangents(chunked, leaves, jnp.int32(used), [by_weight, change])[0]

    one = jnp.ones(())
    np.testing.assert_allclose(
        forwards(change, one), jax.jvp(truth, (rows, weight), (change, one))[1], rtol=1e-6, atol=1e-7
    )
    cotangent = jnp.asarray([1.0, -2.0, 0.5])
    found = jax.linear_transpose(forwards, change, one)(cotangent)
    for value, expected in zip(found, jax.vjp(truth, rows, weight)[1](cotangent), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-6, atol=1e-7)


def test_derivatives_on_gpus_have_no_loop():
    """All chunks side by side there; lowered for CUDA on any machine."""
    x = jnp.arange(33.0)
    lowered = jax.jit(jax.grad(heap)).trace(x, jnp.asarray(1.5)).lower(lowering_platforms=("cuda",))
    assert "stablehlo.while" not in lowered.as_text()
    assert "stablehlo.while" in jax.jit(jax.grad(heap)).lower(x, jnp.asarray(1.5)).as_text()
