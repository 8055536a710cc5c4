"""Derivatives of small steps, with joints and contacts in one scene, against a closed form and central differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import BallAndSocket, Box, Hinge, Plane, SceneBuilder, Sphere, joint_position, rollout
from tests.gradients.test_joint_gradients import (
    ARM,
    CENTRAL,
    DAMPING,
    DT,
    HALF,
    MASS,
    REST,
    STIFFNESS,
    angle,
    derivatives,
)
from tests.scenes import axis_angle, undamped

STEPS = 24
LEAVES = ("mass", "inertia", "friction", "joint_stiffness", "joint_damping", "joint_rest")


@pytest.fixture(scope="module")
def scene():
    """A pendulum on a spring, an arm of two bodies, and a box that lands askew on a plane."""
    with jax.enable_x64(True):
        builder = SceneBuilder(gravity=(0, 0, 0))
        post = builder.add_body(Sphere(0.02), static=True, collides=False)
        rod = builder.add_body(Box(HALF), mass=MASS, position=(0, -ARM, 0), collides=False)
        builder.add_joint(Hinge(post, rod, (0, 0, 0), (0, 0, 1), stiffness=STIFFNESS, damping=DAMPING, rest=REST))
        builder.add_body(Plane((0, 1, 0), offset=-1.0), static=True)
        upper = builder.add_body(
            Box((0.2, 0.05, 0.04)), mass=1.0, position=(0.3, 0, 0), angular_velocity=(0.1, 0, 0.3), collides=False
        )
        fore = builder.add_body(
            Box((0.2, 0.04, 0.05)), mass=0.5, position=(0.75, 0.02, 0), angular_velocity=(0.4, 0, 0.3), collides=False
        )
        builder.add_joint(
            Hinge(post, upper, (0.05, 0, 0), (0, 0.2, 1), stiffness=3.0, damping=0.2, rest=0.3, armature=0.01)
        )
        builder.add_joint(BallAndSocket(upper, fore, (0.55, 0, 0), axis=(1, 0, 0), damping=0.05))
        builder.add_body(
            Box((0.1, 0.15, 0.2)),
            mass=1.5,
            position=(3, -0.82, 0),
            orientation=axis_angle((1, 2, 3), 0.2),
            velocity=(0.5, -1, 0.2),
            friction=0.3,
        )
        model, state = builder.build(undamped(dt=DT, solver="soft_step"))

        def outputs(leaves):
            changed = dataclasses.replace(model, **leaves)
            final, _ = rollout(changed, state, STEPS)
            mixed = jnp.sum(final.position * jnp.arange(final.position.size).reshape(final.position.shape))
            return joint_position(changed, final)[0], mixed + final.angular_velocity[fore, 2]

        def loss(leaves, weights):
            found = jnp.stack(outputs(leaves))
            return jnp.dot(weights, found), found

        leaves = {name: getattr(model, name) for name in LEAVES}
        slopes = jax.jit(jax.grad(loss, has_aux=True))
        return leaves, slopes, rod


@pytest.mark.slow
def test_a_pendulum_by_its_parameters(scene, float64, gate):
    leaves, slopes, rod = scene
    found, (value, _) = slopes(leaves, jnp.array([1.0, 0.0]))
    arguments = (STIFFNESS, DAMPING, REST, ARM, CENTRAL, DT * STEPS)
    gate("angle / truth - 1", value / angle(*arguments) - 1, 1e-4)
    by_stiffness, by_damping, by_rest, _, by_inertia, _ = derivatives(angle, arguments)
    of = ("joint_stiffness", 0, by_stiffness), ("joint_damping", 0, by_damping), ("joint_rest", 0, by_rest)
    for name, index, truth in (*of, ("inertia", (rod, 2), by_inertia)):
        gate(f"d angle / d {name} / truth - 1", found[name][index] / truth - 1, 1e-3)


@pytest.mark.slow
def test_central_differences(scene, float64, gate):
    leaves, slopes, _ = scene
    weights = jnp.array([0.0, 1.0])
    found, _ = slopes(leaves, weights)
    random = np.random.default_rng(1)
    for name, leaf in leaves.items():
        direction = leaf * random.uniform(0.5, 1.5, leaf.shape)
        ends = [slopes(leaves | {name: leaf + sign * 1e-6 * direction}, weights)[1][1] for sign in (1, -1)]
        quotient = (ends[0] - ends[1]) / 2e-6
        assert abs(quotient) > 1e-4, f"{name} matters"
        gate(f"d motion / d {name} / central difference - 1", jnp.vdot(found[name], direction) / quotient - 1, 1e-6)
