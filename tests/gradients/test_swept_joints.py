"""Derivatives of joints whose rows are swept: by the masses that springs move, and at rest, where friction has no part."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from mathota_jax import BallAndSocket, Box, Hinge, SceneBuilder, Slider, Sphere, step
from tests.marks import slow_but
from tests.scenes import DOWN, undamped

DT = 0.01


def ball_on_a_spring():
    """Of 2 kg, drawn 0.1 m from its rest."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    ball = builder.add_body(Sphere(0.1), mass=2.0, position=(0, -1, 0), collides=False)
    builder.add_joint(Slider(post, ball, (0, -1, 0), (0, 1, 0), stiffness=1.0, rest=0.1))
    return *builder.build(undamped(dt=DT)), ball


def test_derivative_of_a_spring_by_the_mass(float64, gate):
    """``k dt^2 / m`` from 0.005 to 2.5: of stiff springs the sign was wrong. Closed form where the spring is soft."""
    model, state, ball = ball_on_a_spring()

    @jax.jit
    def speed(mass, stiffness):
        changed = dataclasses.replace(
            model, mass=model.mass.at[ball].set(mass), joint_stiffness=jnp.reshape(stiffness, (1,))
        )
        return step(changed, state).velocity[ball, 1]

    def truth(mass, stiffness):
        rate = jnp.sqrt(stiffness / mass)
        return 0.1 * rate * jnp.sin(rate * DT)

    slope = jax.jit(jax.grad(speed))
    gate("soft spring / closed form - 1", slope(2.0, 100.0) / jax.grad(truth)(2.0, 100.0) - 1.0, 1e-3)
    for stiffness in (1e2, 5e3, 1.6e4, 5e4):
        difference = (speed(2.0 + 1e-5, stiffness) - speed(2.0 - 1e-5, stiffness)) / 2e-5
        gate("derivative - difference [m/s/kg]", slope(2.0, stiffness) - difference, 1e-7)


RESISTANCES = {"friction": {"friction": 0.02}, "damping": {"damping": 0.1}}


@pytest.mark.parametrize("kind", slow_but(("hinge",), ("hinge", "ball")))
@pytest.mark.parametrize("resistance", slow_but(("friction",), RESISTANCES))
@pytest.mark.parametrize("solver", slow_but(("pgs",), ("pgs", "converged")))
def test_a_pendulum_at_rest(kind, resistance, solver, float64, gate):
    """Pushed aside by nothing, as by 1e-9 m and by differences; friction took a share of what closes the joint."""
    builder = SceneBuilder(gravity=DOWN)
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    rod = builder.add_body(Box((0.05, 0.25, 0.04)), mass=2.0, position=(0, -0.25, 0), collides=False)
    given = RESISTANCES[resistance]
    builder.add_joint(
        Hinge(post, rod, (0, 0, 0), (0, 0, 1), **given)
        if kind == "hinge"
        else BallAndSocket(post, rod, (0, 0, 0), **given)
    )
    model, state = builder.build(undamped(dt=DT, solver=solver))

    @jax.jit
    def place(aside):
        return step(model, dataclasses.replace(state, position=state.position.at[rod, 0].add(aside))).position[rod, 0]

    slope = jax.jit(jax.grad(place))
    gate("at rest - aside", slope(0.0) - slope(1e-9), 1e-7)
    gate("at rest - difference", slope(0.0) - (place(1e-5) - place(-1e-5)) / 2e-5, 1e-6)
