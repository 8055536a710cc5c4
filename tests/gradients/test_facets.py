"""Derivatives of a ball that rolls from facet to facet of a heightfield."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import Heightfield, Options, SceneBuilder, Sphere, step
from tests.scenes import undamped

WORLDS, COUNT, CELL, RADIUS, STEPS = 3, 40, 0.02, 0.1, 20


def rolling(options: Options):
    """A ball above a field without height, and where the grid's points are, (row, column)."""
    builder = SceneBuilder(gravity=(0, -9.81, 0))
    builder.add_body(Heightfield(np.zeros((COUNT, COUNT)), CELL), static=True, friction=0.2)
    builder.add_body(Sphere(RADIUS), mass=1.0, position=(0.0131, RADIUS, 0.0073), friction=0.2)
    model, state = builder.build(options)
    at = CELL * (np.arange(COUNT) - 0.5 * (COUNT - 1))
    return model, state, *np.meshgrid(at, at, indexing="ij")


def test_end_of_a_roll_over_bumps_by_their_heights(float64, gate):
    """Twenty steps with ten sweeps, against central differences of the same roll by the converged solver.

    Two contacts with normals 1 degree apart share the load for some steps until sweeps let one go. The derivative at what
    they had found by then was 600 to 6000 times too large.
    """
    rng = np.random.default_rng(1)
    direction = jnp.asarray(rng.normal(size=(COUNT, COUNT)))

    def ends(solver: str):
        model, state, x, z = rolling(undamped(dt=1 / 240, solver=solver))
        shape = model.shapes["heightfield"]["heights"].shape

        def end(heights, height):
            field = {**model.shapes["heightfield"], "heights": heights.reshape(shape)}
            ground = dataclasses.replace(model, shapes={**model.shapes, "heightfield": field})
            start = dataclasses.replace(
                state,
                position=state.position.at[1, 1].set(height),
                velocity=state.velocity.at[1].set(jnp.array([0.5, -0.5, 0.2])),
            )
            last = jax.lax.scan(lambda now, _: (step(ground, now), None), start, length=STEPS)[0]
            return last.position[1]

        return end, x, z

    end, x, z = ends("pgs")
    waves = 0.02 * np.sin(3 * x + 1) * np.cos(2 * z)
    fields = np.stack([waves + 0.05 * world * x + 0.02 * CELL * rng.uniform(-1, 1, x.shape) for world in range(WORLDS)])
    away = np.hypot(x - 0.0131, z - 0.0073)
    under = np.where(away < RADIUS, np.sqrt(np.maximum(RADIUS**2 - away**2, 0.0)), -1.0)
    heights = (fields + under).max((1, 2)) + 0.002
    arguments = jnp.asarray(fields), jnp.asarray(heights)
    slope = jax.jit(jax.vmap(lambda field, height: jax.jvp(lambda f: end(f, height), (field,), (direction,))[1]))(
        *arguments
    )

    exact, change = jax.jit(jax.vmap(ends("converged")[0])), 1e-6 * direction
    truth = (exact(arguments[0] + change, arguments[1]) - exact(arguments[0] - change, arguments[1])) / 2e-6
    off = jnp.linalg.norm(slope - truth, axis=-1) / jnp.linalg.norm(truth, axis=-1)
    gate("derivative of the end by the heights, off", off, 0.05)
