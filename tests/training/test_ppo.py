"""Backend jax on tasks whose best return and values are known."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import scipy.stats

from tests.training.toy_environments import ConstantReward, MatchTarget, ignore
from training.evaluate import evaluate
from training.networks import entropy, log_probability, state_value
from training.normalization import normalize
from training.ppo import PPO, clipped_objective, train
from training.presets import Hyperparameters

SMALL = Hyperparameters(
    worlds=16, steps=40_000, samples_per_update=512, minibatch_count=8, epochs=4, learning_rate=3e-3, evaluations=4
)


@pytest.mark.parametrize(
    ("ratio", "advantage", "objective", "slope"),
    [
        (1.1, 2.0, 2.2, 2.0),  # within the range
        (1.5, 2.0, 2.4, 0.0),  # a good action is already likelier: nothing more to gain
        (0.5, 2.0, 1.0, 2.0),  # a good action became less likely: the way back is open
        (0.5, -2.0, -1.6, 0.0),  # a bad action is already less likely
        (1.5, -2.0, -3.0, -2.0),  # a bad action became likelier: the way back is open
    ],
)
def test_clipped_objective(ratio, advantage, objective, slope):
    value, gradient = jax.value_and_grad(clipped_objective)(ratio, advantage, 0.2)
    assert (value, gradient) == (pytest.approx(objective), pytest.approx(slope))


def test_gaussian_agrees_with_scipy():
    generator = np.random.default_rng(0)
    mean, actions = generator.normal(size=(2, 7, 3)).astype(np.float32)
    log_standard_deviation = np.array([-1.0, 0.0, 0.7], np.float32)
    distribution = scipy.stats.norm(mean, np.exp(log_standard_deviation))
    expected = distribution.logpdf(actions).sum(axis=-1)
    np.testing.assert_allclose(log_probability(mean, log_standard_deviation, actions), expected, rtol=1e-5)
    assert entropy(log_standard_deviation) == pytest.approx(distribution.entropy()[0].sum(), rel=1e-5)


def test_learns_the_optimal_action():
    environment = MatchTarget()
    # With steps as long at the end as at the start the return depends on round-off: 7.2 to 7.9 of 8.
    annealed = replace(SMALL, anneal=True)
    untrained = PPO(environment, annealed)
    before = evaluate(untrained.policy(untrained.initial_state(0)), environment)
    policy = train(environment, annealed, seed=0, report=ignore, should_stop=ignore)
    after = evaluate(policy, environment)
    optimum = environment.max_episode_steps
    assert before.returns.mean() < 0.3 * optimum
    assert 0.93 * optimum < after.returns.mean() <= optimum
    targets = np.linspace(-0.9, 0.9, 19)[:, None].astype(np.float32)
    np.testing.assert_allclose(policy.act(targets), 2 * targets, atol=0.25)


@pytest.mark.parametrize("terminates", [False, True])
def test_critic_bootstraps_at_truncation_only(terminates):
    discount, length = 0.9, 5
    environment = ConstantReward(terminates=terminates, max_episode_steps=length)
    hyperparameters = replace(SMALL, discount=discount, normalize_rewards=False)
    learner = PPO(environment, hyperparameters)
    state, _ = learner.run(learner.initial_state(0), update_count=60, capacity=60)
    observation = normalize(state.moments, np.ones((1, 1), np.float32))
    value = float(state_value(state.parameters, observation)[0])
    endless = 1 / (1 - discount)
    # The critic cannot see the time: with termination the best constant is the mean of what each step has left.
    finite = np.mean([(1 - discount**left) / (1 - discount) for left in range(1, length + 1)])
    expected = fixed_point(discount, hyperparameters.trace_decay, length) if terminates else endless
    assert finite < endless / 2
    assert value == pytest.approx(expected, rel=0.05)


def fixed_point(discount, trace_decay, length):
    """The constant value that equals the mean of its own lambda-return targets over an episode that terminates."""
    totals = np.zeros(2)  # the mean target is totals[0] + totals[1] * value
    for left in range(1, length + 1):
        constant, slope = 1.0, 0.0
        for _ in range(left - 1):
            constant = 1.0 + discount * trace_decay * constant
            slope = discount * (1 - trace_decay) + discount * trace_decay * slope
        totals += np.array([constant, slope]) / length
    return totals[0] / (1 - totals[1])


def test_reports_every_update_and_stops_when_told():
    reports = []
    train(MatchTarget(), SMALL, 0, report=lambda *report: reports.append(report), should_stop=lambda _: True)
    updates_between_evaluations = -(-SMALL.update_count // SMALL.evaluations)
    assert [steps for steps, _, _ in reports] == [512 * (index + 1) for index in range(updates_between_evaluations)]
    # 32 steps of 16 worlds with episodes of 8 steps: 64 episodes in each update.
    assert {episodes for _, _, episodes in reports} == {64}
