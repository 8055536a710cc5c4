"""`InvertedPendulum` against MuJoCo's model of Gymnasium's InvertedPendulum-v5 and against linear theory."""

import pathlib

import gymnasium
import jax
import numpy as np
import pytest
import scipy.linalg

from mathota_envs import make
from mathota_envs.worlds import start_world, start_worlds, step_world

ID = "mathota/InvertedPendulum-v0"
LEAN = np.arctan2(0.001, 0.6)  # by which the pole's centre of mass is off the vertical at angle 0
# What the compiler of a step costs in these tests is paid once for each number of substeps.
SUBSTEPS = (1, 2)


def simulate(substeps, position, velocity, actions):
    """Observations after each control step."""
    environment = make(ID, substeps=substeps)
    options = {"joint_position": np.asarray(position, float), "joint_velocity": np.asarray(velocity, float)}
    env_state = start_world(environment, jax.random.key(0), options).env_state
    observations = []
    for action in actions:
        env_state, transition = step_world(environment, env_state, action)
        observations.append(np.asarray(transition.observation))
    return np.array(observations)


@pytest.fixture(scope="module")
def mujoco_model():
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed (extra 'test')")
    folder = pathlib.Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
    return mujoco.MjModel.from_xml_path(str(folder / "inverted_pendulum.xml"))


def simulate_mujoco(model, position, velocity, actions):
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = position, velocity
    observations = []
    for action in actions:
        data.ctrl[:] = action
        mujoco.mj_step(model, data, 2)
        observations.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(observations)


def test_task_is_that_of_gymnasium(mujoco_model):
    environment = make(ID)
    spec = gymnasium.spec("InvertedPendulum-v5")
    assert environment.max_episode_steps == spec.max_episode_steps == 1000
    assert environment.frame_skip == 2
    assert environment.dt == pytest.approx(2 * mujoco_model.opt.timestep, rel=1e-12)
    assert environment.observation_space.shape == (4,)
    np.testing.assert_array_equal(environment.action_space.high, mujoco_model.actuator_ctrlrange[:, 1])
    np.testing.assert_array_equal(environment.action_space.low, mujoco_model.actuator_ctrlrange[:, 0])
    model = environment.model
    np.testing.assert_allclose(model.mass[1:], mujoco_model.body_mass[1:], rtol=1e-6)
    np.testing.assert_allclose(np.sort(model.inertia[1:]), np.sort(mujoco_model.body_inertia[1:]), rtol=1e-6)
    np.testing.assert_allclose(model.motor_gear, mujoco_model.actuator_gear[:, 0])
    np.testing.assert_allclose(model.joint_damping, mujoco_model.dof_damping)
    np.testing.assert_allclose(model.joint_limits[0], mujoco_model.jnt_range[0])


def test_motion_converges_to_mujocos(mujoco_model, float64, gate):
    """The engine's step is of second order, MuJoCo's of fourth, so half the step leaves a quarter of the difference.

    Richardson's extrapolation removes the second order: what it leaves would show any difference in masses, inertias,
    damping, gear, gravity or geometry, which no refinement removes. MuJoCo's own error here, from its quarter step, is
    1e-6.
    """
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (10, 1))
    start = [0.05, 0.03], [0.1, -0.05]
    truth = simulate_mujoco(mujoco_model, *start, actions)
    coarse, fine = (simulate(substeps, *start, actions) for substeps in SUBSTEPS)
    np.testing.assert_allclose((coarse - truth)[-1] / (fine - truth)[-1], 4.0, rtol=0.05)
    for substeps, observations in zip(SUBSTEPS, (coarse, fine), strict=True):
        # Largest values of the motion: 0.06 m, 0.15 rad, 0.26 m/s, 0.62 rad/s.
        gate(f"after 5 control steps, {substeps} substeps", (observations - truth)[4], 2e-3 / substeps**2)
    gate("extrapolated", (4 * fine - coarse) / 3 - truth, 1e-5)


