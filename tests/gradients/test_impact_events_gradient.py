"""Derivatives through steps that split at impacts: exact at any time step (benchmarks C1b, C5 and C8)."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Plane, SceneBuilder, Sphere, rollout
from tests.gradients.test_bounce_gradient import UNDER_GRAVITY, G
from tests.physics.test_billiards import two_balls
from tests.scenes import body_on_plane, undamped

OBLIQUE = {"y": 0.0, "vx": 2.0, "vy": 0.0, "radius": 0.2, "restitution": 0.9, "m1": 1.0, "m2": 2.0}
BY_Y2 = {
    "y": -1.072471,
    "vx": 0.274241,
    "vy": -0.243887,
    "radius": -0.597471,
    "restitution": 0.194338,
    "m1": 0.246161,
    "m2": -0.123080,
}
"""Slopes of the height of the second ball after 1 s (benchmark C5)."""
BY_X2 = {"y": 2.406057, "vx": 0.475, "vy": 0.970908, "radius": 3.228782, "m1": 0.426363}
BY_Y1 = {"y": 3.144943, "vy": 1.487775, "radius": 1.194943}


@functools.partial(jax.jit, static_argnames="count")
def oblique_slopes(parameters, model, state, count):
    def final(p):
        radius = model.shapes["sphere"]["radius"].at[:2].set(p["radius"])
        masses = jnp.stack([p["m1"], p["m2"]])
        sized = dataclasses.replace(
            model,
            mass=model.mass.at[:2].set(masses),
            inertia=model.inertia.at[:2].set(0.4 * masses[:, None] * p["radius"] ** 2 * jnp.ones((2, 3))),
            restitution=jnp.full_like(model.restitution, p["restitution"]),
            shapes={**model.shapes, "sphere": {"radius": radius}},
            dt=jnp.full_like(model.dt, 1.0 / count),
        )
        start = dataclasses.replace(
            state,
            position=state.position.at[0, 1].set(p["y"]),
            velocity=state.velocity.at[0].set(jnp.stack([p["vx"], p["vy"], 0.0 * p["vx"]])),
        )
        return rollout(sized, start, count)[0].position

    return jax.jacfwd(final)(parameters)


@pytest.mark.parametrize("count", [1, pytest.param(60, marks=pytest.mark.slow)])
def test_oblique_collision(float64, count, gate):
    model, state = two_balls()
    slopes = oblique_slopes({k: jnp.asarray(v) for k, v in OBLIQUE.items()}, model, state, count)
    for (body, axis), truth in {(1, 1): BY_Y2, (1, 0): BY_X2, (0, 1): BY_Y1}.items():
        for name, value in truth.items():
            gate(f"d position[{body}, {axis}] / d {name}", float(slopes[name][body, axis]) - value, 2e-6)


@pytest.mark.slow
def test_oblique_collision_beside_others(precision, gate):
    """With a sphere that touches a plane, and pairs that never meet."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"restitution": 0.9, "friction": 0.0}
    builder.add_body(Sphere(0.2), mass=1.0, velocity=(2.0, 0.0, 0.0), **surface)
    builder.add_body(Sphere(0.2), mass=2.0, position=(1.0, 0.2, 0.0), **surface)
    builder.add_body(Plane((0, 1, 0), -30.0), static=True, **surface)
    builder.add_body(Sphere(0.1), mass=1.0, position=(0.0, -29.9, 20.0), **surface)
    model, state = builder.build(undamped(impact_events=1))
    slopes = oblique_slopes({k: jnp.asarray(v) for k, v in OBLIQUE.items()}, model, state, 1)
    limit = {"float32": 1e-2, "float64": 1e-3}[str(precision)]
    for (body, axis), truth in {(1, 1): BY_Y2, (1, 0): BY_X2, (0, 1): BY_Y1}.items():
        for name, value in truth.items():
            gate(
                f"d position[{body}, {axis}] / d {name} / truth - 1", float(slopes[name][body, axis]) / value - 1, limit
            )


