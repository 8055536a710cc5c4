"""Derivative of the position correction where its few sweeps end before the solution."""

import dataclasses

import jax
import numpy as np

from mathota_jax import Hinge, Options, SceneBuilder, Sphere, step

RADIUS, STEP = 0.1, 1e-6
MASSES = np.array([1.0, 3.0, 0.5])


def test_three_sweeps_beside_a_mechanism(float64, gate):
    """Balls at rest in one another, in a row beside a pendulum and without gravity: nothing else moves them.

    Three sweeps from ball to ball end before the solution. The truth are differences of the motion, and that the centre of
    mass stays where it is put.
    """
    builder = SceneBuilder(gravity=(0.0, 0.0, 0.0))
    for index, mass in enumerate(MASSES):
        builder.add_body(Sphere(RADIUS), mass=mass, position=(0.19 * index, 0.0, 0.0))
    wall = builder.add_body(Sphere(RADIUS), static=True, position=(0.0, 2.5, 0.0))
    swinging = builder.add_body(Sphere(RADIUS), mass=1.0, position=(0.0, 2.0, 0.0))
    builder.add_joint(Hinge(wall, swinging, anchor=(0.0, 2.5, 0.0), axis=(0.0, 0.0, 1.0)))
    model, state = builder.build(Options(dt=0.01, linear_damping=0.0))
    count = len(MASSES)
    start = state.position[:count, 0]

    def places(x):
        moved = dataclasses.replace(state, position=state.position.at[:count, 0].set(x))
        return step(model, moved, None).position[:count, 0]

    moved, transpose = jax.jit(lambda x: jax.vjp(places, x))(start)
    found = np.stack([transpose(row)[0] for row in np.eye(count)])
    assert np.abs(moved - start).max() > 1e-3
    gate("centre of mass", (MASSES @ found - MASSES) / MASSES.sum(), 1e-12)
    move, ways = jax.jit(jax.vmap(places)), STEP * np.eye(count)
    gate("motion", np.asarray(move(start + ways) - move(start - ways)).T / (2 * STEP) - found, 1e-8)
