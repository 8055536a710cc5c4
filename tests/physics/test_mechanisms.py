"""Trees of joints with all else that a scene may have: contacts, limits, drives, dry friction, sleep."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import BallAndSocket, Box, Capsule, Hinge, Plane, SceneBuilder, Sphere, joint_gaps, joint_position
from tests.benchmarks import hard_scenes
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import DOWN, GRAVITY, advance_worlds, motion_and_penetration, record_worlds, repeat, undamped

SOLVERS = ["pgs", pytest.param("converged", marks=pytest.mark.slow)]


def of_world(states):
    """The only world of a batch."""
    return jax.tree.map(lambda x: x[0], states)


def motion_and_gaps(model, state):
    """Motion, deepest overlap and largest gap of any joint [m]."""
    return {**motion_and_penetration(model, state), "gap": joint_gaps(model, state).translation.max()}


def arm(**options):
    """Three level links of 0.3 m and 0.5 kg on a post, their hinges about z."""

    def build(**settings):
        builder = SceneBuilder(gravity=DOWN)
        last = builder.add_body(Sphere(0.02), static=True, collides=False)
        for link in range(3):
            body = builder.add_body(
                Box((0.15, 0.02, 0.03)), mass=0.5, position=(0.15 + 0.3 * link, 0, 0), collides=False
            )
            joint = builder.add_joint(Hinge(last, body, (0.3 * link, 0, 0), (0, 0, 1), **options))
            if "motor" in settings:
                builder.add_motor(joint, kind="position", stiffness=settings["motor"], damping=2.0, limit=10.0)
            last = body
        return builder

    return build


@pytest.mark.parametrize("solver", SOLVERS)
def test_limits_hold(float64, solver, gate):
    """The arm falls onto its stops, at rest: each bends by 0.3 rad further, and stays there."""
    model, state = arm(limits=(-0.3, 1.0))().build(undamped(dt=1 / 240, solver=solver))
    final = of_world(advance_worlds(repeat(model, 1), repeat(state, 1), 480))
    angles = np.asarray(joint_position(model, final), float)
    gate("gap / link", np.asarray(joint_gaps(model, final).translation) / 0.3, 1e-6)
    gate("beyond the stops [rad]", np.maximum(0.0, -0.3 - angles), 2e-3)
    gate("last angle from its stop [rad]", angles[0] + 0.3, 2e-3)


def test_servos_carry_the_arm(float64, gate):
    """At rest the torque of each spring carries what hangs beyond it: the angles are those of statics."""
    model, state = arm()(motor=40.0).build(undamped(dt=1 / 240))
    final = of_world(advance_worlds(repeat(model, 1), repeat(state, 1), 1920, jnp.zeros((1, 3))))
    angles = np.asarray(joint_position(model, final), float)
    level = np.cumsum(angles)
    torque = [
        sum(
            0.5 * GRAVITY * (0.3 * np.cos(level[joint:link]).sum() + 0.15 * np.cos(level[link]))
            for link in range(joint, 3)
        )
        for joint in range(3)
    ]
    gate("spring torque / load - 1", -40.0 * angles / np.array(torque) - 1.0, 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_chain_falls_on_the_ground(solver, gate):
    """Six links, free, thrown up at one end: they come to rest on the ground, joined."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True)
    for link in range(6):
        body = builder.add_body(
            Capsule(0.05, 0.1), mass=0.4, position=(0.3 * link, 0.3, 0), velocity=(0, 0.3 * link, 0),
            orientation=(np.sqrt(0.5), 0, 0, -np.sqrt(0.5)),
        )  # fmt: skip
        if link:
            builder.add_joint(BallAndSocket(body - 1, body, (0.3 * link - 0.15, 0.3, 0), damping=0.01))
    model, state = builder.build(undamped(dt=1 / 120, solver=solver))
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), 480, motion_and_gaps)
    record = {name: np.asarray(values, float)[:, 0] for name, values in record.items()}
    gate("gap / link", record["gap"] / 0.3, 1e-4)
    gate("penetration / radius", record["penetration"][240:] / 0.05, 0.02)
    gate("speed at the end [m/s]", record["velocity"][-60:], 0.02)
    gate("height at the end", record["position"][-1, 1:, 1] / 0.05 - 1.0, 0.05)
    energy = 0.5 * (record["velocity"] ** 2).sum(-1) + GRAVITY * record["position"][..., 1]
    total = 0.4 * energy[:, 1:].sum(-1)
    gate("energy gained / that of the fall", max(0.0, total.max() - total[0]) / total[0], 1e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_chain_that_starts_open_is_closed_and_not_whipped(precision, gate):
    """B7c: four level links of 1 m, 0.5 m apart. After a step they have the speed of a fall, not that of the way."""
    dt = 1 / 60
    model, state = hard_scenes.chain(4, undamped(dt=dt), spacing=1.5)
    gate("gap at the start - 0.5 m", np.asarray(joint_gaps(model, state).translation)[1:] - 0.5, 1e-6)
    final = of_world(advance_worlds(repeat(model, 1), repeat(state, 1), 1))
    gate("gap / link", np.asarray(joint_gaps(model, final).translation), 1e-5)
    # The end of a level rod falls at 3/2 g, its middle at less; the links of a chain lie between.
    gate("speed [m/s]", np.linalg.norm(np.asarray(final.velocity), axis=-1), 1.5 * GRAVITY * dt)
