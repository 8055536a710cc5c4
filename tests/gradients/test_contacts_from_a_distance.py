"""Derivatives that feel contacts from a distance: the values of `step`, and a way to the hit where there was none."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Plane, SceneBuilder, Sphere, step
from mathota_jax.gradients import long_rollout, smoothed_step
from tests.marks import QUICK_IN_FLOAT64
from tests.scenes import undamped

RADIUS, SPEED, RESTITUTION = 0.1, 2.0, 0.5
DT = 1 / 120


def ball_and_target(height):
    """A ball flies along x; a target of three times its mass rests at the origin. Without gravity."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"restitution": RESTITUTION, "friction": 0.0}
    builder.add_body(Sphere(RADIUS), mass=1.0, position=(-1.0, height, 0.0), velocity=(SPEED, 0, 0), **surface)
    builder.add_body(Sphere(RADIUS), mass=3.0, **surface)
    return builder.build(undamped(dt=DT))


@functools.partial(jax.jit, static_argnames="reach")
def target_speed(height, model, state, reach):
    """Velocity of the target along x after 0.75 s, and its slope by the height of the ball."""

    def speed(height):
        start = dataclasses.replace(state, position=state.position.at[0, 1].set(height))
        stepper = step if reach is None else functools.partial(smoothed_step, reach=reach)
        return long_rollout(model, start, 90, stepper=stepper)[0].velocity[1, 0]

    return jax.value_and_grad(speed)(height)


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_a_miss_has_a_useful_gradient(precision):
    """The hard slope is 0 where the ball misses; the smoothed one leads from the miss to a hit in the middle, whose exact
    speed after it is (1 + e) v / 4."""
    model, state = ball_and_target(0.3)
    value, slope = target_speed(0.3, model, state, None)
    assert value == 0.0 and slope == 0.0
    height = jnp.asarray(0.3)
    values = []
    for _ in range(60):
        value, slope = target_speed(height, model, state, 0.05)
        assert np.isfinite(slope)
        values.append(float(value))
        height = height + 0.02 * slope / jnp.maximum(jnp.abs(slope), 0.1)
    assert values[0] == 0.0
    assert values[-1] == pytest.approx((1 + RESTITUTION) * SPEED / 4, rel=0.05)


@pytest.mark.parametrize("height", [0.0, 0.1, 0.3])
def test_values_are_those_of_the_step_bitwise(precision, height):
    model, state = ball_and_target(height)

    @functools.partial(jax.jit, static_argnames="stepper")
    def run(state, stepper):
        return long_rollout(model, state, 90, stepper=stepper)[0]

    hard, smooth = run(state, step), run(state, functools.partial(smoothed_step, reach=0.05))
    jax.tree.map(np.testing.assert_array_equal, hard, smooth)


def test_derivative_of_a_single_step(float64, gate):
    """What one step adds is exactly a tenth of the force (1 + e) m v^2 w(gap / reach) / reach on both bodies."""
    model, state = ball_and_target(0.0)
    reach = 0.3
    speeds = jax.jit(jax.jacfwd(lambda x: moved(x, model, state, reach)))(-1.0)
    gap = (1.0 - 2 * RADIUS) / reach
    mass = 1.0 * 3.0 / 4.0
    slope = (gap - gap**2 / 2) * np.exp(-gap) / reach  # d w / d gap; the gap shrinks as x grows
    by_place = -0.1 * (1 + RESTITUTION) * mass * SPEED**2 / reach * slope
    gate("d v1 / d x", speeds[0] + by_place / 1.0 * DT, 1e-12)
    gate("d v2 / d x", speeds[1] - by_place / 3.0 * DT, 1e-12)


def moved(x, model, state, reach):
    start = dataclasses.replace(state, position=state.position.at[0, 0].set(x))
    return smoothed_step(model, start, reach=reach).velocity[:, 0]


@functools.partial(jax.jit, static_argnames="stepper")
def head_on_slopes(start, model, state, stepper):
    def end(start):
        moving = dataclasses.replace(
            state,
            position=state.position.at[0, 0].set(start["x"]),
            velocity=state.velocity.at[0, 0].set(start["v"]),
        )
        final = long_rollout(model, moving, 90, stepper=stepper)[0]
        return jnp.stack([final.position[0, 0], final.velocity[0, 0]])

    return jax.jacfwd(end)(start)


def test_the_bias_of_a_hit_is_in_proportion_to_the_strength(float64, gate):
    """v1' = c v with c = (m1 - e m2) / (m1 + m2), and x1' = x_hit + c (v T - (x_hit - x))."""
    model, state = ball_and_target(0.0)
    c = (1.0 - RESTITUTION * 3.0) / 4.0
    truth = {"x": np.array([c, 0.0]), "v": np.array([c * 0.75, c])}
    start = {"x": jnp.asarray(-1.0), "v": jnp.asarray(SPEED)}
    bias = {}
    for strength in (0.01, 0.1):
        stepper = functools.partial(smoothed_step, reach=0.1, strength=strength)
        slopes = head_on_slopes(start, model, state, stepper)
        bias[strength] = np.concatenate([slopes[name] - truth[name] for name in truth])
        gate(f"strength {strength}: bias / strength", bias[strength] / strength, 1.0)
    assert np.abs(bias[0.1]).max() > 5 * np.abs(bias[0.01]).max()


def test_nothing_is_added_at_rest_or_without_contacts(float64):
    """A ball at rest has the derivatives of `step`; and in a scene without pairs the step itself is traced."""
    builder = SceneBuilder(gravity=(0, -9.81, 0))
    builder.add_body(Plane((0, 1, 0)), static=True)
    builder.add_body(Sphere(0.1), mass=1.0, position=(0, 0.1, 0))
    model, state = builder.build(undamped(dt=DT))

    @functools.partial(jax.jit, static_argnames="stepper")
    def jacobian(velocity, stepper):
        def end(velocity):
            return stepper(model, dataclasses.replace(state, velocity=velocity)).velocity

        return jax.jacrev(end)(velocity)

    hard = jacobian(state.velocity, step)
    np.testing.assert_array_equal(jacobian(state.velocity, functools.partial(smoothed_step, reach=0.1)), hard)

    alone = SceneBuilder()
    alone.add_body(Sphere(0.1), mass=1.0)
    model, state = alone.build()
    assert str(jax.make_jaxpr(step)(model, state)) == str(
        jax.make_jaxpr(functools.partial(smoothed_step, reach=0.1))(model, state)
    )


def test_bad_reach_and_strength():
    model, state = ball_and_target(0.0)
    with pytest.raises(ValueError, match="strength must be positive"):
        smoothed_step(model, state, reach=0.1, strength=0.0)
    with pytest.raises(ValueError, match="reach must be a positive length"):
        smoothed_step(model, state, reach=0.0)
