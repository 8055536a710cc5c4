"""`SB3VecEnv` against stable-baselines3's `DummyVecEnv` over single environments."""

import builtins
import importlib
import sys
import warnings

import gymnasium
import numpy as np
import pytest

from mathota_envs import ENVIRONMENTS, GymEnv, make
from tests.envs.counting import Counting

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed (extra 'train')")

from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from mathota_envs.sb3 import SB3VecEnv

EVERY_ID = pytest.mark.parametrize("id", ENVIRONMENTS)
WORLDS = 3


def actions_at(time):
    return np.array([[1.0], [0.0], [0.75 if time % 2 else 1.0]], np.float32)


@pytest.fixture
def pair():
    return SB3VecEnv(Counting(), WORLDS), DummyVecEnv([lambda: GymEnv(Counting())] * WORLDS)


def assert_same_step(got, want):
    for mine, theirs in zip(got[:3], want[:3], strict=True):
        assert mine.dtype == theirs.dtype
        np.testing.assert_array_equal(mine, theirs)
    for mine, theirs in zip(got[3], want[3], strict=True):
        assert mine.keys() == theirs.keys()
        for key in theirs:
            np.testing.assert_array_equal(mine[key], theirs[key], err_msg=key)


@EVERY_ID
def test_sb3_check_env_passes(id):
    environment = gymnasium.make(id, disable_env_checker=True).unwrapped
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(environment, warn=True)
    texts = [str(w.message) for w in caught]
    assert all("symmetric and normalized Box action space" in text for text in texts), texts


def test_equals_dummy_vec_env_through_many_episodes(pair):
    ours, theirs = pair
    ours.seed(5), theirs.seed(5)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    truncated, terminated = 0, 0
    for time in range(30):
        got, want = ours.step(actions_at(time)), theirs.step(actions_at(time))
        assert_same_step(got, want)
        assert ours.reset_infos == theirs.reset_infos
        truncated += sum(info["TimeLimit.truncated"] for info in want[3])
        terminated += sum("terminal_observation" in info and not info["TimeLimit.truncated"] for info in want[3])
    assert truncated >= 5 and terminated >= 5
    np.testing.assert_array_equal(ours.reset(), theirs.reset())


def test_an_end_that_is_both_is_a_termination():
    environment = SB3VecEnv(Counting(max_episode_steps=1, ceiling=1.0), 1)
    environment.set_options({"number": 0.5})
    environment.reset()
    _, _, dones, infos = environment.step(np.ones((1, 1)))
    assert dones[0] and infos[0]["TimeLimit.truncated"] is False
    np.testing.assert_array_equal(infos[0]["terminal_observation"], [1.5, 1.0])


def test_seed_and_options_apply_to_the_next_reset_only(pair):
    ours, theirs = pair
    for environment in pair:
        environment.seed(1)
        environment.set_options([{"number": 0.5}, {}, {"number": 0.25}])
    first = ours.reset()
    np.testing.assert_array_equal(first, theirs.reset())
    assert first[0, 0] == 0.5 and first[2, 0] == 0.25
    second = ours.reset()
    np.testing.assert_array_equal(second, theirs.reset())
    assert not (first == second).all(axis=1).any()
    np.testing.assert_array_equal(SB3VecEnv(Counting(), WORLDS, seed=4).reset(), _seeded_starts(4))


def _seeded_starts(seed):
    return [GymEnv(Counting()).reset(seed=seed + i)[0] for i in range(WORLDS)]


def test_writing_into_results_changes_nothing(pair):
    ours, theirs = pair
    ours.seed(0), theirs.seed(0)
    ours.reset()[:] = 9
    theirs.reset()
    for time in range(12):
        got, want = ours.step(actions_at(time)), theirs.step(actions_at(time))
        assert_same_step(got, want)
        for array in got[:3]:
            array[...] = 1
        for info in got[3]:
            info.get("terminal_observation", np.zeros(1))[:] = 55
            info["TimeLimit.truncated"] = "spoiled"


