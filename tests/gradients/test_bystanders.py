"""The closed-form gradients once more (C1, C6, C8, C9, C11), beside a resting contact and a pair that never touches."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Plane, SceneBuilder, Sphere, rollout
from tests.gradients.bystanders import add_bystanders
from tests.gradients.test_bounce_gradient import (
    LIMIT,
    RADIUS,
    SEVERAL_BOUNCES,
    UNDER_GRAVITY,
    G,
    check,
    parameters_of,
    value_and_slopes,
)
from tests.gradients.test_collision_impulse import check_struck_rod
from tests.gradients.test_slide_gradient import derivatives
from tests.gradients.test_stick_slip import COUNT, THRESHOLD, push_with_slopes
from tests.scenes import DOWN, GRAVITY, undamped


def crowded(shape, gravity=DOWN, friction=0.5, restitution=0.0, dt=1 / 240, **body):
    """Body 0: the plane y = 0. Body 1: `shape`, 1 kg. Then the bystanders."""
    builder = SceneBuilder(gravity=gravity)
    surface = {"friction": friction, "restitution": restitution}
    builder.add_body(Plane((0, 1, 0)), static=True, **surface)
    builder.add_body(shape, mass=1.0, **surface, **body)
    add_bystanders(builder, **surface)
    return builder.build(undamped(dt=dt))


def bounce(height, velocity, restitution, gravity, time, count=240):
    model, state = crowded(Sphere(RADIUS), restitution=0.8, position=(0.0, 1.0, 0.0))
    parameters = parameters_of(height=height, velocity=velocity, restitution=restitution, gravity=gravity, time=time)
    return value_and_slopes(parameters, model, state, count)


@pytest.mark.slow
def test_one_bounce(precision, gate):
    value, slopes = bounce(1.0, -2.0, 1.0, 0.0, 1.0)
    gate("C1a: height / truth - 1", value / 1.2 - 1, 1e-3)
    check(gate, slopes, {"height": -1.0, "velocity": -1.0, "restitution": 1.1, "radius": 2.0}, LIMIT[str(precision)])
    value, slopes = bounce(1.0, 0.0, 0.8, G, 0.8)
    gate("C1b: height / truth - 1", value / 0.671884928 - 1, 1e-3)
    check(gate, slopes, UNDER_GRAVITY, LIMIT[str(precision)])


@pytest.mark.slow
def test_several_bounces(precision, gate):
    """All in one program: steps of 1/240 s for the longest."""
    for bounces, time, height, by_restitution, by_drop in SEVERAL_BOUNCES:
        value, slopes = bounce(1.0 + RADIUS, 0.0, 0.8, G, time, count=552)
        gate(f"C8: N={bounces}: gap / truth - 1", (value - RADIUS) / height - 1, 1e-2)
        check(gate, slopes, {"restitution": by_restitution, "height": by_drop}, 1e-2)


@pytest.mark.slow  # boxes in reverse mode compile for half a minute
def test_slide_to_rest(precision, gate):
    speed, friction = 2.0, 0.4
    model, state = crowded(Box((0.2, 0.05, 0.2)), friction=friction, position=(0.0, 0.05, 0.0))
    values = {"speed": speed, "friction": friction, "mass": 1.0, "gravity": GRAVITY}
    parameters = {name: jnp.asarray(value) for name, value in values.items()}
    slopes, _ = derivatives(parameters, model, state, 180)
    distance = speed**2 / (2 * friction * GRAVITY)
    truth = {"speed": 2 * distance / speed, "friction": -distance / friction, "gravity": -distance / GRAVITY}
    for name, value in truth.items():
        gate(f"C6: d x / d {name} / truth - 1", slopes[name] / value - 1, 0.01)
    gate("C6: d x / d mass", slopes["mass"], {"float32": 1e-5, "float64": 1e-6}[str(precision)])


@pytest.mark.slow
def test_stick_and_slip(precision, gate):
    model, state = crowded(Box((0.2, 0.05, 0.2)), friction=0.4, position=(0.0, 0.05, 0.0), dt=1 / COUNT)
    factors = np.array([0.5, 0.99, 1.0, 1.01, 6.0 / THRESHOLD])
    force = jnp.asarray(factors * THRESHOLD)
    velocity, (by_force, by_friction) = push_with_slopes(force, jnp.asarray(0.4), model, state)
    assert np.isfinite(by_force).all() and np.isfinite(by_friction).all()
    sticks, slips = factors < 1, factors > 1
    gate("C11 sticking: dv/dF", by_force[sticks], 1e-3)
    gate("C11 slipping: dv/dF - 1", by_force[slips] - 1.0, LIMIT[str(precision)])
    gate("C11 slipping: dv/dmu / truth - 1", by_friction[slips] / -GRAVITY - 1.0, LIMIT[str(precision)])
    gate("C11: v - 2.076 m/s", velocity[-1] - 2.076, 1e-2)


@pytest.mark.slow
def test_head_on_collision(precision, gate):
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"restitution": 0.7, "friction": 0.0}
    builder.add_body(Plane((0, 1, 0)), static=True, **surface)
    builder.add_body(Sphere(0.1), mass=1.0, position=(0.0, 1.0, 0.0), velocity=(2.0, 0.0, 0.0), **surface)
    builder.add_body(Sphere(0.1), mass=3.0, position=(0.5, 1.0, 0.0), **surface)
    add_bystanders(builder, **surface)
    model, state = builder.build(undamped(dt=1 / 240))

    def velocity_after(p):
        masses = model.mass.at[1].set(p["m1"]).at[2].set(p["m2"])
        changed = dataclasses.replace(model, mass=masses, restitution=jnp.full_like(model.restitution, p["e"]))
        moving = dataclasses.replace(state, velocity=state.velocity.at[1, 0].set(p["v"]))
        return rollout(changed, moving, 60)[0].velocity[2, 0]

    parameters = {name: jnp.asarray(value) for name, value in {"m1": 1.0, "m2": 3.0, "e": 0.7, "v": 2.0}.items()}
    value, slopes = jax.jit(jax.value_and_grad(velocity_after))(parameters)
    limit = {"float32": 1e-4, "float64": 1e-6}[str(precision)]
    gate("C9: velocity / truth - 1", value / 0.85 - 1, limit)
    for name, truth in {"m1": 0.6375, "m2": -0.2125, "e": 0.5, "v": 0.425}.items():
        gate(f"C9: d v2 / d {name} / truth - 1", slopes[name] / truth - 1, limit)


@pytest.mark.slow
def test_rod_struck_off_centre(precision, gate):
    check_struck_rod(gate, str(precision), 5.0, lambda builder, surface: add_bystanders(builder, **surface))
