"""The scenes in mathota_jax."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import Box, Options, Plane, SceneBuilder, Sphere, contact_forces, step
from tests.benchmarks import scenes
from tests.benchmarks.batched import BatchedScene

BODY = 1
"""Handle of the moving body in both scenes; the plane is body 0."""


def slide_world(dt: float) -> tuple[Any, Any]:
    """Model and state of one cube on a plane, at rest."""
    builder = SceneBuilder(gravity=(0, -scenes.GRAVITY, 0))
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=scenes.SLIDE_FRICTION)
    half = scenes.SLIDE_HALF_EXTENT
    box = Box((half, half, half))
    builder.add_body(box, mass=scenes.MASS, position=(0, half, 0), friction=scenes.SLIDE_FRICTION)
    return builder.build(undamped(dt))


def bounce_world(dt: float) -> tuple[Any, Any]:
    """Model and state of one sphere above a plane, at rest."""
    builder = SceneBuilder(gravity=(0, -scenes.GRAVITY, 0))
    restitution = scenes.BOUNCE_RESTITUTION
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=0.0, restitution=restitution)
    sphere = Sphere(scenes.BOUNCE_RADIUS)
    height = scenes.BOUNCE_RADIUS + scenes.BOUNCE_GAPS[0]
    builder.add_body(sphere, mass=scenes.MASS, position=(0, height, 0), friction=0.0, restitution=restitution)
    return builder.build(undamped(dt))


def undamped(dt: float) -> Options:
    """Ten sweeps, no damping; everything else at its default."""
    return Options(dt=dt, velocity_iterations=10, linear_damping=0.0, angular_damping=0.0)


def slide(dt: float, count: int) -> BatchedScene:
    """Cubes thrown along x."""
    model, state = slide_world(dt)
    states = repeat(state, count)
    velocity = states.velocity.at[:, BODY, 0].set(jnp.asarray(scenes.spread(scenes.SLIDE_SPEEDS, count)))
    states = dataclasses.replace(states, velocity=velocity)
    return BatchedScene(model, states, batched_step, lambda states: states.position[:, BODY, 0], count)


def bounce(dt: float, count: int) -> BatchedScene:
    """Spheres dropped from several gaps."""
    model, state = bounce_world(dt)
    states = repeat(state, count)
    heights = jnp.asarray(scenes.BOUNCE_RADIUS + scenes.spread(scenes.BOUNCE_GAPS, count))
    states = dataclasses.replace(states, position=states.position.at[:, BODY, 1].set(heights))
    return BatchedScene(model, states, batched_step, _gap, count)


def _gap(states: Any) -> jax.Array:
    return states.position[:, BODY, 1] - scenes.BOUNCE_RADIUS


def batched_step(model: Any, states: Any) -> Any:
    """What a user writes: `vmap(step)`."""
    return jax.vmap(step, (None, 0))(model, states)


def repeat(state: Any, count: int) -> Any:
    """`count` copies of a state along a new leading axis."""
    return jax.tree.map(lambda leaf: jnp.repeat(leaf[None], count, axis=0), state)


def check(worlds: BatchedScene, steps: int) -> dict:
    """Runs the worlds and raises unless the numbers mean something; returns the mean number of loaded contacts.

    Raises:
      RuntimeError: a state is not finite, an orientation is not a unit quaternion or a flag is set.
    """
    model = worlds.parameters

    @jax.jit
    def run(model: Any, states: Any) -> Any:
        def advance(states: Any, _: None) -> tuple[Any, Any]:
            states = worlds.step(model, states)
            forces = jax.vmap(contact_forces, (None, 0))(model, states)
            return states, (jnp.abs(forces).max(axis=-1) > 0).sum(axis=-1).mean()

        return jax.lax.scan(advance, states, None, length=steps)

    final, active = run(model, worlds.states)
    norm_error = float(jnp.max(jnp.abs(jnp.linalg.norm(final.orientation, axis=-1) - 1)))
    finite = all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in (final.position, final.velocity, final.angular_velocity))
    if not finite or norm_error > 1e-3 or bool(jnp.any(final.flags != 0)):
        raise RuntimeError(
            f"meaningless run: finite={finite}, quaternion norm error {norm_error}, flags {np.unique(final.flags)}"
        )
    return {"mean_contacts": float(jnp.mean(active))}
