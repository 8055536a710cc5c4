"""`BallBalance`: rolling by the closed form, frames by finite differences, reward and ends by hand."""

import jax
import numpy as np
import pytest

from mathota_envs import make
from mathota_envs.ball_balance import BALL, BALL_RADIUS, MAXIMUM_TILT, PIVOT, PLATE
from mathota_envs.worlds import start_world, step_world

ID = "mathota/BallBalance-v0"


def start(ball_position=(0.0, 0.0), tilt=(0.0, 0.0), seed=0):
    options = {"ball_position": np.asarray(ball_position, np.float32), "tilt": np.asarray(tilt, np.float32)}
    return start_world(make(ID), jax.random.key(seed), options)


def run(env_state, actions):
    """Observations, transitions and states after each control step."""
    states, transitions = [], []
    for action in actions:
        env_state, transition = step_world(make(ID), env_state, np.asarray(action, np.float32))
        states.append(env_state.state)
        transitions.append(transition)
    return np.array([t.observation for t in transitions]), transitions, states


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_ball_rolls_down_the_tilted_plate_at_five_sevenths(axis, sign, gate):
    """The motor presses the plate against its stop, so the ball is on a fixed incline: 5/7 g sin(tilt), no slip."""
    unit = sign * np.eye(2)[axis]
    world = start(ball_position=-0.2 * unit, tilt=MAXIMUM_TILT * unit)
    count = 20
    observations, _, states = run(world.env_state, [unit] * count)
    gate("tilt [rad]", observations[-1, 4 + axis] - sign * MAXIMUM_TILT, 2e-3)
    # Between two instants, when the plate has come to rest: the damping of free bodies (0.05/s) takes 0.6 %.
    seconds = (count - 5) / 60
    acceleration = sign * (observations[-1, 2 + axis] - observations[4, 2 + axis]) / seconds
    gate("acceleration / (5/7 g sin) - 1", acceleration / (5 / 7 * 9.8 * np.sin(MAXIMUM_TILT)) - 1, 0.015)
    speed = np.linalg.norm(states[-1].velocity[BALL])
    gate("slip / speed", np.linalg.norm(states[-1].angular_velocity[BALL]) * BALL_RADIUS / speed - 1, 1e-3)
    gate("sideways [m]", observations[-1, 1 - axis], 1e-4)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_positive_action_tilts_and_rolls_forwards(axis):
    # After half a second: at first the ball lags behind the plate's surface, which moves forwards under it.
    # By then the plate rests against its stop.
    observations, _, _ = run(start().env_state, [np.eye(2)[axis]] * 30)
    assert observations[-1, 4 + axis] > 0.02 and observations[0, 6 + axis] > 0
    assert observations[-1, axis] > 1e-3 and observations[-1, 2 + axis] > 0
    assert np.abs(observations[:, [1 - axis, 5 - axis]]).max() < 1e-4


def test_rates_are_the_derivatives_of_positions(gate):
    """In the moving frame of the plate; central differences of observations 1/60 s apart are good to some percent."""
    actions = 0.6 * np.stack([np.cos(np.arange(40) / 6), np.sin(np.arange(40) / 5)], axis=1)
    observations, _, _ = run(start(ball_position=(0.05, -0.04), tilt=(0.03, -0.02)).env_state, actions)
    for name, place, rate in (("ball", 0, 2), ("tilt", 4, 6), ("target", 8, 10)):
        positions, rates = observations[:, place : place + 2], observations[:, rate : rate + 2]
        differences = (positions[2:] - positions[:-2]) * 30
        gate(f"{name}: difference of rates / largest rate", (differences - rates[1:-1]) / np.abs(rates).max(), 0.05)


def test_gimbal_holds_the_plate(gate):
    actions = np.random.default_rng(0).uniform(-1, 1, (100, 2))
    observations, _, states = run(start().env_state, actions)
    gate("plate off the pivot [m]", [state.position[PLATE] - np.array(PIVOT) for state in states], 1e-5)
    errors = []
    for observation, state in zip(observations, states, strict=True):
        # Two tilts and no yaw: about -z first, then about the turned x axis.
        half_x, half_z = 0.5 * observation[4], 0.5 * observation[5]
        about_z, about_x = (np.cos(half_x), 0, 0, -np.sin(half_x)), (np.cos(half_z), np.sin(half_z), 0, 0)
        want = _product(about_z, about_x)
        errors.append(np.linalg.norm(want - np.asarray(state.orientation[PLATE])))
    gate("orientation", errors, 1e-4)
    assert np.abs(observations[:, 4:6]).max() <= MAXIMUM_TILT + 0.01


def _product(p, q):
    return np.array(
        [
            p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
        ]
    )


def test_reward_is_largest_on_the_target():
    target = np.asarray(start(seed=5).observation)[8:10]
    _, (on_target,), _ = run(start(ball_position=target, seed=5).env_state, [np.zeros(2)])
    assert float(on_target.reward) == pytest.approx(1.0, abs=0.02)
    _, (hard,), _ = run(start(ball_position=target, seed=5).env_state, [np.ones(2)])
    assert float(on_target.reward) - float(hard.reward) == pytest.approx(0.01, abs=5e-3)
    _, (off,), _ = run(start(ball_position=target + np.array([0.05, 0.0]), seed=5).env_state, [np.zeros(2)])
    assert float(off.reward) == pytest.approx(0.5, abs=0.03)


def test_target_moves_within_its_amplitude_and_differs_between_episodes():
    targets = []
    for seed in range(4):
        observations, _, _ = run(start(seed=seed).env_state, np.zeros((10, 2)))
        targets.append(observations[:, 8:12])
    targets = np.array(targets)
    assert np.abs(targets[..., :2]).max() <= 0.12
    assert np.linalg.norm(np.diff(targets[..., :2], axis=1), axis=-1).min() > 1e-6
    assert len(np.unique(targets[:, 0], axis=0)) == 4


def test_episode_ends_when_the_ball_leaves_the_plate():
    observations, transitions, _ = run(start(ball_position=(0.24, 0.0), tilt=(0.3, 0.0)).env_state, [[1.0, 0.0]] * 12)
    terminated = [bool(t.terminated) for t in transitions]
    assert not terminated[0] and terminated[-1] and not any(t.truncated for t in transitions)
    np.testing.assert_array_equal(terminated, np.abs(observations[:, 0]) > 0.25)
