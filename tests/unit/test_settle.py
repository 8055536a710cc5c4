"""One computation for one decision; what is stored in reverse mode, and what is not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from mathota_jax.bodies import Inertia
from mathota_jax.dynamics.free_motion import PARTS, rotate_at_constant_momentum
from mathota_jax.spatial.quaternion import Quaternion, to_matrix
from mathota_jax.spatial.running_sum import running_sum
from mathota_jax.spatial.settle import compute_once, materialize, settle, store, store_cotangents
from mathota_jax.spatial.vector import Vec3


def product(matrix, vector):
    """A product whose factor and result both have cotangents that are computed once."""
    return jnp.sin(store_cotangents(matrix @ store_cotangents(jnp.cos(vector))))


def arguments():
    random = np.random.default_rng(0)
    return jnp.asarray(random.normal(size=(4, 3))), jnp.asarray(random.normal(size=(3, 5)))


def disagreement(cure, precision):
    """Share of the comparisons of a product with its own rounded value that two outputs of one program take differently."""
    x, y = np.random.default_rng(0).uniform(1.0, 2.0, size=(2, 4096)).astype(precision)

    @jax.jit
    def outputs(x, y, rounded, zero):
        xy = x * y
        decision = cure(jnp.where(xy - rounded - zero > 0, 1.0, 0.0).astype(precision))
        # The second kernel needs the product itself, and so does not contract it with the difference.
        return jnp.where(decision > 0.5, x, -x), jnp.where(decision > 0.5, xy, -xy)

    first, second = outputs(x, y, x * y, np.zeros_like(x))
    return np.mean(np.sign(first) != np.sign(second))


def test_a_decision_falls_one_way_in_all_kernels(precision):
    if disagreement(lambda decision: decision, precision) < 0.1:
        pytest.skip("here no product is contracted with a sum: the cure has nothing to cure")
    assert disagreement(settle, precision) == 0


def test_values_and_derivatives_of_any_order_are_unchanged(float64):
    matrix, vector = arguments()
    np.testing.assert_array_equal(product(matrix, vector), jnp.sin(matrix @ jnp.cos(vector)))
    check_grads(product, (matrix, vector), order=2, rtol=1e-6)
    check_grads(jax.vmap(product, in_axes=(None, 1)), (matrix, vector), order=1, rtol=1e-6)


def test_what_is_stored_keeps_its_type():
    like, kinds = jnp.ones(3), (jnp.float32, jnp.int32, jnp.bool_)
    values = [jnp.asarray([0, 1, 2]).astype(kind) for kind in kinds]
    for value, found in zip(values, jax.jit(lambda v: compute_once(v, like))(values), strict=True):
        assert found.dtype == value.dtype
        np.testing.assert_array_equal(found, value)
    with pytest.raises(TypeError, match="of numbers, got bool"):
        store(values[2], values[2])


def test_integers_are_stored_as_they_are():
    odd = jnp.array([0, 1, -1, 2**31 - 1, -(2**31), 2**24 + 1])
    np.testing.assert_array_equal(jax.jit(lambda x: store(x, x))(odd), odd)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 45, 351])
def test_running_sums(count):
    """Also beyond what float32 counts exactly."""
    entries = np.random.default_rng(0).integers(-3, 2**22, (count, 5)).astype(np.int32)
    found = jax.jit(running_sum)(entries)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, np.cumsum(entries, axis=0, dtype=np.int32))


def test_any_number_is_stored_as_it_is(precision):
    odd = jnp.array([0.0, -0.0, 1.5, jnp.inf, -jnp.inf, jnp.nan, 1e-45, 3e38], precision)
    found = jax.jit(lambda x: store(x, x))(odd)
    assert np.asarray(found).tobytes() == np.asarray(odd).tobytes()


def test_on_gpus_barriers_hold_what_divisions_do_not():
    """XLA copies divisions there, and has no barriers any more when it fuses for CPUs: seen in the programs of both."""

    def text(platform):
        traced = jax.jit(lambda x: settle(x) + materialize([x, x + 1])[1]).trace(jnp.ones(3))
        return traced.lower(lowering_platforms=(platform,)).as_text()

    assert text("cuda").count("optimization_barrier") == 2 and "divide" not in text("cuda")
    assert "optimization_barrier" not in text("cpu") and "divide" in text("cpu") and "case" in text("cpu")


def test_the_value_itself_costs_nothing():
    matrix, vector = arguments()
    assert "divide" not in jax.jit(product).lower(matrix, vector).as_text()
    assert "divide" in jax.jit(jax.grad(lambda v: product(matrix, v).sum())).lower(vector).as_text()


def test_parts_of_fast_turns_are_not_stored():
    """A step of all bodies in one part must not carry `PARTS` intermediate poses to its reverse pass."""
    one, zero = jnp.ones((2, 3)), jnp.zeros((2, 3))
    orientation = Quaternion(one, zero, zero, zero)
    inertia = Inertia(one, Vec3(one, 2.0 * one, 3.0 * one), to_matrix(orientation))

    def turned(momentum):
        return rotate_at_constant_momentum(orientation, inertia, Vec3(momentum, momentum, zero), jnp.asarray(0.01))[1].x

    program = jax.make_jaxpr(lambda m: jax.vjp(turned, m)[1](m))(one)
    outer = [variable.aval.shape for equation in program.eqns for variable in equation.outvars]
    assert (2, 3) in outer
    assert not [shape for shape in outer if shape[:1] == (PARTS,)]
