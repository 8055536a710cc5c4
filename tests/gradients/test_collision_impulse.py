"""Derivatives of a collision impulse wrt masses, inertia, arm and restitution (benchmark C9)."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from mathota_jax import Box, Plane, SceneBuilder, Sphere, rollout
from tests.marks import QUICK_IN_FLOAT64
from tests.scenes import undamped

LIMIT = {"float32": 1e-4, "float64": 1e-6}


def head_on():
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"restitution": 0.7, "friction": 0.0}
    builder.add_body(Sphere(0.1), mass=1.0, velocity=(2.0, 0.0, 0.0), **surface)
    builder.add_body(Sphere(0.1), mass=3.0, position=(0.5, 0.0, 0.0), **surface)
    return builder.build(undamped(dt=1 / 240))


def test_head_on_collision(precision, gate):
    model, state = head_on()

    def velocity_after(parameters):
        changed = dataclasses.replace(
            model,
            mass=jnp.stack([parameters["m1"], parameters["m2"]]),
            restitution=jnp.full_like(model.restitution, parameters["e"]),
        )
        moving = dataclasses.replace(state, velocity=state.velocity.at[0, 0].set(parameters["v"]))
        return rollout(changed, moving, 60)[0].velocity[1, 0]

    parameters = {name: jnp.asarray(value) for name, value in {"m1": 1.0, "m2": 3.0, "e": 0.7, "v": 2.0}.items()}
    value, slopes = jax.jit(jax.value_and_grad(velocity_after))(parameters)
    gate("velocity / truth - 1", value / 0.85 - 1, LIMIT[str(precision)])
    for name, truth in {"m1": 0.6375, "m2": -0.2125, "e": 0.5, "v": 0.425}.items():
        gate(f"d v2 / d {name} / truth - 1", slopes[name] / truth - 1, LIMIT[str(precision)])


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_rod_struck_off_centre(precision, gate):
    check_struck_rod(gate, str(precision), 0.0, lambda builder, surface: None)


def check_struck_rod(gate, precision, height, add_others):
    """A 1 kg ball hits a free rod (M = 2, I = 0.5) at 0.3 m from its centre with 3 m/s, e = 0.6; `height` [m] of the rod.

    With a height there is the plane y = 0, and what `add_others(builder, surface)` adds.
    """
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"restitution": 0.6, "friction": 0.0}
    builder.add_body(Sphere(0.05), mass=1.0, position=(0.3, height - 0.4, 0.0), velocity=(0.0, 3.0, 0.0), **surface)
    builder.add_body(Box((1.0, 0.05, 0.05)), mass=2.0, position=(0.0, height, 0.0), **surface)
    if height:
        builder.add_body(Plane((0, 1, 0)), static=True, **surface)
        add_others(builder, surface)
    model, state = builder.build(undamped(dt=1 / 240))

    def spin_after(parameters):
        changed = dataclasses.replace(
            model,
            mass=model.mass.at[0].set(parameters["m"]).at[1].set(parameters["M"]),
            inertia=model.inertia.at[1].set(jnp.array([1.0, 1.0, 1.0]) * parameters["I"]),
        )
        moved = dataclasses.replace(state, position=state.position.at[0, 0].set(parameters["d"]))
        return rollout(changed, moved, 36)[0].angular_velocity[1, 2]

    parameters = {name: jnp.asarray(value) for name, value in {"m": 1.0, "M": 2.0, "I": 0.5, "d": 0.3}.items()}
    value, slopes = jax.jit(jax.value_and_grad(spin_after))(parameters)
    m, big, inertia, arm, speed, e = 1.0, 2.0, 0.5, 0.3, 3.0, 0.6
    truth_value = (1 + e) * speed * arm / inertia / (1 / m + 1 / big + arm**2 / inertia)
    gate("spin / truth - 1", value / truth_value - 1, LIMIT[precision])
    gate("spin against the benchmark", value / 1.714286 - 1, max(LIMIT[precision], 1e-6))
    for name, truth in {"I": -3.061224, "M": 0.255102, "d": 4.489796, "m": 1.020408}.items():
        gate(f"d omega / d {name} / truth - 1", slopes[name] / truth - 1, max(LIMIT[precision], 2e-6))
