"""`GymEnv` against Gymnasium's own checkers, and registration."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import PassiveEnvChecker, TimeLimit

from mathota_envs import ENVIRONMENTS, GymEnv
from tests.envs.counting import Counting

EVERY_ID = pytest.mark.parametrize("id", ENVIRONMENTS)
# What the checker says of every environment with unlimited observations, and of torques that are not in [-1, 1].
EXPECTED_WARNINGS = ("minimum value is -infinity", "maximum value is infinity", "symmetric and normalized space")


def unexpected(caught):
    return [str(w.message) for w in caught if not any(text in str(w.message) for text in EXPECTED_WARNINGS)]


@EVERY_ID
def test_gymnasium_check_env_passes_without_warnings(id):
    environment = gymnasium.make(id, disable_env_checker=True).unwrapped
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(environment, skip_render_check=True)
    assert unexpected(caught) == []


@EVERY_ID
def test_passive_checker_of_make_says_nothing(id):
    environment = gymnasium.make(id)
    assert "PassiveEnvChecker" in str(environment)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment.reset(seed=0)
        for _ in range(3):
            environment.step(environment.action_space.sample())


@EVERY_ID
def test_rendering_returns_pictures_that_move(id):
    environment = gymnasium.make(id, render_mode="rgb_array", width=64, height=48)
    environment.reset(seed=0)
    first = environment.render()
    assert first.shape == (48, 64, 3) and first.dtype == np.uint8 and first.flags.writeable
    assert np.ptp(first) > 50, "something must be visible"
    for _ in range(20):
        environment.step(environment.action_space.high)
    assert np.abs(environment.render().astype(int) - first).max() > 20
    environment.close()


def test_rendering_without_a_mode_warns_and_returns_nothing():
    environment = GymEnv(Counting())
    environment.reset()
    with pytest.warns(UserWarning, match="draws nothing"):
        assert environment.render() is None


@EVERY_ID
def test_make_works_without_an_import(id):
    program = f"import gymnasium; e = gymnasium.make('mathota_envs:{id}'); print(e.reset(seed=0)[0].shape, e.spec.id)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=_paths())
    assert result.stdout.strip().endswith(id)


def _paths():
    import os

    return {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}


@EVERY_ID
def test_exactly_one_time_limit(id):
    default = ENVIRONMENTS[id]().max_episode_steps
    environment = gymnasium.make(id)
    assert environment.spec.max_episode_steps == default
    assert environment.unwrapped.environment.max_episode_steps is None
    limits, layer = 0, environment
    while isinstance(layer, gymnasium.Wrapper):
        limits += isinstance(layer, TimeLimit)
        layer = layer.env
    assert limits == 1


def test_the_time_limit_of_make_can_be_longer_or_shorter():
    class Endless(Counting):
        pass

    for limit in (2, 9):
        environment = TimeLimit(PassiveEnvChecker(GymEnv(Endless(max_episode_steps=None, ceiling=1e6))), limit)
        environment.reset(seed=0)
        ends = [environment.step(np.zeros(1, np.float32))[3] for _ in range(limit)]
        assert ends == [False] * (limit - 1) + [True]
    id = "mathota/InvertedPendulum-v0"
    assert gymnasium.make(id, max_episode_steps=2000).spec.max_episode_steps == 2000
    assert gymnasium.make_vec(id, 2, max_episode_steps=2000).environment.max_episode_steps == 2000
    assert gymnasium.make_vec(id, 2).environment.max_episode_steps == 1000


def test_seeds_decide_all_later_starts():
    first, second = GymEnv(Counting()), GymEnv(Counting())
    starts = [first.reset(seed=5)[0], first.reset()[0], first.reset()[0]]
    assert len({float(start[0]) for start in starts}) == 3
    np.testing.assert_array_equal([second.reset(seed=5)[0], second.reset()[0], second.reset()[0]], starts)
    assert not np.array_equal(second.reset(seed=6)[0], starts[0])
    assert not np.array_equal(GymEnv(Counting()).reset()[0], GymEnv(Counting()).reset()[0])
    first.reset(seed=5)
    first.np_random = np.random.default_rng(1)
    second.np_random = np.random.default_rng(1)
    np.testing.assert_array_equal(first.reset()[0], second.reset()[0])


def test_results_are_plain_writable_and_not_reused():
    environment = GymEnv(Counting())
    observation, info = environment.reset(seed=0, options={"number": 0.25})
    assert info == {} and observation.tolist() == [0.25, 0.0]
    stepped, reward, terminated, truncated, info = environment.step(np.array([0.5]))
    assert stepped.tolist() == [0.75, 1.0] and stepped.dtype == np.float32
    assert (reward, terminated, truncated) == (0.75, False, False)
    assert [type(value) for value in (reward, terminated, truncated)] == [float, bool, bool]
    assert info["above_one"] is False and info["half"] == 0.375 and info["steps"] == 1
    observation[:] = stepped[:] = info["pair"][:] = -99.0
    assert environment.step(np.array([0.5]))[0].tolist() == [1.25, 2.0]


def test_terminated_and_truncated_are_told_apart():
    environment = GymEnv(Counting(max_episode_steps=4, ceiling=2.0))
    environment.reset(options={"number": 0.5})
    assert [environment.step([0.25])[2:4] for _ in range(4)][-1] == (False, True)
    environment.reset(options={"number": 0.5})
    assert [environment.step([1.0])[2:4] for _ in range(2)][-1] == (True, False)


def test_bad_input_is_named():
    environment = GymEnv(Counting())
    with pytest.raises(ResetNeeded, match="reset before step"):
        environment.step(np.zeros(1))
    environment.reset()
    with pytest.raises(ValueError, match=r"actions must have shape \(1,\), got \(2,\)"):
        environment.step(np.zeros(2))
    with pytest.raises(ValueError, match="actions must be numbers"):
        environment.step("left")
    with pytest.raises(ValueError, match="reset options must be a dict of names and values, got 3"):
        environment.reset(options=3)
    with pytest.raises(ValueError, match="unknown reset option 'numbr'; valid options: number"):
        environment.reset(options={"numbr": 1.0})
    with pytest.raises(ValueError, match="reset option 'number' must be finite"):
        environment.reset(options={"number": np.nan})
    with pytest.raises(ValueError, match="unknown render_mode 'human'"):
        GymEnv("mathota/BallBalance-v0", render_mode="human")
    with pytest.raises(ValueError, match="already made takes no options"):
        GymEnv(Counting(), ceiling=2.0)
    with pytest.raises(ValueError, match="unknown option 'colour'"):
        gymnasium.make("mathota/BallBalance-v0", colour="red")
