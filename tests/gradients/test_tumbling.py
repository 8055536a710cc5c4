"""Derivatives of a box that tumbles on a plane: on edges, corners and faces, sticking and sliding."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Plane, SceneBuilder, Sphere, rollout
from tests.scenes import DOWN, undamped

WORLDS, STEPS = 24, 60


def tumbling(company=False):
    """Boxes that drop from 2 cm above the ground, turned and spinning; in company, beside a ball that flies."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.45)
    builder.add_body(Box((0.1, 0.13, 0.08)), mass=1.3, position=(0, 0.2, 0), friction=0.45)
    if company:
        builder.add_body(Sphere(0.1), mass=1.0, position=(5, 5, 0), collides=False)
    model, state = builder.build(undamped(dt=1 / 120))
    rng = np.random.default_rng(1)
    turns = rng.normal(size=(WORLDS, 4))
    velocities, spins = 0.3 * rng.normal(size=(WORLDS, 3)), 2.0 * rng.normal(size=(WORLDS, 3))

    @jax.vmap
    def place(turn, velocity, spin):
        return dataclasses.replace(
            state,
            orientation=state.orientation.at[1].set(turn / jnp.linalg.norm(turn)),
            velocity=state.velocity.at[1].set(velocity),
            angular_velocity=state.angular_velocity.at[1].set(spin),
        )

    return model, place(*(jnp.asarray(part, state.position.dtype) for part in (turns, velocities, spins)))


def final(model, state, change):
    """Where a box is in the end, by changes of its mass, its friction and its velocity."""
    mass, friction, *velocity = change
    changed = dataclasses.replace(model, mass=model.mass * (1 + mass), friction=model.friction + friction)
    moving = dataclasses.replace(state, velocity=state.velocity.at[1].add(jnp.stack(velocity)))
    end = rollout(changed, moving, STEPS)[0]
    return jnp.stack([end.position[1], 0.1 * end.velocity[1]])


def slopes(precision, company=False):
    """(world, change, 2, 3) derivatives in forward mode."""
    with jax.enable_x64(precision == "float64"):
        model, states = tumbling(company)
        of_world = jax.vmap(lambda state: jax.jacfwd(lambda change: final(model, state, change))(jnp.zeros(5)))
        return np.moveaxis(np.asarray(jax.jit(of_world)(states), float), -1, 1)


def difference(found, truth):
    """(world, change) beside the truth, where that is not next to nothing."""
    size = np.abs(truth).max((2, 3))
    return np.abs(found - truth).max((2, 3)) / np.maximum(size, 1e-3 * size.max(1, keepdims=True))


@pytest.mark.slow
@pytest.mark.parametrize("company", [False, True], ids=["alone", "in company"])
def test_float32_says_what_float64_says(gate, company):
    """States differ by 1e-5. Seven steps of a linear solver left a quarter of the derivatives off by 4 % and more."""
    off = difference(slopes("float32", company), slopes("float64", company))
    gate("three of four derivatives", np.quantile(off, 0.75), 2e-3)
    gate("nine of ten", np.quantile(off, 0.9), 0.02)


def test_company_changes_nothing(gate):
    """One in four was off by a third and more, by what no impulses answer to."""
    off = difference(slopes("float64", company=True), slopes("float64"))
    gate("three of four derivatives", np.quantile(off, 0.75), 1e-9)


@pytest.mark.slow
def test_both_modes_agree(precision, gate):
    """``u . (J v) = (J^T u) . v``. They differed by 5 % where each shared loads in a way of its own."""
    model, states = tumbling()
    rng = np.random.default_rng(2)
    v = jnp.asarray(rng.normal(size=5) * [1.0, 0.3, 1.0, 1.0, 1.0], precision)
    u = jnp.asarray(rng.normal(size=(2, 3)), precision)

    def both(state):
        zero = jnp.zeros_like(v)
        forward = jnp.vdot(u, jax.jvp(lambda change: final(model, state, change), (zero,), (v,))[1])
        back = jax.vjp(lambda change: final(model, state, change), zero)[1](u)[0]
        return forward, jnp.vdot(back, v), jnp.abs(back * v).max()

    forward, back, size = (np.asarray(part, float) for part in jax.jit(jax.vmap(both))(states))
    off = np.abs(forward - back) / size
    gate("half of the worlds", np.median(off), 1e-4)
    gate("all", off, 2e-3)