def linear_model():
    """State matrix of the damped cart and pole about the upright equilibrium, from the sizes in Gymnasium's XML."""
    density, radius, length = 1000.0, 0.049, np.hypot(0.001, 0.6)
    cart = density * np.pi * (0.1**2 * 0.2 + 4 / 3 * 0.1**3)
    cylinder, caps = density * np.pi * radius**2 * length, density * np.pi * 4 / 3 * radius**3
    pole, lever = cylinder + caps, length / 2
    inertia = cylinder * (radius**2 / 4 + length**2 / 12)
    inertia += caps * (0.4 * radius**2 + length**2 / 4 + 0.375 * radius * length)
    mass = np.array([[cart + pole, pole * lever], [pole * lever, inertia + pole * lever**2]])
    matrix = np.zeros((4, 4))
    matrix[:2, 2:] = np.eye(2)
    matrix[2:, :2] = np.linalg.solve(mass, np.diag([0.0, pole * 9.81 * lever]))
    matrix[2:, 2:] = -np.linalg.solve(mass, np.eye(2))
    return matrix


def test_small_motion_follows_linear_theory(float64, gate):
    matrix = linear_model()
    rates, vectors = np.linalg.eig(matrix)
    growth = rates.real.max()
    assert growth == pytest.approx(4.5406, abs=1e-4)
    mode = vectors[:, rates.real.argmax()].real
    start = 1e-5 * mode / mode[1]
    duration, measured = 10 * 0.04, []
    for substeps in SUBSTEPS:
        final = simulate(substeps, start[:2] - [0, LEAN], start[2:], np.zeros((10, 1)))[-1] + [0, LEAN, 0, 0]
        measured.append(np.log(final[1] / start[1]) / duration)
        direction = final / final[1] - mode / mode[1]
        gate(f"shape of the mode, {substeps} substeps", direction, 2e-3 / substeps**2 * growth)
    gate("growth rate / theory - 1, default", measured[0] / growth - 1, 1e-3)
    gate("growth rate / theory - 1, extrapolated", (4 * measured[1] - measured[0]) / 3 / growth - 1, 1e-5)
    # A free motion away from the unstable mode, through the exponential of the linear system.
    start = np.array([2e-5, -1e-5, 3e-5, 1e-5])
    truth = scipy.linalg.expm(matrix * duration) @ start
    coarse, fine = (
        simulate(substeps, start[:2] - [0, LEAN], start[2:], np.zeros((10, 1)))[-1] + [0, LEAN, 0, 0]
        for substeps in SUBSTEPS
    )
    gate("free motion, extrapolated", ((4 * fine - coarse) / 3 - truth) / np.abs(truth).max(), 1e-4)


def test_starts_are_uniform_in_the_noise_range():
    environment = make(ID)
    starts = np.asarray(start_worlds(environment, jax.random.split(jax.random.key(0), 4000)).observation)
    assert np.abs(starts).max() <= 0.01 * (1 + 1e-4)
    # Standard errors: 0.01/sqrt(3 n) for the mean, and a little less than the standard deviation's 1 %.
    np.testing.assert_allclose(starts.mean(axis=0), 0.0, atol=5e-4)
    np.testing.assert_allclose(starts.std(axis=0), 0.01 / np.sqrt(3), rtol=0.05)
    correlation = np.corrcoef(starts.T) - np.eye(4)
    assert np.abs(correlation).max() < 0.08


def test_one_point_for_each_step_until_the_pole_leans_too_far():
    environment = make(ID)
    for angle, falls in ((0.15, False), (-0.15, False), (0.25, True), (-0.25, True)):
        options = {"joint_position": np.array([0.0, angle]), "joint_velocity": np.zeros(2)}
        env_state = start_world(environment, jax.random.key(0), options).env_state
        transition = step_world(environment, env_state, np.zeros(1))[1]
        assert bool(transition.terminated) is falls
        assert float(transition.reward) == float(transition.info["reward_survive"]) == (not falls)
        assert not transition.truncated


def test_the_cart_stops_at_the_ends_of_the_rail(gate):
    for sign in (1.0, -1.0):
        environment = make(ID)
        env_state = start_world(environment, jax.random.key(0)).env_state
        positions = []
        for _ in range(40):
            env_state, transition = step_world(environment, env_state, np.full(1, 3.0 * sign))
            positions.append(float(transition.observation[0]))
        assert abs(positions[-1]) > 0.98
        gate("beyond the end of the rail [m]", max(0.0, max(sign * x for x in positions) - 1.0), 0.01)
