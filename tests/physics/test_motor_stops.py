"""Motors that drive into the stops of their joints, against statics: none yields to the other, with or without a cap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Hinge, SceneBuilder, Sphere, joint_forces, joint_position, joint_velocity, rollout
from tests.marks import slow_but
from tests.scenes import DOWN, GRAVITY, undamped

LENGTH, HALF, MASS, STOP, DT = 0.4, 0.02, 1.0, 0.3, 1 / 240


def arms(solver, cap):
    """An arm of two links that is driven up, and one of a single link driven down; also the ways of the joints.

    Weights pull the one off its stops and press the other into its.
    """
    builder = SceneBuilder(gravity=DOWN)
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    for count, limits in ((2, (-1.0, STOP)), (1, (-STOP, 1.0))):
        last = post
        for link in range(count):
            centre = (LENGTH * (link + 0.5), 0, 0)
            body = builder.add_body(Box((LENGTH / 2, HALF, HALF)), mass=MASS, position=centre, collides=False)
            joint = builder.add_joint(Hinge(last, body, (LENGTH * link, 0, 0), (0, 0, 1), limits=limits))
            builder.add_motor(joint, kind="velocity", cap=cap)
            last = body
    model, state = builder.build(undamped(dt=DT, solver=solver))
    return model, state, np.array([1.0, 1.0, -1.0])


@pytest.mark.parametrize("cap", [None, 100.0])
@pytest.mark.parametrize("solver", slow_but(("pgs",), ("pgs", "soft_step", "converged")))
def test_a_motor_holds_its_joint_at_the_stop_and_leaves_it_as_told(solver, cap, gate):
    model, state, ways = arms(solver, cap)
    actions = np.repeat([ways, -ways], [720, 60], axis=0)
    _, record = rollout(model, state, jnp.asarray(actions))

    def observe(state):
        return joint_position(model, state), joint_velocity(model, state), joint_forces(model, state)[0]

    place, rate, force = (np.asarray(found) for found in jax.vmap(observe)(record))
    told = np.minimum(np.arange(1, 721) * DT, STOP)[:, None] * ways
    gate("on the way [rad]", place[:720] - told, 1.5 * DT)
    gate("at the stop [rad]", place[240:720] - STOP * ways, 2e-5)
    gate("rate at the stop [rad/s]", rate[240:720], 1e-3)
    weights = MASS * GRAVITY * np.array([2.0, 1.0, 1.0])
    gate("force on the hinges / weight - 1", force[240:720, :, 1] / weights - 1, 1e-3)
    left = STOP * ways - np.arange(1, 61)[:, None] * DT * ways
    gate("on the way back [rad]", place[720:] - left, 1.5 * DT)
    assert not record.flags.any()
