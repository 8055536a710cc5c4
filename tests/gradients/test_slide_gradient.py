"""Derivatives of sliding to rest against the closed form (benchmark C6)."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Plane, SceneBuilder, rollout
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import DOWN, GRAVITY, slab_on_plane, undamped

SPEED, FRICTION = 2.0, 0.4
DT = 1 / 240
LIMIT = {"float32": 0.01, "float64": 0.01}


@functools.partial(jax.jit, static_argnames="count")
def end_of_slide(parameters, model, state, count):
    """Final position and velocity along the slide as a function of speed, friction, mass and gravity."""
    model = dataclasses.replace(
        model,
        friction=jnp.full_like(model.friction, parameters["friction"]),
        mass=model.mass.at[1].set(parameters["mass"]),
        inertia=model.inertia.at[1].multiply(parameters["mass"]),
        gravity=jnp.array([0.0, -1.0, 0.0]) * parameters["gravity"],
    )
    state = dataclasses.replace(state, velocity=state.velocity.at[1, 0].set(parameters["speed"]))
    final, _ = rollout(model, state, count)
    return final.position[1, 0], final.velocity[1, 0]


@functools.partial(jax.jit, static_argnames="count")
def derivatives(parameters, model, state, count):
    return jax.jacrev(end_of_slide)(parameters, model, state, count)


def slide(time):
    model, state = slab_on_plane(friction=FRICTION, options=undamped(dt=DT))
    parameters = {"speed": SPEED, "friction": FRICTION, "mass": 1.0, "gravity": GRAVITY}
    parameters = {name: jnp.asarray(value) for name, value in parameters.items()}
    count = round(time / DT)
    return end_of_slide(parameters, model, state, count), derivatives(parameters, model, state, count)


def check(gate, what, measured, truth, limit, scale=None):
    for name, value in truth.items():
        size = abs(value) if value else (scale or {}).get(name, 1.0)
        gate(f"d {what} / d {name} against {value:.6g}", (float(measured[name]) - value) / size, limit)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_while_sliding(precision, gate):
    (_, speed), (position_slopes, velocity_slopes) = slide(time := 0.25)
    gate("speed [m/s]", speed - (SPEED - FRICTION * GRAVITY * time), 1e-3)
    half = 0.5 * time**2
    truth = {"speed": time, "friction": -GRAVITY * half, "gravity": -FRICTION * half}
    assert truth["friction"] == pytest.approx(-0.3065625)
    check(gate, "x", position_slopes, truth, LIMIT[str(precision)])
    truth = {"speed": 1.0, "friction": -GRAVITY * time, "gravity": -FRICTION * time}
    check(gate, "v", velocity_slopes, truth, LIMIT[str(precision)])
    gate("d x / d mass", position_slopes["mass"], {"float32": 1e-5, "float64": 1e-6}[str(precision)])
    gate("d v / d mass", velocity_slopes["mass"], {"float32": 1e-5, "float64": 1e-6}[str(precision)])


@pytest.mark.slow
def test_after_stopping(precision, gate):
    (position, speed), (position_slopes, velocity_slopes) = slide(0.75)
    distance = SPEED**2 / (2 * FRICTION * GRAVITY)
    gate("distance / truth - 1", position / distance - 1, 0.01)
    gate("speed at rest [m/s]", speed, 1e-4)
    truth = {
        "speed": SPEED / (FRICTION * GRAVITY),
        "friction": -distance / FRICTION,
        "gravity": -distance / GRAVITY,
    }
    np.testing.assert_allclose(list(truth.values()), [0.509684, -1.274210, -0.051956], atol=1e-6)
    check(gate, "x", position_slopes, truth, LIMIT[str(precision)])
    gate("d x / d mass", position_slopes["mass"], {"float32": 1e-5, "float64": 1e-6}[str(precision)])
    for name, value in velocity_slopes.items():
        gate(f"d v / d {name} at rest", value, 1e-3)


@pytest.mark.slow
def test_forward_mode_equals_reverse_mode(float64):
    model, state = slab_on_plane(friction=FRICTION, options=undamped(dt=DT))
    parameters = {"speed": SPEED, "friction": FRICTION, "mass": 1.0, "gravity": GRAVITY}
    parameters = {name: jnp.asarray(value) for name, value in parameters.items()}
    forward = jax.jit(jax.jacfwd(functools.partial(end_of_slide, count=60)))(parameters, model, state)
    reverse = derivatives(parameters, model, state, 60)
    for a, b in zip(jax.tree.leaves(forward), jax.tree.leaves(reverse), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10)


@pytest.mark.slow
def test_a_spinning_box_that_just_touches(float64, gate):
    """`converged`: how fast a sliding box still spins, by its mass at a given inertia, against central differences."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.4)
    builder.add_body(
        Box((0.2, 0.1, 0.15)),
        mass=1.0,
        position=(0, 0.1, 0),
        velocity=(2.0, 0, 0),
        angular_velocity=(0, 1.0, 0),
        friction=0.4,
    )
    model, state = builder.build(undamped(dt=1 / 240, solver="converged"))

    def spin(mass):
        return rollout(dataclasses.replace(model, mass=model.mass.at[1].set(mass)), state, 20)[0].angular_velocity[1, 1]

    value = jax.jit(spin)
    truth = (value(1.0 + 1e-5) - value(1.0 - 1e-5)) / 2e-5
    gate("derivative / difference quotient - 1", jax.jit(jax.grad(spin))(1.0) / truth - 1.0, 1e-5)
