"""`batch_last` on toy functions whose truth is `jax.vmap` of plain natural-shaped code, and NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax.batching import batch_last

SEEN: list[tuple[tuple[int, ...], ...]] = []


def natural(arguments, scale):
    """matrix (2, 3), vector (3,), scale () -> products (2,), a scalar (), and something of the scale alone ()."""
    matrix, vector = arguments["matrix"], arguments["vector"]
    product = matrix @ vector * jnp.sin(scale)
    length = jnp.sqrt(1.0 + vector @ vector)
    return {"product": product, "nested": (length * scale, scale**3)}


def worlds_last(arguments, scale):
    """The same for matrix (2, 3, W), vector (3, W), scale (W,)."""
    matrix, vector = arguments["matrix"], arguments["vector"]
    SEEN.append((matrix.shape, vector.shape, scale.shape))
    product = jnp.sum(matrix * vector[None], axis=1) * jnp.sin(scale)
    length = jnp.sqrt(1.0 + jnp.sum(vector * vector, axis=0))
    return {"product": product, "nested": (length * scale, scale**3)}


def draw(*batch, seed=0):
    rng = np.random.default_rng(seed)
    arguments = {"matrix": rng.normal(size=(*batch, 2, 3)), "vector": rng.normal(size=(*batch, 3))}
    return jax.tree.map(jnp.asarray, (arguments, rng.normal(size=batch)))


def loss(function):
    def scalar(arguments, scale):
        result = function(arguments, scale)
        return jnp.sum(result["product"] ** 2) + result["nested"][0] * result["nested"][1]

    return scalar


def assert_same(measured, truth, rtol=1e-11):
    assert jax.tree.structure(measured) == jax.tree.structure(truth)
    for a, b in zip(jax.tree.leaves(measured), jax.tree.leaves(truth), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=rtol, atol=1e-11)


def summed(function, over=jax.vmap):
    return lambda *arguments: jnp.sum(over(function)(*arguments))


def scanned(function):
    """Feeds the vector back three times, as a rollout does."""

    def run(arguments, scale):
        def body(vector, _):
            result = function({"matrix": arguments["matrix"], "vector": vector}, scale)
            return jnp.tanh(vector + result["nested"][0]), result["product"]

        return jax.lax.scan(body, arguments["vector"], None, length=3)

    return run


def scan_of_vmap(function):
    def run(arguments, scale):
        def body(vector, _):
            result = jax.vmap(function)({"matrix": arguments["matrix"], "vector": vector}, scale)
            return jnp.tanh(vector + result["nested"][0][:, None]), result["product"]

        return jax.lax.scan(body, arguments["vector"], None, length=3)

    return run


def last_vector_sum(runner):
    return lambda *arguments: jnp.sum(runner(*arguments)[0] ** 2)


ONE_AXIS = {
    "vmap": jax.vmap,
    "jit(vmap)": lambda f: jax.jit(jax.vmap(f)),
    "vmap(jit)": lambda f: jax.vmap(jax.jit(f)),
    "grad(vmap)": lambda f: jax.grad(summed(loss(f)), argnums=(0, 1)),
    "vmap(grad)": lambda f: jax.vmap(jax.grad(loss(f), argnums=(0, 1))),
    "vmap(value_and_grad)": lambda f: jax.vmap(jax.value_and_grad(loss(f))),
    "vmap(jacfwd)": lambda f: jax.vmap(jax.jacfwd(f, argnums=(0, 1))),
    "vmap(jacrev)": lambda f: jax.vmap(jax.jacrev(f, argnums=(0, 1))),
    "jacfwd(vmap)": lambda f: jax.jacfwd(jax.vmap(f)),
    "jacrev(vmap)": lambda f: jax.jacrev(jax.vmap(f), argnums=1),
    "vmap(hessian)": lambda f: jax.vmap(jax.hessian(loss(f), argnums=(0, 1))),
    "vmap(jacrev(jacrev))": lambda f: jax.vmap(jax.jacrev(jax.jacrev(loss(f)), argnums=1)),
    "grad(vmap(grad))": lambda f: jax.grad(lambda a, s: jnp.sum(jax.vmap(jax.grad(loss(f), argnums=1))(a, s) ** 2)),
    "vmap(jvp)": lambda f: jax.vmap(lambda a, s: jax.jvp(f, (a, s), (jax.tree.map(jnp.cos, a), jnp.cos(s)))),
    "jvp of one argument": lambda f: jax.vmap(lambda a, s: jax.jvp(lambda x: f(a, x), (s,), (jnp.ones_like(s),))),
    "vmap(linearize)": lambda f: jax.vmap(lambda a, s: jax.linearize(f, a, s)[1](a, s)),
    "vmap(checkpoint)": lambda f: jax.vmap(jax.grad(jax.checkpoint(loss(f)))),
    "grad(checkpoint(vmap))": lambda f: jax.grad(jax.checkpoint(summed(loss(f)))),
    "vmap(scan)": lambda f: jax.vmap(scanned(f)),
    "scan(vmap)": scan_of_vmap,
    "vmap(grad(scan))": lambda f: jax.vmap(jax.grad(last_vector_sum(scanned(f)))),
    "grad(scan(vmap))": lambda f: jax.grad(last_vector_sum(scan_of_vmap(f))),
    "vmap(jacfwd(scan))": lambda f: jax.vmap(jax.jacfwd(scanned(f))),
    "out_axes": lambda f: jax.vmap(f, out_axes={"product": 1, "nested": (0, -1)}),
    "unmapped matrix": lambda f: (
        lambda a, s: jax.vmap(f, in_axes=({"matrix": None, "vector": 0}, 0))(
            {"matrix": a["matrix"][0], "vector": a["vector"]}, s
        )
    ),
    "unmapped scale": lambda f: lambda a, s: jax.vmap(f, in_axes=(0, None))(a, s[0]),
    "grad wrt the unmapped": lambda f: (
        lambda a, s: jax.grad(lambda shared: jnp.sum(jax.vmap(loss(f), in_axes=(0, None))(a, shared)))(s[0])
    ),
    "axis in the middle": lambda f: (
        lambda a, s: jax.vmap(f, in_axes=({"matrix": 1, "vector": -1}, 0))(
            {"matrix": jnp.moveaxis(a["matrix"], 0, 1), "vector": a["vector"].T}, s
        )
    ),
}


@pytest.mark.parametrize("name", ONE_AXIS)
def test_every_transformation_equals_plain_code(float64, name):
    transform, arguments = ONE_AXIS[name], draw(5)
    measured, truth = jax.jit(transform(batch_last(worlds_last))), jax.jit(transform(natural))
    assert_same(measured(*arguments), truth(*arguments))


@pytest.mark.parametrize("name", ["vmap", "grad(vmap)", "vmap(jacfwd)", "scan(vmap)", "unmapped matrix"])
def test_it_works_outside_jit(float64, name):
    transform, arguments = ONE_AXIS[name], draw(5)
    assert_same(transform(batch_last(worlds_last))(*arguments), jax.jit(transform(natural))(*arguments))


TWO_AXES = {
    "vmap(vmap)": lambda f: jax.vmap(jax.vmap(f)),
    "vmap(vmap), inner unmapped scale": lambda f: lambda a, s: jax.vmap(jax.vmap(f, in_axes=(0, None)))(a, s[:, 0]),
    "vmap(vmap), outer unmapped matrix": lambda f: (
        lambda a, s: jax.vmap(jax.vmap(f), in_axes=({"matrix": None, "vector": 0}, 0))(
            {"matrix": a["matrix"][0], "vector": a["vector"]}, s
        )
    ),
    "outer product of worlds": lambda f: (
        lambda a, s: jax.vmap(jax.vmap(f, in_axes=(None, 0)), in_axes=(0, None))(
            jax.tree.map(lambda leaf: leaf[:, 0], a), s[0]
        )
    ),
    "vmap(grad(vmap))": lambda f: jax.vmap(jax.grad(summed(loss(f)))),
    "grad(vmap(vmap))": lambda f: jax.grad(lambda a, s: jnp.sum(jax.vmap(jax.vmap(loss(f)))(a, s)), argnums=(0, 1)),
    "vmap(vmap(hessian))": lambda f: jax.vmap(jax.vmap(jax.hessian(loss(f)))),
    "vmap(scan(vmap))": lambda f: jax.vmap(scan_of_vmap(f)),
}


@pytest.mark.parametrize("name", TWO_AXES)
def test_nested_maps_equal_plain_code(float64, name):
    transform, arguments = TWO_AXES[name], draw(4, 3)
    measured, truth = jax.jit(transform(batch_last(worlds_last))), jax.jit(transform(natural))
    assert_same(measured(*arguments), truth(*arguments))


def test_values_against_numpy(float64):
    arguments, scale = draw(6)
    result = jax.vmap(batch_last(worlds_last))(arguments, scale)
    for world in range(6):
        matrix, vector = np.asarray(arguments["matrix"][world]), np.asarray(arguments["vector"][world])
        np.testing.assert_allclose(result["product"][world], matrix @ vector * np.sin(scale[world]), rtol=1e-12)
        np.testing.assert_allclose(result["nested"][1][world], float(scale[world]) ** 3, rtol=1e-12)


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda f: f(*draw()), ((2, 3, 1), (3, 1), (1,))),
        (lambda f: jax.vmap(f)(*draw(5)), ((2, 3, 5), (3, 5), (5,))),
        (lambda f: jax.vmap(f, in_axes=({"matrix": None, "vector": 0}, 0))(
            {"matrix": draw()[0]["matrix"], "vector": draw(5)[0]["vector"]}, draw(5)[1]), ((2, 3, 1), (3, 5), (5,))),
        (lambda f: jax.vmap(jax.vmap(f))(*draw(4, 3)), ((2, 3, 12), (3, 12), (12,))),
    ],
    ids=["no map", "map", "shared argument is not copied", "two maps merge"],
)  # fmt: skip
def test_layout_that_the_function_sees(float64, call, expected):
    def fresh(arguments, scale):  # a new function: nothing is cached
        return worlds_last(arguments, scale)

    SEEN.clear()
    jax.block_until_ready(call(batch_last(fresh)))
    assert expected in SEEN


def test_integers_and_booleans_pass_through(float64):
    def function(x, index, condition):
        return jnp.where(condition, x * 2.0, x), index + 1, condition & (index > 0)

    wrapped = batch_last(function)
    x, index, condition = jnp.arange(4.0), jnp.arange(4), jnp.array([True, False, True, False])
    doubled, following, both = jax.vmap(wrapped)(x, index, condition)
    np.testing.assert_array_equal(doubled, [0.0, 1.0, 4.0, 3.0])
    np.testing.assert_array_equal(following, [1, 2, 3, 4])
    np.testing.assert_array_equal(both, [False, False, True, False])
    assert following.dtype == index.dtype and both.dtype == bool
    slope = jax.vmap(jax.grad(lambda *a: wrapped(*a)[0]))(x, index, condition)
    np.testing.assert_array_equal(slope, [2.0, 1.0, 2.0, 1.0])


def test_empty_tree_and_empty_batch(float64):
    wrapped = batch_last(lambda x, nothing: x + 1.0)
    assert jax.vmap(wrapped, in_axes=(0, None))(jnp.zeros((0, 3)), None).shape == (0, 3)
    np.testing.assert_array_equal(wrapped(jnp.zeros(3), {}), np.ones(3))


@pytest.mark.parametrize(
    ("program", "traces"),
    [(lambda f: jax.vmap(f), 1), (lambda f: jax.grad(lambda x: jnp.sum(jax.vmap(f)(x) ** 2)), 1)],
    ids=["value", "gradient"],
)
def test_one_trace_serves_shapes_lowering_and_derivatives(program, traces):
    count = 0

    def function(x):
        nonlocal count
        count += 1
        return {"result": jnp.sin(x)}

    jax.jit(program(lambda x: batch_last(function)(x)["result"])).lower(jnp.ones(3)).compile()
    assert count == traces


def test_another_precision_is_another_trace():
    wrapped = batch_last(lambda x: (x * 2, jnp.arange(3)[:, None] + jnp.zeros(x.shape[-1:], int)))
    for wide, precision, whole in (
        (False, "float32", "int32"),
        (True, "float64", "int64"),
        (True, "float32", "int32"),
        (False, "float32", "int32"),
    ):
        with jax.enable_x64(wide):
            value, numbers = jax.vmap(wrapped)(np.ones(3, precision))
            assert value.dtype == precision and numbers.dtype == whole


def test_one_trace_serves_many_calls():
    count = 0

    def function(x):
        nonlocal count
        count += 1
        return x * 2

    compiled = jax.jit(jax.vmap(batch_last(function)))
    for value in range(5):
        compiled(jnp.full(3, float(value)))
    traced = count
    for value in range(5):
        compiled(jnp.full(3, float(value)))
    assert traced == count
