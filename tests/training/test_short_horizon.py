"""Backend gradient on tasks whose gradients, best return and values are known."""

import dataclasses
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.spaces import Box

from mathota_envs.base import Environment
from tests.training.toy_environments import ConstantReward, MatchTarget, _advance, _start, ignore
from training.evaluate import evaluate
from training.networks import state_value
from training.normalization import normalize
from training.short_horizon import ShortHorizonActorCritic, discounted_return, train
from training.short_horizon_presets import ShortHorizonHyperparameters

SMALL = ShortHorizonHyperparameters(
    worlds=16, steps=20_000, horizon=8, actor_learning_rate=1e-2, critic_epochs=2, evaluations=4
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Push(Environment):
    """The state moves by the action; the reward is minus its square. It always starts at 1 and never ends."""

    max_episode_steps: int | None = None

    def __post_init__(self):
        super().__post_init__()
        self.set_derived(observation_space=Box(-9.0, 9.0, (1,)), action_space=Box(-1.0, 1.0, (1,)), dt=1.0)

    def reset(self, key, options=None):
        return _start(key, jnp.ones(1)), jnp.ones(1)

    def step(self, env_state, action, model=None):
        state = env_state.state + action
        env_state = _advance(env_state, state)
        return env_state, state, -(state[0] ** 2), jnp.array(False), self.is_truncated(env_state.step_count), {}


@pytest.mark.parametrize(("bound", "worlds"), [(1e4, 4), (0.2, 4), (0.2, 8)])
def test_actor_gradient_in_closed_form(bound, worlds):
    """Policy a = b, constant and without noise: x_k = 1 + k b, and the value of x_4 is that of the critic.

    What the return of one world passes back to the state before each step is bounded, however many worlds there are.
    """
    settings = replace(
        SMALL,
        worlds=worlds,
        horizon=4,
        minibatch_count=4,
        discount=0.9,
        initial_log_standard_deviation=-20.0,
        maximum_state_norm=bound,
    )
    learner = ShortHorizonActorCritic(Push(), settings)
    state = learner.initial_state(0)
    layers = jax.tree.map(jnp.zeros_like, state.actor["actor"])
    layers[-1]["bias"] = jnp.array([-0.1])
    actor = {**state.actor, "actor": layers}
    gradient, _ = jax.grad(learner.actor_loss, has_aux=True)(actor, state, jax.random.key(1))

    def value(place):
        return state_value(state.target_critic, normalize(state.moments, place[None, None]))[0]

    places = 1.0 - 0.1 * np.arange(1, 5)
    passed = 0.9**4 * float(jax.grad(value)(jnp.asarray(places[-1])))
    total, unbounded = 0.0, []
    for k in reversed(range(4)):
        by_place = (1 - 0.9) * 0.9**k * -2 * places[k] + passed
        total += by_place  # the action moves the place as it is
        unbounded.append(abs(by_place))
        passed = np.clip(by_place, -bound, bound)
    assert (max(unbounded[:-1]) > bound) == (bound < 1), "the bound must matter in this test, or not at all"
    assert gradient["actor"][-1]["bias"][0] == pytest.approx(-total / 4, rel=1e-4)


def test_pieces_of_episodes():
    """One world terminates in the second of four steps, one is truncated there; both go on with new episodes."""
    reward = jnp.ones((4, 2))
    after = jnp.array([[9.0, 9.0], [5.0, 5.0], [9.0, 9.0], [2.0, 2.0]])
    ends = jnp.array([[False, False], [True, True], [False, False], [False, False]])
    first = jnp.array([True, False])
    value = discounted_return(reward, after, ends & first, ends & ~first, 0.5)
    piece = 1 + 0.5
    assert value == pytest.approx(piece + (piece + 0.25 * 2.0) + (piece + 0.25 * 5.0) + (piece + 0.25 * 2.0))


def test_learns_the_optimal_action():
    environment = MatchTarget()
    policy = train(environment, SMALL, seed=0, report=ignore, should_stop=ignore)
    after = evaluate(policy, environment)
    assert 0.93 * environment.max_episode_steps < after.returns.mean() <= environment.max_episode_steps
    targets = np.linspace(-0.9, 0.9, 19)[:, None].astype(np.float32)
    np.testing.assert_allclose(policy.act(targets), 2 * targets, atol=0.25)


def test_critic_bootstraps_at_truncation():
    """Episodes of 5 steps that are only cut off: a reward of 1 for ever is worth 1 in units of 1 / (1 - discount)."""
    learner = ShortHorizonActorCritic(ConstantReward(terminates=False), replace(SMALL, discount=0.9, steps=60_000))
    state, _ = learner.run(learner.initial_state(0), update_count=300, capacity=300)
    value = float(state_value(state.critic, normalize(state.moments, np.ones((1, 1), np.float32)))[0])
    assert value == pytest.approx(1.0, rel=0.05)
