"""Loops of joints that contradict each other are flagged, without cost to scenes that have no loop."""

import dataclasses

import jax
import numpy as np
import pytest

from mathota_jax import BallAndSocket, Box, Distance, Fixed, Flag, Hinge, SceneBuilder, Sphere, step
from mathota_jax.constraints.mechanism_layout import looped_slots
from tests.marks import slow_but
from tests.scenes import advance, advance_worlds, repeat, undamped

AXIS = (0, 0, 1)


def posts(*joints, **options):
    """Two rods of 1 m that stand side by side on the ground, body 0."""
    builder = SceneBuilder(gravity=(0, -9.81, 0))
    builder.add_body(Sphere(0.02), static=True, collides=False)
    for x in (0.0, 1.0):
        builder.add_body(Box((0.02, 0.5, 0.02)), mass=1.0, position=(x, 0.5, 0), collides=False)
    for joint in joints:
        builder.add_joint(joint)
    return builder.build(undamped(dt=1 / 240, **options))


def rod(length):
    return Distance(1, 2, anchor=(0, 1, 0), child_anchor=(1, 1, 0), lengths=length)


FEET = Hinge(0, 1, (0, 0, 0), AXIS), Hinge(0, 2, (1, 0, 0), AXIS)


@pytest.mark.parametrize("solver", slow_but(("pgs",), ("pgs", "soft_step", "converged")))
def test_a_rod_that_can_not_reach_is_flagged(solver):
    """Feet 1 m apart, rods of 1 m: their ends are at most 3 m apart."""
    for length, flag in ((1.0, 0), (4.0, Flag.OPEN_LOOP)):
        model, state = posts(*FEET, rod(length), solver=solver)
        final = advance(model, state, 60)
        assert int(final.flags) == flag and np.isfinite(np.asarray(final.velocity)).all()


@pytest.mark.slow
def test_only_its_own_world_is_flagged():
    model, state = posts(*FEET, rod(1.0))
    models = repeat(model, 3)
    models = dataclasses.replace(models, joint_limits=models.joint_limits.at[1, 2].set(4.0))
    assert advance_worlds(models, repeat(state, 3), 3).flags.tolist() == [0, int(Flag.OPEN_LOOP), 0]


@pytest.mark.slow
def test_derivatives_stay_finite():
    model, state = posts(*FEET, rod(4.0))

    def end(anchor):
        return step(dataclasses.replace(model, joint_anchor_child=anchor), state).position.sum()

    assert np.isfinite(np.asarray(jax.grad(end)(model.joint_anchor_child * 0.0))).all()


@pytest.mark.parametrize(
    ("joints", "loop"),
    [
        (FEET, ()),
        (
            (*FEET, Distance(1, 2, anchor=(0, 1, 0), child_anchor=(1, 1, 0), lengths=(0.0, 4.0))),
            (),
        ),  # a rope holds nothing
        ((*FEET, rod(1.0)), (0, 1, 2)),
        ((FEET[0], Hinge(0, 1, (0, 0, 0.2), AXIS), FEET[1]), (0, 1)),
        ((Fixed(0, 1, (0, 0, 0)), BallAndSocket(1, 2, (0.5, 1, 0))), ()),
    ],
    ids=["tree", "rope", "rod", "door", "chain"],
)
def test_which_joints_are_in_loops(joints, loop):
    model, _ = posts(*joints)
    assert tuple(sorted({joint for joint, _, _ in looped_slots(model.scene)})) == loop
