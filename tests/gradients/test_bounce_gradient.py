"""Derivatives through impacts against the closed forms: one bounce (benchmark C1) and several (C8)."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Sphere, apply_force, rollout
from tests.marks import QUICK_IN_FLOAT64
from tests.scenes import body_on_plane, undamped

RADIUS = 0.1
LIMIT = {"float32": 1e-2, "float64": 1e-3}  # general rule 3 of section C
G = 9.81


def ball(gravity=G, restitution=0.8, dt=1 / 240, solver="pgs"):
    return body_on_plane(
        Sphere(RADIUS),
        gravity=(0.0, -gravity, 0.0),
        restitution=restitution,
        friction=0.5,
        position=(0.0, 1.0, 0.0),
        options=undamped(dt=dt, solver=solver),
    )


@functools.partial(jax.jit, static_argnames="count")
def final_height(parameters, model, state, count):
    """Height of the ball's centre after `count` steps as a function of everything that decides it."""
    model = dataclasses.replace(
        model,
        restitution=jnp.full_like(model.restitution, parameters["restitution"]),
        gravity=jnp.array([0.0, -1.0, 0.0]) * parameters["gravity"],
        dt=jnp.full_like(model.dt, parameters["time"] / count),
        shapes={
            **model.shapes,
            "sphere": {"radius": jnp.full_like(model.shapes["sphere"]["radius"], parameters["radius"])},
        },
    )
    state = dataclasses.replace(
        state,
        position=state.position.at[1, 1].set(parameters["height"]),
        velocity=state.velocity.at[1, 1].set(parameters["velocity"]),
    )
    state = apply_force(state, 1, jnp.array([0.0, 1.0, 0.0]) * parameters["first force"], state.position[1])
    final, _ = rollout(model, state, count)
    return final.position[1, 1]


@functools.partial(jax.jit, static_argnames="count")
def value_and_slopes(parameters, model, state, count):
    return jax.value_and_grad(final_height)(parameters, model, state, count)


def parameters_of(**values):
    """Traced parameters of a bounce: the given ones, the radius and a force in the first step."""
    return {name: jnp.asarray(float(value)) for name, value in {**values, "radius": RADIUS, "first force": 0.0}.items()}


def run(*, height, velocity, restitution, gravity, time, dt, solver="pgs"):
    model, state = ball(solver=solver)
    parameters = parameters_of(height=height, velocity=velocity, restitution=restitution, gravity=gravity, time=time)
    value, slopes = value_and_slopes(parameters, model, state, round(time / dt))
    return float(value), {name: float(slope) for name, slope in slopes.items()}


def check(gate, slopes, truth, limit):
    for name, value in truth.items():
        assert np.sign(slopes[name]) == np.sign(value), f"d / d {name}: sign of {slopes[name]}, truth {value}"
        gate(f"d / d {name} against {value:.6g}", slopes[name] / value - 1, limit)


@pytest.mark.parametrize("dt", [1 / 240, 1 / 480])
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_one_bounce_without_gravity(precision, dt, gate):
    value, slopes = run(height=1.0, velocity=-2.0, restitution=1.0, gravity=0.0, time=1.0, dt=dt)
    gate("height / truth - 1", value / 1.2 - 1, 1e-3)
    force_slope = -(1.0 * dt - dt**2 / 2)  # a force in the first step only, mirrored by the impact
    truth = {"height": -1.0, "velocity": -1.0, "restitution": 1.1, "radius": 2.0, "first force": force_slope}
    check(gate, slopes, truth, LIMIT[str(precision)])


UNDER_GRAVITY = {
    "height": 0.761713849,
    "velocity": 0.028964714,
    "restitution": 1.561713849,
    "radius": 0.238286151,
    "gravity": -0.011585885,
    "time": -0.284143841,
}
"""Slopes of the height of the ball 0.8 s after it was dropped from 1 m with restitution 0.8."""


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_one_bounce_under_gravity(precision, dt, gate):
    """Ignoring the time of impact gives d/dy0 = +1.0; correcting the position only gives -0.8; the truth is +0.76."""
    value, slopes = run(height=1.0, velocity=0.0, restitution=0.8, gravity=G, time=0.8, dt=dt)
    gate("height / truth - 1", value / 0.671884928 - 1, 1e-3)
    check(gate, slopes, UNDER_GRAVITY, LIMIT[str(precision)])


SEVERAL_BOUNCES = [
    (1, 0.8, 0.639204, 1.543558, 0.589202),
    (2, 1.5, 0.402862, 2.639013, 0.675556),
    (4, 2.3, 0.119488, -3.195145, -0.999817),
]
"""Bounces, time, gap of a ball dropped by 1 m with restitution 0.8, and the slopes of the gap by restitution and drop."""


@pytest.mark.parametrize(("bounces", "time", "height", "by_restitution", "by_drop"), SEVERAL_BOUNCES)
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_several_bounces(precision, bounces, time, height, by_restitution, by_drop, gate):
    value, slopes = run(height=1.0 + RADIUS, velocity=0.0, restitution=0.8, gravity=G, time=time, dt=1 / 240)
    gate(f"N={bounces}: gap / truth - 1", (value - RADIUS) / height - 1, 1e-2)
    check(gate, slopes, {"restitution": by_restitution, "height": by_drop}, 1e-2)
