"""Derivatives of several bodies on one another, against closed forms: of few bodies one dense system is behind them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Plane, SceneBuilder, rollout, step
from mathota_jax.solver import dense
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.scenes import DOWN, GRAVITY, advance, body_on_plane, box_stack, undamped

SPEED, DT = 1.0, 1 / 240
FRICTIONS = {"ground": 0.5, "bottom": 0.08, "others": 0.8}
SLIDING = (FRICTIONS["ground"] * FRICTIONS["bottom"]) ** 0.5


def pile(count, **options):
    """Slabs on one another that slide as one: what lies above sticks to what lies below."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=FRICTIONS["ground"])
    for k in range(count):
        friction = FRICTIONS["others" if k else "bottom"]
        builder.add_body(Box((0.1, 0.05, 0.1)), mass=1.0 + k, position=(0, 0.05 * (2 * k + 1), 0), friction=friction)
    return builder.build(undamped(dt=DT, **options))


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize("solver", slow_but(("pgs",), ("pgs", "converged")))
def test_slabs_that_slide_as_one(precision, solver, gate):
    """Stopped, they have gone v^2 / (2 mu g): the derivatives of a single slab, which is 0.15 and 0.3 % at this time step.

    Fifteen linear sweeps were off by 1.5 and 3.1 %.
    """
    model, state = pile(3, solver=solver)
    steps = int(1.3 * SPEED / (SLIDING * GRAVITY) / DT)

    def distance(speed, mass, friction):
        moving = dataclasses.replace(state, velocity=state.velocity.at[1:, 0].set(speed))
        changed = dataclasses.replace(
            model, mass=model.mass.at[1].set(mass), friction=model.friction.at[1].set(friction)
        )
        return rollout(changed, moving, steps)[0].position[1:, 0].mean()

    found = jax.jit(jax.value_and_grad(distance, (0, 1, 2)))(SPEED, 1.0, FRICTIONS["bottom"])
    value, (by_speed, by_mass, by_friction) = jax.tree.map(float, found)
    truth = SPEED**2 / (2 * SLIDING * GRAVITY)
    gate("distance", value / truth - 1, 3e-4)
    gate("by the speed", by_speed / (SPEED / (SLIDING * GRAVITY)) - 1, 2e-3)
    gate("by the mass of the lowest, which is 0", by_mass / truth, 1e-4)
    gate("by the friction below", by_friction / (-truth / (2 * FRICTIONS["bottom"])) - 1, 4e-3)


def on_the_ground(half):
    return body_on_plane(Box(half), position=(0, half[1], 0), options=undamped(dt=DT))


SCENES = {
    "cube": lambda: on_the_ground((0.1, 0.1, 0.1)),
    "post": lambda: on_the_ground((0.02, 0.2, 0.02)),
    "plank": lambda: on_the_ground((0.5, 0.01, 0.05)),
    "five cubes": lambda: box_stack(5, options=undamped(dt=DT)),
    "ten cubes, in places that change": lambda: box_stack(10, options=undamped(dt=DT)),
}


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize("scene", slow_but(("cube", "ten cubes, in places that change"), SCENES))
def test_what_is_pressed_and_sticks_takes_up_any_small_kick(precision, scene, gate):
    """All velocities after a step are 0, whatever they were before: so are their derivatives.

    Fifteen linear sweeps left 0.47 of a kick of five boxes, 0.34 of one of ten.
    """
    model, state = SCENES[scene]()
    state = advance(model, state, 300)

    def after(velocity, angular_velocity):
        new = step(model, dataclasses.replace(state, velocity=velocity, angular_velocity=angular_velocity))
        return 0.1 * new.angular_velocity, new.velocity

    def answers(kick):
        kicks = (state.velocity, state.angular_velocity), (kick, kick[:, ::-1] / 0.1)
        forward = jax.jvp(after, *kicks)[1]
        back = jax.vjp(after, *kicks[0])[1]((kick, kick[:, ::-1]))
        return forward, (back[0], back[1] / 0.1)

    kicks = np.random.default_rng(0).normal(size=(8, *state.velocity.shape)).astype(state.velocity.dtype)
    kicks[:, 0] = 0  # the ground
    found = jax.jit(jax.vmap(answers))(kicks)
    for name, parts in zip(("forward", "reverse"), found, strict=True):
        largest = max(float(jnp.abs(part[:, 1:]).max()) for part in parts)
        gate(f"{name}: what is left of kicks", largest / np.abs(kicks).max(), 3e-4 if precision == "float32" else 1e-9)


@pytest.mark.parametrize(("count", "size"), [(3, 3), (6, 6), (18, 6)])
def test_inverse_by_blocks(float64, count, size, gate):
    """Against LAPACK, with zeros on the diagonal that only exchanges of rows get past."""
    matrices = np.random.default_rng(count).normal(size=(5, count, count)) + 3 * np.eye(count)
    for block in range(0, count, size):
        rows = np.arange(block, block + size)
        matrices[:, rows] = matrices[:, np.roll(rows, 1)]
    found = np.moveaxis(np.asarray(dense.inverse(jnp.moveaxis(jnp.asarray(matrices), 0, -1), size)), -1, 0)
    gate("M M^-1 - 1", matrices @ found - np.eye(count), 1e-10)
