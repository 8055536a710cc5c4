"""`map_filled`: the values of the function where the table is filled, 0 behind, and its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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