def test_attributes_and_methods(pair):
    environment = pair[0]
    assert environment.get_attr("ceiling") == [3.0] * WORLDS
    assert environment.get_attr("dt", indices=1) == [0.5]
    assert environment.get_attr("render_mode") == [None] * WORLDS and environment.render_mode is None
    assert environment.has_attr("dt") and not environment.has_attr("colour")
    environment.set_attr("colour", "red", indices=[0, 2])
    assert environment.get_attr("colour", indices=[0, 2]) == ["red", "red"]
    with pytest.raises(AttributeError):
        environment.get_attr("colour")
    with pytest.raises(ValueError, match=r"cannot set 'ceiling'.*new SB3VecEnv"):
        environment.set_attr("ceiling", 4.0)
    assert [bool(x) for x in environment.env_method("is_truncated", np.int32(5), indices=[0])] == [True]
    assert environment.env_method("render") == [None] * WORLDS
    assert environment.env_is_wrapped(Monitor) == [False] * WORLDS
    with pytest.raises(IndexError):
        environment.get_attr("dt", indices=WORLDS)


def test_pictures():
    environment = SB3VecEnv("mathota/InvertedPendulum-v0", 2, render_mode="rgb_array", width=32, height=24)
    environment.reset()
    images = environment.get_images()
    assert len(images) == 2 and all(image.shape == (24, 32, 3) for image in images)
    assert environment.render().shape == (48, 32, 3)
    with pytest.warns(UserWarning, match="no pictures"):
        assert SB3VecEnv(Counting(), 2).get_images() == [None, None]


def test_wrappers_and_evaluation_of_sb3_accept_it():
    class Still:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.zeros((len(observation), 1), np.float32), None

    environment = VecNormalize(VecMonitor(SB3VecEnv(Counting(), WORLDS, seed=0)), training=False)
    _, lengths = evaluate_policy(Still(), environment, n_eval_episodes=6, return_episode_rewards=True)
    assert lengths == [5] * 6


@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_algorithms_of_sb3_learn_on_it(algorithm):
    import stable_baselines3

    arguments = {"PPO": {"n_steps": 8, "batch_size": 8, "n_epochs": 1}, "SAC": {"learning_starts": 8, "batch_size": 8}}
    environment = SB3VecEnv(Counting(), 2)
    model = getattr(stable_baselines3, algorithm)(
        "MlpPolicy", environment, seed=0, device="cpu", **arguments[algorithm]
    )
    model.learn(32)
    assert all(np.isfinite(value.numpy()).all() for value in model.policy.state_dict().values())


def test_a_non_finite_world_ends_its_episode_and_spoils_nothing():
    environment = SB3VecEnv(make("mathota/InvertedPendulum-v0"), 3, seed=0)
    environment.reset()
    observations, rewards, dones, infos = environment.step(np.array([[np.nan], [0.1], [0.0]]))
    assert dones.tolist() == [True, False, False] and infos[0]["non_finite"] and not infos[0]["TimeLimit.truncated"]
    assert np.isfinite(observations).all() and rewards[0] == 0 and np.isfinite(infos[0]["terminal_observation"]).all()
    assert not environment.step(np.zeros((3, 1)))[2].any()


def test_bad_input_is_named():
    environment = SB3VecEnv(Counting(), WORLDS)
    with pytest.raises(RuntimeError, match="reset before step"):
        environment.step_async(actions_at(0))
    with pytest.raises(RuntimeError, match="step_async before step_wait"):
        environment.step_wait()
    environment.reset()
    environment.step_async(actions_at(0))
    with pytest.raises(RuntimeError, match="step_wait before the next"):
        environment.step_async(actions_at(0))
    environment.step_wait()
    with pytest.raises(ValueError, match=r"actions must have shape \(3, 1\), got \(3,\)"):
        environment.step(np.zeros(3))
    environment.set_options({"numbr": 1.0})
    with pytest.raises(ValueError, match="unknown reset option 'numbr'"):
        environment.reset()
    with pytest.raises(ValueError, match="unknown environment 'mathota/Nothing-v0'"):
        SB3VecEnv("mathota/Nothing-v0", 2)
    with pytest.raises(ValueError, match="num_envs must be a positive integer"):
        SB3VecEnv(Counting(), 0)
    with pytest.raises(ValueError, match="unknown render_mode 'human'"):
        SB3VecEnv("mathota/BallBalance-v0", 1, render_mode="human")


def test_a_missing_stable_baselines3_is_named_with_the_command_that_installs_it(monkeypatch):
    real_import = builtins.__import__

    def without_sb3(name, *arguments, **keywords):
        if name.partition(".")[0] == "stable_baselines3":
            raise ImportError("No module named 'stable_baselines3'")
        return real_import(name, *arguments, **keywords)

    monkeypatch.setattr(builtins, "__import__", without_sb3)
    monkeypatch.delitem(sys.modules, "mathota_envs.sb3")
    with pytest.raises(ImportError, match=r"pip install 'mathota-jax\[train\]'"):
        importlib.import_module("mathota_envs.sb3")