@functools.partial(jax.jit, static_argnames="count")
def heights(parameters, model, state, time, count):
    """Value and slopes of the height of a dropped ball after `time`; parameters as in `test_bounce_gradient`."""

    def final(p):
        changed = dataclasses.replace(
            model,
            restitution=jnp.full_like(model.restitution, p["restitution"]),
            gravity=jnp.array([0.0, -1.0, 0.0]) * p["gravity"],
            dt=jnp.full_like(model.dt, time / count),
            shapes={**model.shapes, "sphere": {"radius": jnp.full_like(model.shapes["sphere"]["radius"], p["radius"])}},
        )
        start = dataclasses.replace(
            state,
            position=state.position.at[1, 1].set(p["height"]),
            velocity=state.velocity.at[1, 1].set(p["velocity"]),
        )
        return rollout(changed, start, count)[0].position[1, 1]

    return jax.value_and_grad(final)(parameters)


def truth(p, time, bounces):
    """Height after `bounces` bounces, in closed form."""
    fall = jnp.sqrt(p["velocity"] ** 2 + 2 * p["gravity"] * (p["height"] - p["radius"]))
    time = time - (fall + p["velocity"]) / p["gravity"]
    for bounce in range(1, bounces):
        time = time - 2 * p["restitution"] ** bounce * fall / p["gravity"]
    return p["radius"] + p["restitution"] ** bounces * fall * time - p["gravity"] * time**2 / 2


@pytest.mark.slow  # reverse mode through the split compiles for 40 CPU-s
@pytest.mark.parametrize("count", [2, 40])
def test_bounces_in_reverse_mode(precision, count, gate):
    """One bounce in the first step of two, then one and two bounces in the second."""
    model, state = body_on_plane(
        Sphere(0.1), restitution=0.8, friction=0.5, position=(0.0, 1.0, 0.0), options=undamped(impact_events=2)
    )
    parameters = {"height": 1.0, "velocity": 0.0, "restitution": 0.8, "gravity": G, "radius": 0.1}
    parameters = {name: jnp.asarray(value) for name, value in parameters.items()}
    limit = {"float32": 2e-4, "float64": 1e-9}[str(precision)]
    for time, bounces in [(0.8, 1), (1.4, 2), (1.9, 3)]:
        exact, exact_slopes = jax.value_and_grad(truth)(parameters, time, bounces)
        value, slopes = heights(parameters, model, state, jnp.asarray(time), count)
        gate(f"height after {bounces} bounces", value - exact, limit)
        for name in parameters:
            gate(f"{bounces} bounces: d / d {name}", slopes[name] - exact_slopes[name], limit * 10)
            if bounces == 1:
                np.testing.assert_allclose(exact_slopes[name], UNDER_GRAVITY[name], rtol=1e-4)


@pytest.mark.slow
def test_bodies_that_land_at_once_have_derivatives_of_their_own(float64, gate):
    """Two balls far apart: each as if it were alone. Both had the derivative of one and the same time of impact."""
    surface = {"restitution": 0.7, "friction": 0.3}
    builder = SceneBuilder(gravity=(0, -G, 0))
    builder.add_body(Plane((0, 1, 0), 0.0), static=True, **surface)
    motion = {"velocity": (1.0, -3.0, 0.2), "angular_velocity": (3.0, 2.0, -5.0)}
    for index in range(2):
        builder.add_body(Sphere(0.1), mass=0.5, position=(3.0 * index, 0.15, 0), **motion, **surface)
    model, state = builder.build(undamped(dt=1 / 60, impact_events=2))

    def final(higher, change):
        height, velocity, spin = change[:, 0], change[:, 1:4], change[:, 4:]
        start = dataclasses.replace(
            state,
            position=state.position.at[1:, 1].add(height + jnp.asarray([0.0, higher])),
            velocity=state.velocity.at[1:].add(velocity),
            angular_velocity=state.angular_velocity.at[1:].add(spin),
        )
        end = rollout(model, start, 2)[0]
        return jnp.concatenate([end.position, end.velocity, end.angular_velocity, end.orientation], 1)[1:]

    # How much later the second ball lands: together, within the tolerance of a touch, and apart.
    slopes = jax.jit(jax.vmap(lambda higher: jax.jacfwd(final, argnums=1)(higher, jnp.zeros((2, 7)))))
    together, nearly, apart = np.asarray(slopes(jnp.asarray([0.0, 1e-9, 0.01])))
    alone = apart[0, :, 0]
    for name, found, limit in (("together", together, 1e-9), ("nearly", nearly, 1e-6)):
        for ball in range(2):
            gate(f"{name}: ball {ball} by its own start", found[ball, :, ball] - alone, limit)
            gate(f"{name}: ball {ball} by the start of the other", found[ball, :, 1 - ball], 1e-9)
