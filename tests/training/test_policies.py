"""Saved policies act as they did before; evaluation counts what it should."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.training.toy_environments import CartPole, ConstantReward, MatchTarget
from training.evaluate import Evaluator, evaluate
from training.policies import load_policy, save_policy
from training.presets import Hyperparameters

SHORT = Hyperparameters(worlds=4, steps=256, samples_per_update=128, minibatch_count=4, epochs=2)


def train(backend, environment, hyperparameters):
    if backend == "sb3":
        from training.sb3_backend import train
    else:
        from training.ppo import train
    return train(environment, hyperparameters, seed=0, report=lambda *_: None, should_stop=lambda _: False)


@pytest.mark.parametrize("backend", ["sb3", "jax"])
@pytest.mark.parametrize("normalize_observations", [True, False])
def test_round_trip(backend, normalize_observations, tmp_path):
    policy = train(backend, CartPole(), replace(SHORT, normalize_observations=normalize_observations))
    save_policy(policy, tmp_path, "toy/CartPole-v0", backend)
    environment_id, loaded = load_policy(tmp_path)
    observations = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    assert environment_id == "toy/CartPole-v0"
    np.testing.assert_array_equal(loaded.act(observations), policy.act(observations))
    assert np.ptp(policy.act(observations)) > 0
    assert (np.abs(policy.act(100 * observations)) <= 3.0).all()


def test_sb3_learns_a_toy():
    hyperparameters = replace(
        SHORT, worlds=16, steps=12_000, samples_per_update=512, learning_rate=3e-3, epochs=4, minibatch_count=8
    )
    policy = train("sb3", MatchTarget(), hyperparameters)
    assert evaluate(policy, MatchTarget()).returns.mean() > 0.85 * MatchTarget().max_episode_steps


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        (None, FileNotFoundError, "policy.json"),
        ("{", ValueError, "damaged"),
        ("{}", ValueError, "environment"),
        (json.dumps({"environment": "a", "backend": "other"}), ValueError, "unknown backend 'other'"),
        (json.dumps({"environment": "a", "backend": "jax"}), FileNotFoundError, "policy.npz"),
    ],
)
def test_unusable_folders(content, error, message, tmp_path):
    if content is not None:
        (tmp_path / "policy.json").write_text(content)
    with pytest.raises(error, match=message):
        load_policy(tmp_path)


@pytest.mark.parametrize("terminates", [False, True])
def test_evaluation_of_a_known_episode(terminates):
    environment = ConstantReward(terminates=terminates, max_episode_steps=7)
    evaluation = Evaluator(environment, 3).run(lambda _: np.zeros((3, 1)), seed=0, record=True)
    np.testing.assert_array_equal(evaluation.returns, [7, 7, 7])
    np.testing.assert_array_equal(evaluation.lengths, [7, 7, 7])
    assert evaluation.terminated.tolist() == [terminates] * 3
    np.testing.assert_array_equal(evaluation.trajectory.step_count, range(7))


def test_evaluation_counts_nothing_after_the_end():
    evaluator = Evaluator(CartPole(), 10)
    evaluation = evaluator.run(lambda _: np.zeros((10, 1)), seed=0, record=True)
    # The reward is 1 for each step but the one at which the pole falls, and the pole falls at different times.
    np.testing.assert_array_equal(evaluation.returns, evaluation.lengths - 1)
    assert len(set(evaluation.lengths)) > 1
    np.testing.assert_array_equal(evaluation.trajectory.step_count, range(evaluation.lengths[0]))
    again, other = (evaluator.run(lambda _: np.zeros((10, 1)), seed=seed).lengths for seed in (0, 1))
    np.testing.assert_array_equal(evaluation.lengths, again)
    assert list(other) != list(again)


def test_evaluation_needs_episodes_that_end():
    with pytest.raises(ValueError, match="max_episode_steps"):
        Evaluator(CartPole(max_episode_steps=None), 1)
    with pytest.raises(ValueError, match="evaluation episodes must be a whole number of at least 1, got 0"):
        Evaluator(CartPole(), 0)
