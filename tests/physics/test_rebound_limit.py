"""Rebounds that together would gain energy give all of it back; any other bounce stays as it is.

A ball in a wedge hits one wall, which throws it back, while it slowly leaves the other, which does not. With outward normals
p and q, p.q = -0.8, and normal velocities -1 and 0.5 before the impact, Newton's restitution asks for 1 and 0 after it:
2.2 times the energy. Without rebound the ball stops, so that the share of the rebound that keeps the energy keeps the speed.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Plane, SceneBuilder, Sphere, contact_forces, step
from tests.scenes import advance_worlds, repeat, undamped

BALL, DT, MASS = 2, 1 / 240, 2.0
BEFORE, FULL = np.array([-0.5, -1.0, 0.0]), np.array([4 / 3, 1.0, 0.0])
LIMITED = FULL * np.linalg.norm(BEFORE) / np.linalg.norm(FULL)
WALLS = (0.0, 1.0, 0.0), (0.6, -0.8, 0.0)


def wedge(solver="pgs", walls=WALLS):
    builder = SceneBuilder(gravity=(0, 0, 0))
    for normal, restitution in zip(walls, (1.0, 0.0), strict=False):
        builder.add_body(Plane(normal=normal, offset=0.0), static=True, friction=0.0, restitution=restitution)
    builder.add_body(Sphere(1.0), mass=MASS, position=(2.998, 0.999, 0), velocity=BEFORE, friction=0.0, restitution=1.0)
    return builder.build(undamped(dt=DT, solver=solver, velocity_iterations=80))


@pytest.mark.parametrize("solver", ["pgs", "converged"])
def test_energy_is_kept(precision, gate, solver):
    model, state = wedge(solver)
    final = step(model, state)
    tolerance = 1e-4 if precision == "float32" else 1e-9
    gate("velocity after the impact [m/s]", np.asarray(final.velocity[BALL], float) - LIMITED, tolerance)
    push = np.asarray(contact_forces(model, final), float).sum(0) * DT
    gate("impulse [kg m/s]", push - MASS * (LIMITED - BEFORE), 2 * MASS * tolerance)


def test_other_worlds_bounce_as_ever():
    """To the bit; that ball leaves the first wall alone with its whole speed."""
    model, state = wedge()
    models, states = repeat(model, 2), repeat(state, 2)
    free = states.position.at[:, BALL, 0].set(10.0)
    alone = advance_worlds(models, dataclasses.replace(states, position=free), 1)
    beside = advance_worlds(models, dataclasses.replace(states, position=free.at[0].set(state.position)), 1)
    np.testing.assert_array_equal(np.asarray(alone.velocity[1, BALL]), [-0.5, 1.0, 0.0])
    for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(beside), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[1], np.asarray(b)[1])


@pytest.mark.parametrize("differentiate", [jax.jacfwd, jax.jacrev])
def test_derivatives_are_those_of_the_full_rebound(float64, gate, differentiate):
    model, state = wedge()

    def after(velocity):
        return step(model, dataclasses.replace(state, velocity=state.velocity.at[BALL].set(velocity))).velocity[BALL]

    truth = np.array([[0.0, -4 / 3, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    gate("d velocity after / d velocity before", differentiate(after)(jnp.asarray(BEFORE)) - truth, 1e-6)


def test_only_where_two_pairs_can_meet():
    assert wedge()[0].scene.rebounds_together
    assert not wedge(walls=WALLS[:1])[0].scene.rebounds_together
