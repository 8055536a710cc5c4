"""A ball that slides on a box that slides: redundant contacts whose gaps do not fit one another to the last micrometre."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Options, Plane, SceneBuilder, Sphere, rollout
from tests.scenes import DOWN

STEPS, SETTLING = 30, 20
LEAVES = ("position", "velocity", "orientation", "angular_velocity")


def sliding_pair(solver="pgs"):
    """Model and state as built, where all just touches."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0), offset=0.0), static=True, friction=0.3)
    builder.add_body(Box((0.3, 0.1, 0.2)), mass=2.0, position=(0, 0.1, 0), velocity=(2.5, 0, 0), friction=0.5)
    builder.add_body(Sphere(0.1), mass=1.0, position=(0.05, 0.3, 0.02), velocity=(3.5, 0, 0.3), friction=0.4)
    return builder.build(Options(dt=1 / 200, solver=solver))


def loss_of(model, state, of_box):
    state = dataclasses.replace(
        state, **{name: getattr(state, name).at[1].set(value) for name, value in of_box.items()}
    )
    final = rollout(model, state, STEPS)[0]
    return final.position[-1, 0] + 0.1 * final.velocity[-1, 0]


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["pgs", "converged"])
def test_modes_agree_where_all_just_touches(precision, solver, gate):
    """By all of the motion of the box. In float32 forward mode said -132 by a turn, the converged solver 1290."""
    del precision
    model, state = sliding_pair(solver)
    of_box = {name: getattr(state, name)[1] for name in LEAVES}
    reverse, forward = (
        np.concatenate([*jax.jit(mode(lambda of_box: loss_of(model, state, of_box)))(of_box).values()])
        for mode in (jax.grad, jax.jacfwd)
    )
    gate("reverse - forward", reverse - forward, 0.01)


@pytest.mark.slow
def test_both_modes_agree_with_differences(float64, gate):
    """By the place of the box, over 30 steps: impulses that press corner against corner made -118 and -248 by its height.

    What is right by the height is less clear: differences at 1e-9 m are 0.7 off what both modes say.
    """
    model, state = sliding_pair()
    state = rollout(model, state, SETTLING)[0]

    def loss(place):
        return loss_of(model, state, {"position": place})

    place, run = state.position[1], jax.jit(loss)
    reverse, forward = (np.asarray(jax.jit(mode(loss))(place)) for mode in (jax.grad, jax.jacfwd))
    h = 1e-9  # less than the gaps
    truth = np.array([(run(place + h * axis) - run(place - h * axis)) / (2 * h) for axis in jnp.eye(3)])
    gate("reverse - forward", reverse - forward, 2e-3)
    gate("along the plane", (reverse - truth)[[0, 2]], 1e-4)
    gate("across it, where micrometres of gaps decide which corners press", (reverse - truth)[1], 2.0)
