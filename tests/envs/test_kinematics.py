"""Placing bodies by joint coordinates: the engine must read the same coordinates back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_envs import ENVIRONMENTS, make
from mathota_envs.ball_balance import TILT_X, TILT_Z
from mathota_envs.inverted_pendulum import HINGE, SLIDER
from mathota_envs.kinematics import place
from mathota_jax import Box, Fixed, Hinge, SceneBuilder, joint_position, joint_velocity

TREES = {"mathota/InvertedPendulum-v0": (SLIDER, HINGE), "mathota/BallBalance-v0": (TILT_X, TILT_Z)}


@pytest.mark.parametrize("id", TREES)
def test_joint_coordinates_are_read_back(id, float64):
    environment = make(id)
    generator = np.random.default_rng(0)
    read = jax.jit(lambda q, v: _read(environment, place(environment.rest_state, TREES[id], q, v)))
    for _ in range(5):
        position, velocity = jnp.asarray(generator.uniform(-0.9, 0.9, (2, 2)))
        got_position, got_velocity = read(position, velocity)
        np.testing.assert_allclose(got_position, position, atol=1e-12)
        np.testing.assert_allclose(got_velocity, velocity, atol=1e-12)


def _read(environment, state):
    return joint_position(environment.model, state), joint_velocity(environment.model, state)


@pytest.mark.parametrize("id", TREES)
def test_velocities_are_the_derivatives_of_poses(id, float64):
    environment = make(id)
    generator = np.random.default_rng(1)
    position, velocity = jnp.asarray(generator.uniform(-0.9, 0.9, (2, 2)))

    def poses(time):
        state = place(environment.rest_state, TREES[id], position + time * velocity, velocity)
        return state.position, state.orientation

    now = place(environment.rest_state, TREES[id], position, velocity)
    _, (velocity_w, orientation_rate) = jax.jvp(poses, (0.0,), (1.0,))
    np.testing.assert_allclose(now.velocity, velocity_w, atol=1e-12)
    # q' = omega q / 2, with omega in the world frame.
    for body in range(now.position.shape[0]):
        w, x, y, z = np.asarray(now.orientation[body])
        a, b, c = np.asarray(now.angular_velocity[body])
        want = 0.5 * np.array(
            [-a * x - b * y - c * z, a * w + b * z - c * y, b * w + c * x - a * z, c * w + a * y - b * x]
        )
        np.testing.assert_allclose(orientation_rate[body], want, atol=1e-12)


def test_every_environment_is_covered():
    assert set(TREES) <= set(ENVIRONMENTS)


def test_axes_of_any_length_and_bad_joints(float64):
    builder = SceneBuilder()
    base = builder.add_body(Box((0.1, 0.1, 0.1)), static=True, collides=False, name="base")
    arm = builder.add_body(Box((0.1, 0.3, 0.1)), mass=1.0, position=(0, -0.3, 0), collides=False)
    joint = Hinge(base, arm, anchor=(0, 0, 0), axis=(0, 0, 5.0))
    builder.add_joint(joint)
    model, state = builder.build()
    placed = place(state, [joint], jnp.array([0.4]), jnp.array([2.0]))
    np.testing.assert_allclose(joint_position(model, placed), [0.4], atol=1e-12)
    np.testing.assert_allclose(joint_velocity(model, placed), [2.0], atol=1e-12)
    with pytest.raises(ValueError, match=r"place: joints\[0\] names its bodies, 'base' and 1"):
        place(state, [Hinge("base", arm, anchor=(0, 0, 0), axis=(0, 0, 1))], jnp.zeros(1), jnp.zeros(1))
    with pytest.raises(ValueError, match=r"place: joints\[0\] must be a Hinge or a Slider"):
        place(state, [Fixed(base, arm)], jnp.zeros(1), jnp.zeros(1))  # type: ignore[list-item]
