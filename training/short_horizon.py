"""Short-horizon actor-critic (SHAC): the policy follows the gradient of the simulated return itself.

J. Xu et al., "Accelerated Policy Learning with Parallel Differentiable Simulation", 2022,
https://arxiv.org/abs/2204.07137: the return of a few steps is differentiated through environment and policy, a slowly
moving critic stands for what comes after, and episodes go on from update to update with the gradient cut in between.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array, lax

from mathota_jax.gradients import clip_cotangent
from training.actions import ActionBounds
from training.gae import generalized_advantages
from training.jax_policy import JaxPolicy
from training.learning import BlockOfUpdates, learn
from training.networks import Parameters, action_mean, initial_parameters, log_probability, state_value
from training.normalization import RunningMoments, initial_moments, normalize, update_moments
from training.rollouts import RunningEpisodes, Steps, collect, start_episodes
from training.short_horizon_presets import ShortHorizonHyperparameters

_FINAL_RATE = 0.1
"""Share of the learning rates that is left at the end."""


class TrainingState(NamedTuple):
    """Everything that changes during training."""

    actor: Parameters
    critic: Parameters
    target_critic: Parameters
    actor_optimizer: Any
    critic_optimizer: Any
    moments: RunningMoments
    episodes: RunningEpisodes
    key: Array


class UpdateMetrics(NamedTuple):
    """Scalars of one update; ``return_sum`` adds up the returns of the episodes that finished in it."""

    finished_episodes: Array
    return_sum: Array
    actor_loss: Array
    critic_loss: Array
    gradient_norm: Array


@dataclass(frozen=True)
class BoundedSensitivity:
    """An environment whose state passes back bounded cotangents, in each world and step; values are the same.

    Attributes:
        environment: Functional environment.
        largest_norm: See `clip_cotangent`.
    """

    environment: Any
    largest_norm: float

    def reset(self, key: Array, options: Any = None) -> Any:
        return self.environment.reset(key, options)

    def step(self, env_state: Any, action: Array) -> Any:
        return self.environment.step(clip_cotangent(env_state, self.largest_norm), action)


class ShortHorizonActorCritic(BlockOfUpdates):
    """The learner for one functional environment.

    Args:
        environment: Functional, differentiable environment (``reset``, ``step``, ``observation_space``,
            ``action_space``).
        hyperparameters: How to train.
    """

    metrics = UpdateMetrics

    def __init__(self, environment: Any, hyperparameters: ShortHorizonHyperparameters) -> None:
        super().__init__()
        # The loss is the mean over these steps: what one world passes back is so much smaller than of its own return.
        step_count = hyperparameters.worlds * hyperparameters.rollout_length
        self.environment = BoundedSensitivity(environment, hyperparameters.maximum_state_norm / step_count)
        self.hyperparameters = hyperparameters
        self.bounds = ActionBounds.of(environment.action_space)
        self.observation_size = int(np.prod(environment.observation_space.shape))
        updates = hyperparameters.update_count
        critic_steps = updates * hyperparameters.critic_epochs * hyperparameters.minibatch_count
        self.actor_optimizer = self._adam(hyperparameters.actor_learning_rate, updates)
        self.critic_optimizer = self._adam(hyperparameters.critic_learning_rate, critic_steps)

    def _adam(self, rate: float, steps: int) -> optax.GradientTransformation:
        schedule = optax.linear_schedule(rate, _FINAL_RATE * rate, steps)
        return optax.chain(
            optax.clip_by_global_norm(self.hyperparameters.maximum_gradient_norm),
            optax.adam(schedule, b1=0.7, b2=0.95),  # of the paper: the loss moves with the policy
        )

    def initial_state(self, seed: int) -> TrainingState:
        """Fresh networks and worlds."""
        network_key, world_key, key = jax.random.split(jax.random.key(seed), 3)
        networks = initial_parameters(
            network_key,
            self.observation_size,
            self.bounds.size,
            self.hyperparameters.hidden_sizes,
            self.hyperparameters.initial_log_standard_deviation,
        )
        critic = {"critic": networks.pop("critic")}
        return TrainingState(
            networks,
            critic,
            critic,
            self.actor_optimizer.init(networks),
            self.critic_optimizer.init(critic),
            initial_moments(self.observation_size),
            start_episodes(self.environment, world_key, self.hyperparameters.worlds),
            key,
        )

    def policy(self, state: TrainingState) -> JaxPolicy:
        """The deterministic policy as it stands, independent of the learner."""
        return JaxPolicy(
            jax.tree.map(np.asarray, state.actor["actor"]),
            np.asarray(state.moments.mean),
            np.asarray(state.moments.variance),
            self.bounds,
        )

    def update(self, state: TrainingState) -> tuple[TrainingState, UpdateMetrics]:
        """One rollout, one step of the actor along its gradient, and the steps of the critic."""
        rollout_key, shuffle_key, key = jax.random.split(state.key, 3)
        gradient, (loss, episodes, steps) = jax.grad(self.actor_loss, has_aux=True)(state.actor, state, rollout_key)
        change, actor_optimizer = self.actor_optimizer.update(gradient, state.actor_optimizer, state.actor)
        critic, critic_optimizer, critic_loss = self._fit_critic(state, steps, shuffle_key)
        keep = self.hyperparameters.target_decay
        new = TrainingState(
            jax.tree.map(jnp.add, state.actor, change),
            critic,
            jax.tree.map(lambda old, new: keep * old + (1 - keep) * new, state.target_critic, critic),
            actor_optimizer,
            critic_optimizer,
            update_moments(state.moments, steps.observation),
            episodes,
            key,
        )
        done = steps.terminated | steps.truncated
        finished = done.sum().astype(jnp.float32)
        norm = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient)))
        returns = jnp.sum(jnp.where(done, steps.episode_return, 0.0))
        return new, UpdateMetrics(finished, returns, loss, critic_loss, norm)

    def actor_loss(
        self, actor: Parameters, state: TrainingState, key: Array
    ) -> tuple[Array, tuple[Array, RunningEpisodes, Steps]]:
        """Minus the mean return of the horizon, per step and in units of 1 / (1 - discount); differentiable."""
        act = partial(self._act, actor, state.moments)
        episodes, steps = collect(self.environment, act, state.episodes, key, self.hyperparameters.rollout_length)
        after = state_value(state.target_critic, normalize(state.moments, steps.next_observation))
        reward = self._scaled(steps.reward)
        value = discounted_return(reward, after, steps.terminated, steps.truncated, self.hyperparameters.discount)
        loss = -value / reward.size
        return loss, lax.stop_gradient((loss, episodes, steps))

    def _scaled(self, reward: Array) -> Array:
        """A constant reward of 1 for ever is worth 1."""
        return (1 - self.hyperparameters.discount) * reward

    def _act(
        self, actor: Parameters, moments: RunningMoments, observations: Array, key: Array
    ) -> tuple[Array, Array, Array]:
        mean = action_mean(actor, normalize(moments, observations))
        log_standard_deviation = actor["log_standard_deviation"]
        raw_action = mean + jnp.exp(log_standard_deviation) * jax.random.normal(key, mean.shape, mean.dtype)
        return raw_action, self.bounds.from_unit(raw_action), log_probability(mean, log_standard_deviation, raw_action)

    def _fit_critic(self, state: TrainingState, steps: Steps, key: Array) -> tuple[Parameters, Any, Array]:
        hyperparameters = self.hyperparameters
        observations = normalize(state.moments, steps.observation)
        _, targets = generalized_advantages(
            self._scaled(steps.reward),
            state_value(state.target_critic, observations),
            state_value(state.target_critic, normalize(state.moments, steps.next_observation)),
            steps.terminated,
            steps.truncated,
            hyperparameters.discount,
            hyperparameters.trace_decay,
        )
        samples = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (observations, targets))

        def error(critic: Parameters, minibatch: tuple[Array, Array]) -> Array:
            observation, target = minibatch
            return jnp.mean((state_value(critic, observation) - target) ** 2)

        def descend(
            carry: tuple[Parameters, Any], minibatch: tuple[Array, Array]
        ) -> tuple[tuple[Parameters, Any], Any]:
            critic, optimizer = carry
            loss, gradient = jax.value_and_grad(error)(critic, minibatch)
            change, optimizer = self.critic_optimizer.update(gradient, optimizer, critic)
            return (jax.tree.map(jnp.add, critic, change), optimizer), loss

        def epoch(carry: tuple[Parameters, Any], epoch_key: Array) -> tuple[tuple[Parameters, Any], Any]:
            order = jax.random.permutation(epoch_key, targets.size)
            shuffled = jax.tree.map(
                lambda leaf: leaf[order].reshape(hyperparameters.minibatch_count, -1, *leaf.shape[1:]), samples
            )
            return lax.scan(descend, carry, shuffled)

        keys = jax.random.split(key, hyperparameters.critic_epochs)
        (critic, optimizer), losses = lax.scan(epoch, (state.critic, state.critic_optimizer), keys)
        return critic, optimizer, losses.mean()


def discounted_return(reward: Array, after: Array, terminated: Array, truncated: Array, discount: float) -> Array:
    """Sum over all worlds of the discounted rewards of each piece of an episode in the rollout, with what comes after.

    Discounting starts anew with every episode. A piece that terminates has no future; one that is cut off, by the time
    limit or the end of the rollout, is followed by the value where it was cut.

    Args:
        reward: ``(time, world)``.
        after: ``(time, world)`` value of the observation after each step, before any reset.
        terminated: ``(time, world)`` bool.
        truncated: ``(time, world)`` bool.
        discount: Discount per step.
    """
    is_last = jnp.arange(len(reward))[:, None] == len(reward) - 1
    cut = (truncated | is_last) & ~terminated

    def next_weight(weight: Array, done: Array) -> tuple[Array, Array]:
        return jnp.where(done, 1.0, discount * weight), weight

    _, weight = lax.scan(next_weight, jnp.ones_like(reward[0]), terminated | truncated)
    return jnp.sum(weight * (reward + jnp.where(cut, discount * after, 0.0)))


def train(
    environment: Any,
    hyperparameters: ShortHorizonHyperparameters,
    seed: int,
    report: Callable[[int, float, int], None],
    should_stop: Callable[[JaxPolicy], bool],
) -> JaxPolicy:
    """Train until the steps are used up or ``should_stop`` says so; arguments as for `training.ppo.train`.

    Raises:
        DivergedError: If a loss or a gradient is no longer finite.
    """
    return learn(ShortHorizonActorCritic(environment, hyperparameters), hyperparameters, seed, report, should_stop)
