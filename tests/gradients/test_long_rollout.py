"""Rollouts with little memory and bounded gradients: values and derivatives against plain ones and closed forms."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import SceneBuilder, Slider, Sphere, rollout
from mathota_jax.gradients import clip_cotangent, long_rollout
from tests.marks import QUICK_IN_FLOAT64, slow_but
from tests.scenes import body_on_plane, undamped

DT, STEPS = 1 / 60, 25


def sliding_mass():
    """A mass of 2 kg on a rail, pushed by a motor of one newton a unit."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    rail = builder.add_body(Sphere(0.1), static=True, collides=False)
    cart = builder.add_body(Sphere(0.1), mass=2.0, collides=False)
    builder.add_motor(
        builder.add_joint(Slider(parent=rail, child=cart, anchor=(0, 0, 0), axis=(1, 0, 0))), kind="torque", limit=10.0
    )
    return builder.build(undamped(dt=DT))


def bouncing_ball():
    return body_on_plane(Sphere(0.1), restitution=0.8, position=(0.0, 0.3, 0.0), options=undamped(dt=DT))


def height(state):
    return state.position[1, 1]


@functools.partial(jax.jit, static_argnames=("options", "plain"))
def slopes(model, state, options=(), plain=False):
    """Values and gradients of the mean of all heights and the last one."""

    def loss(model, state):
        if plain:
            final, trajectory = rollout(model, state, STEPS)
            heights = trajectory.position[:, 1, 1]
        else:
            final, heights = long_rollout(model, state, STEPS, observe=height, **dict(options))
        return heights.mean() + final.position[1, 1]

    return jax.value_and_grad(loss, argnums=(0, 1), allow_int=True)(model, state)


def assert_close(a, b, tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if x.dtype != jax.dtypes.float0:
            np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("segment", slow_but((7,), (None, 7, 100)))
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_same_values_and_gradients_as_rollout(precision, segment):
    """25 steps in five segments of five, in three of seven and a rest of four, in one."""
    model, state = bouncing_ball()
    value, gradient = slopes(model, state, options=(("segment", segment),))
    expected, truth = slopes(model, state, plain=True)
    tolerance = {"float32": 2e-5, "float64": 1e-12}[str(precision)]
    assert_close(value, expected, tolerance)
    assert_close(gradient, truth, tolerance)


@pytest.mark.slow
def test_memory_grows_with_the_root_of_the_steps():
    model, state = bouncing_ball()

    def memory(run, count):
        gradient = jax.jit(jax.grad(lambda s: run(model, s, count)[0].position[1, 1], allow_int=True))
        return gradient.lower(state).compile().memory_analysis().temp_size_in_bytes

    plain = [memory(rollout, count) for count in (400, 1600)]
    kept = [memory(long_rollout, count) for count in (400, 1600)]
    # The two differ by the states kept: 1200 against 40.
    assert plain[1] - plain[0] > 15 * (kept[1] - kept[0])


def free_body():
    builder = SceneBuilder(gravity=(-2.0, 0, 0))
    builder.add_body(Sphere(0.1), mass=2.0, velocity=(3.0, 0, 0))
    return builder.build(undamped(dt=DT))


def end(gravity, state, model, **options):
    changed = dataclasses.replace(model, gravity=model.gravity.at[0].set(gravity))
    return long_rollout(changed, state, STEPS, **options)[0].position[0, 0]


@pytest.mark.parametrize(("window", "steps"), [(None, 25), (25, 25), (10, 5), (4, 1)])
def test_truncation_cuts_the_gradient_at_windows(float64, window, steps):
    """x_N of free fall by gravity: t^2 / 2, t being the time since the state was last cut off."""
    model, state = free_body()
    slope = jax.jit(jax.grad(functools.partial(end, model=model, window=window)))(-2.0, state)
    assert slope == pytest.approx((steps * DT) ** 2 / 2, rel=1e-9)


@pytest.mark.parametrize(("bound", "worlds"), [(0.5, 1), (1.05, 3)])
def test_clipping_bounds_the_cotangent_of_each_step(float64, bound, worlds):
    """The cotangent of place and speed of a free body k steps back is (1, k dt), beside it that of a force in the step:
    longer than the bound it is scaled down at every step, in its direction, in each world by itself."""
    model, state = free_body()
    gradient = jax.grad(functools.partial(end, model=model, largest_norm=bound), argnums=1, allow_int=True)
    states = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], worlds, axis=0), state)
    by_state = jax.jit(jax.vmap(gradient, (None, 0)))(-2.0, states)
    cotangent = np.array([1.0, 0.0])
    for _ in range(STEPS):
        by_force = (DT**2 / 2 * cotangent[0] + DT * cotangent[1]) / 2.0
        cotangent = np.array([cotangent[0], cotangent[1] + DT * cotangent[0]])
        cotangent *= min(1.0, bound / np.linalg.norm([*cotangent, by_force]))
    for world in range(worlds):
        found = [by_state.position[world, 0, 0], by_state.velocity[world, 0, 0]]
        np.testing.assert_allclose(found, cotangent, rtol=1e-9)


def test_actions_are_passed_on(float64):
    model, state = sliding_mass()
    actions = jnp.sin(jnp.arange(STEPS))[:, None]
    final, places = long_rollout(model, state, actions, observe=lambda s: s.position[1, 0])
    _, trajectory = rollout(model, state, actions)
    np.testing.assert_allclose(places, trajectory.position[:, 1, 0], rtol=1e-12)
    assert abs(final.position[1, 0]) > 1e-3


def test_clipping_is_the_identity_below_the_bound_and_for_each_world(float64):
    def loss(x, bound):
        y = clip_cotangent({"a": x, "count": jnp.array(3)}, bound)
        return jnp.sum(y["a"] * jnp.array([3.0, 4.0])) * y["count"]

    x = jnp.ones(2)
    np.testing.assert_array_equal(clip_cotangent(x, 1.0), x)
    np.testing.assert_allclose(jax.grad(loss)(x, 15.1), [9.0, 12.0])
    np.testing.assert_allclose(jax.grad(loss)(x, 5.0), [3.0, 4.0])
    scaled = jax.vmap(jax.grad(lambda x, factor: factor * loss(x, 5.0)), (None, 0))(x, jnp.array([0.1, 1.0, 1e300]))
    np.testing.assert_allclose(scaled, [[0.9, 1.2], [3.0, 4.0], [3.0, 4.0]])


def test_cotangents_that_are_not_finite_are_not_hidden():
    gradient = jax.grad(lambda x: jnp.sum(clip_cotangent(x, 1.0) * jnp.array([jnp.nan, 1.0])))(jnp.ones(2))
    assert np.isnan(gradient).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"actions": -1}, "number of steps must be an integer of at least 0"),
        ({"actions": np.zeros((3, 2))}, r"actions must have shape \(steps, 1\)"),
        ({"actions": 3, "segment": 0}, "segment must be a whole number of at least 1 step, got 0"),
        ({"actions": 3, "segment": 2.5}, "segment must be a whole number of at least 1 step, got 2.5"),
        ({"actions": 3, "window": 0}, "window must be a whole number of at least 1 step, got 0"),
        ({"actions": 3, "largest_norm": 0.0}, "largest_norm must be positive"),
    ],
)
def test_bad_arguments(arguments, message):
    model, state = sliding_mass()
    with pytest.raises(ValueError, match=message):
        long_rollout(model, state, **arguments)


def test_no_steps():
    model, state = bouncing_ball()
    final, heights = long_rollout(model, state, 0, observe=height)
    np.testing.assert_array_equal(final.position, state.position)
    assert heights.shape == (0,)
