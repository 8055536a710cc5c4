"""Jointed bodies that land, rebound and press: a mechanism meets the ground as the one body that it is at that moment.

Closed forms: free fall until the impact, rest after it or ``v = -e v``; the derivatives of that, by which a step that takes
impacts at another time than joints shows at first glance; statics of a motor.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import BallAndSocket, Box, Distance, Fixed, Plane, SceneBuilder, Slider, Sphere, rollout, step
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import DOWN, GRAVITY, undamped

RADIUS, DT, SPEED, STEPS = 0.05, 1 / 60, 8.0, 6
JOINTS = {
    "fixed": lambda foot, load: Fixed(foot, load, anchor=(0, 0.2, 0)),
    "ball and socket": lambda foot, load: BallAndSocket(foot, load, anchor=(0, 0.2, 0)),
    "rod": lambda foot, load: Distance(foot, load, anchor=(0, RADIUS, 0)),
}


def on_a_foot(joint, load, restitution=0.0, **options):
    """A load above a foot of 0.2 kg that stands on the ground."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, restitution=restitution)
    foot = builder.add_body(Sphere(RADIUS), mass=0.2, position=(0, RADIUS, 0), restitution=restitution)
    above = builder.add_body(Sphere(RADIUS), mass=load, position=(0, 0.4, 0), collides=False)
    builder.add_joint(JOINTS[joint](foot, above))
    return builder.build(undamped(dt=DT, **options))


@jax.jit
def heights(model, state, gaps):
    """Of the foot's lowest point after each step, (step, world), falling from the gaps at the same speed."""

    def advance(states, _):
        states = jax.vmap(step, (None, 0))(model, states)
        return states, states.position[:, 1, 1] - RADIUS

    def fall(gap):
        return dataclasses.replace(
            state,
            position=state.position.at[1:, 1].add(gap),
            velocity=state.velocity.at[1:, 1].set(-SPEED),
        )

    return jax.lax.scan(advance, jax.vmap(fall)(gaps), length=STEPS)[1]


@pytest.mark.parametrize("solver", ["pgs", pytest.param("converged", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("joint", "load"),
    [
        ("fixed", 10.0),
        pytest.param("fixed", 0.2, marks=pytest.mark.slow),
        pytest.param("ball and socket", 10.0, marks=pytest.mark.slow),
        pytest.param("rod", 10.0, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_what_lands_stops_at_the_ground(joint, load, solver, precision, gate):
    """Whenever in its step it meets it. Exact for a single body; a foot sank in by 0.3 of the way of a step."""
    model, state = on_a_foot(joint, load, solver=solver)
    gaps = np.linspace(0.0, SPEED * DT * 1.4, 32)
    found = np.asarray(heights(model, state, gaps), np.float64)
    time = DT * np.arange(1, STEPS + 1)[:, None]
    truth = np.maximum(gaps[None] - SPEED * time - 0.5 * GRAVITY * time**2, 0.0)
    gate("height of the foot [m]", np.abs(found - truth).max(), 1e-5 if precision == np.float32 else 1e-6)


@pytest.mark.parametrize("solver", ["pgs", pytest.param("converged", marks=pytest.mark.slow)])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_it_rebounds_with_the_derivatives_of_one_body(solver, precision, gate):
    model, state = on_a_foot("fixed", 10.0, restitution=0.8, solver=solver)
    count = 40

    @jax.jit
    def height(start, restitution):
        elastic = dataclasses.replace(model, restitution=jnp.full_like(model.restitution, restitution))
        lifted = dataclasses.replace(state, position=state.position.at[1:, 1].add(start))
        return rollout(elastic, lifted, count)[0].position[1, 1] - RADIUS

    def truth(start, restitution):
        impact = jnp.sqrt(2 * start / GRAVITY)
        left = count * DT - impact
        return restitution * GRAVITY * impact * left - 0.5 * GRAVITY * left**2

    starts = jnp.asarray([0.5, 0.6, 0.73])
    found = jax.jit(jax.vmap(jax.value_and_grad(height, (0, 1)), (0, None)))(starts, 0.8)
    expected = jax.vmap(jax.value_and_grad(truth, (0, 1)), (0, None))(starts, 0.8)
    for name, one, other in zip(
        ("height [m]", "by the start", "by the restitution [m]"),
        (found[0], *found[1]),
        (expected[0], *expected[1]),
        strict=True,
    ):
        gate(name, np.abs(np.asarray(one) - np.asarray(other)).max(), 2e-4 if precision == np.float32 else 1e-8)


@pytest.mark.parametrize("solver", ["pgs", pytest.param("converged", marks=pytest.mark.slow)])
def test_a_slider_presses_with_the_force_of_its_motor(solver, gate):
    """Wherever it is held: its motor would turn a body that is held beside its centre, were it not for the joint."""
    push, rest = 8.0, -0.045
    for anchor in (0.0, 0.05):
        builder = SceneBuilder(gravity=(0, 0, 0))
        world = builder.add_body(Plane((0, 1, 0), -10.0), static=True, collides=False)
        builder.add_body(Box((0.03, 0.06, 0.03)), static=True, position=(0, 0.01, 0))
        finger = builder.add_body(Box((0.01, 0.05, 0.03)), mass=0.1, position=(rest, 0, 0))
        rail = builder.add_joint(Slider(world, finger, anchor=(rest, anchor, 0), axis=(1, 0, 0)))
        builder.add_motor(rail, limit=100.0)
        model, state = builder.build(undamped(dt=1 / 240, solver=solver))
        _, path = rollout(model, state, jnp.full((120, 1), push))
        force = np.abs(np.asarray(path.contact_force)[20:, :, 0].sum(1))
        gate(f"held {anchor} m beside its centre, force [N]", np.abs(force - push).max(), 5e-3)
        gate(
            f"held {anchor} m beside its centre, gap [m]",
            np.abs(np.asarray(path.position)[20:, finger, 0] + 0.04).max(),
            2e-6,
        )
