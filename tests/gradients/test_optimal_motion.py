"""Optima found by gradients through impacts: a throw at ground and wall (C2), a ball driven at another (C3)."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from mathota_jax import Plane, SceneBuilder, Sphere, apply_force, rollout, step
from tests.gradients.bystanders import add_bystanders
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import undamped

LIMIT = {"float32": 1e-2, "float64": 1e-3}
PRECISIONS = pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)


# ---- C2: ground, then wall ---------------------------------------------------------------------------------------

BODY, DURATION, BOUNCE = 2, 0.6, 0.92


def ground_and_wall():
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"restitution": BOUNCE, "friction": 0.0}
    builder.add_body(Plane((0, 1, 0)), static=True, **surface)
    builder.add_body(Plane((-1, 0, 0), -1.75), static=True, **surface)
    builder.add_body(Sphere(0.1), mass=1.0, position=(-0.5, 1.0, 0.0), **surface)
    add_bystanders(builder, **surface)
    return builder.build(undamped(dt=DURATION / 288))


def distance_to_target(velocity, model, state, count):
    """Squared distance of the end of the throw from (-2, 1.5)."""
    model = dataclasses.replace(model, dt=jnp.full_like(model.dt, DURATION / count))
    state = dataclasses.replace(state, velocity=state.velocity.at[BODY, :2].set(velocity))
    end = rollout(model, state, count)[0].position[BODY]
    return (end[0] + 2.0) ** 2 + (end[1] - 1.5) ** 2


@functools.partial(jax.jit, static_argnames="count")
def throw(velocity, model, state, count):
    return jax.value_and_grad(distance_to_target)(velocity, model, state, count)


@functools.partial(jax.jit, static_argnames=("count", "iterations"))
def best_throw(velocity, model, state, count, iterations):
    def descend(velocity, _):
        loss, slope = jax.value_and_grad(distance_to_target)(velocity, model, state, count)
        return velocity - slope, loss

    return jax.lax.scan(descend, velocity, None, length=iterations)


@pytest.mark.slow
def test_slope_of_a_throw(precision, gate):
    model, state = ground_and_wall()
    loss, slope = throw(jnp.array([5.0, -5.0]), model, state, 288)
    gate("C2: loss / truth - 1", loss / 8.508448 - 1, LIMIT[str(precision)])
    gate("C2: slope / truth - 1", slope / np.array([-3.166272, -0.587328]) - 1, LIMIT[str(precision)])


@PRECISIONS
def test_best_throw(precision, gate):
    """Steepest descent through two impacts; schemes without the time of impact walk away from the wall."""
    model, state = ground_and_wall()
    velocity, losses = best_throw(jnp.array([5.0, -5.0]), model, state, 96, 60)
    gate("C2: loss", losses[-1], 1e-3)
    truth = np.array([2.15 + 3.65 / BOUNCE, -(0.9 + 1.4 / BOUNCE)]) / DURATION
    np.testing.assert_allclose(truth, [10.1957, -4.0362], atol=1e-4)
    gate("C2: velocity / truth - 1", velocity / truth - 1, 5e-3)


# ---- C3: optimal control of two balls ----------------------------------------------------------------------------

STEPS = 480
FIRST, SECOND = 1, 2


def two_balls():
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"restitution": 1.0, "friction": 0.0}
    builder.add_body(Plane((0, 1, 0), -30.0), static=True, **surface)
    builder.add_body(Sphere(0.2), mass=1.0, position=(-2.0, -2.0, 0.0), **surface)
    builder.add_body(Sphere(0.2), mass=1.0, position=(-1.0, -1.0, 0.0), **surface)
    builder.add_body(Sphere(0.1), mass=1.0, position=(0.0, -29.9, 20.0), **surface)
    return builder.build(undamped(dt=1 / STEPS))


def end_distance(parameters, model, state):
    """|x2(T)|^2 for forces (step, 2) on the first ball."""
    start = dataclasses.replace(
        state,
        position=state.position.at[FIRST, :2].set(parameters["x1"]).at[SECOND, :2].set(parameters["x2"]),
        velocity=state.velocity.at[FIRST, :2].set(parameters["v1"]),
    )

    def advance(current, force):
        pushed = apply_force(current, FIRST, jnp.concatenate([force, jnp.zeros(1)]))
        return step(model, pushed), None

    final, _ = jax.lax.scan(advance, start, parameters["force"])
    return jnp.sum(final.position[SECOND] ** 2)


@jax.jit
def end_slopes(parameters, model, state):
    return jax.value_and_grad(end_distance)(parameters, model, state)


@jax.jit
def cost_and_slope(force, parameters, model, state):
    def cost(force):
        running = 0.1 * jnp.sum(force**2) / STEPS
        return end_distance({**parameters, "force": force}, model, state) + running

    return jax.value_and_grad(cost)(force)


def start():
    pairs = {"x1": [-2.0, -2.0], "x2": [-1.0, -1.0], "v1": [0.0, 0.0]}
    return {**{name: jnp.asarray(value) for name, value in pairs.items()}, "force": jnp.full((STEPS, 2), 3.0)}


@pytest.mark.slow
def test_slopes_of_a_driven_collision(precision, gate):
    model, state = two_balls()
    value, slopes = end_slopes(start(), model, state)
    gate("C3: terminal loss / truth - 1", value / 0.259143506 - 1, 1e-2)
    for name, truth in {"x1": -0.398668417, "x2": -0.321253116, "v1": -0.497790658}.items():
        gate(f"C3: d / d {name} / truth - 1", slopes[name] / truth - 1, 1e-2)
    by_force = np.asarray(slopes["force"])
    gate("C3: d / d constant force / truth - 1", by_force.sum(0) / -0.248895329 - 1, 1e-2)
    for k, truth in {0: -1.0362e-3, 100: -8.6317e-4, 300: -5.1710e-4, 331: -4.1562e-4}.items():
        gate(f"C3: d / d force in step {k} / truth - 1", by_force[k] / truth - 1, 1e-2)
    assert not by_force[332:].any()


@PRECISIONS
def test_optimal_control(precision, gate):
    """960 forces by a quasi-Newton method; without the time of impact the loss sticks at 2.0, the optimum is 1.3965."""
    model, state = two_balls()
    parameters = start()
    dtype = parameters["x1"].dtype

    def cost(flat):
        value, slope = cost_and_slope(jnp.asarray(flat.reshape(STEPS, 2), dtype), parameters, model, state)
        return float(value), np.asarray(slope, float).ravel()

    # The unknowns are scaled so that the running cost has curvature 2 in each.
    scale = np.sqrt(STEPS / 0.1)

    def scaled(x):
        value, slope = cost(x * scale)
        return value, slope * scale

    found = minimize(
        scaled, np.full(2 * STEPS, 3.0) / scale, jac=True, method="L-BFGS-B", options={"maxiter": 60, "maxcor": 20}
    )
    gate("C3: optimised loss", found.fun, 1.405)
    gate("C3: optimised loss / optimum - 1", found.fun / 1.3965422 - 1, 5e-3)
