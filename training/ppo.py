"""Proximal policy optimization that runs wholly on the device: rollouts, advantages and updates in one jitted loop."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array, lax

from training.actions import ActionBounds
from training.gae import generalized_advantages
from training.jax_policy import JaxPolicy
from training.learning import BlockOfUpdates, learn
from training.networks import (
    Parameters,
    action_mean,
    entropy,
    initial_parameters,
    log_probability,
    state_value,
)
from training.normalization import RunningMoments, initial_moments, normalize, update_moments
from training.presets import Hyperparameters
from training.return_scale import ReturnScale, initial_return_scale, scale_rewards
from training.rollouts import RunningEpisodes, Steps, collect, start_episodes


class TrainingState(NamedTuple):
    """Everything that changes during training."""

    parameters: Parameters
    optimizer_state: Any
    moments: RunningMoments
    return_scale: ReturnScale
    episodes: RunningEpisodes
    key: Array


class Samples(NamedTuple):
    """The flattened rollout that the losses read; leading axis: sample."""

    observation: Array
    action: Array
    log_probability: Array
    advantage: Array
    value_target: Array


class UpdateMetrics(NamedTuple):
    """Scalars of one update; ``return_sum`` adds up the returns of the episodes that finished in it."""

    finished_episodes: Array
    return_sum: Array
    policy_loss: Array
    value_loss: Array
    entropy: Array
    clipped_fraction: Array


class PPO(BlockOfUpdates):
    """The learner for one functional environment.

    Args:
        environment: Functional environment (``reset``, ``step``, ``observation_space``, ``action_space``).
        hyperparameters: How to train.
    """

    metrics = UpdateMetrics

    def __init__(self, environment: Any, hyperparameters: Hyperparameters) -> None:
        super().__init__()
        self.environment = environment
        self.hyperparameters = hyperparameters
        self.bounds = ActionBounds.of(environment.action_space)
        gradient_steps = hyperparameters.update_count * hyperparameters.epochs * hyperparameters.minibatch_count
        learning_rate = (
            optax.linear_schedule(hyperparameters.learning_rate, 0.0, gradient_steps)
            if hyperparameters.anneal
            else hyperparameters.learning_rate
        )
        self.optimizer = optax.chain(
            optax.clip_by_global_norm(hyperparameters.maximum_gradient_norm),
            optax.adam(learning_rate, eps=1e-5),
        )

    def initial_state(self, seed: int) -> TrainingState:
        """Fresh networks and worlds."""
        network_key, world_key, key = jax.random.split(jax.random.key(seed), 3)
        observation_size = int(np.prod(self.environment.observation_space.shape))
        parameters = initial_parameters(
            network_key,
            observation_size,
            self.bounds.size,
            self.hyperparameters.hidden_sizes,
            self.hyperparameters.initial_log_standard_deviation,
        )
        return TrainingState(
            parameters,
            self.optimizer.init(parameters),
            initial_moments(observation_size),
            initial_return_scale(self.hyperparameters.worlds),
            start_episodes(self.environment, world_key, self.hyperparameters.worlds),
            key,
        )

    def policy(self, state: TrainingState) -> JaxPolicy:
        """The deterministic policy as it stands, independent of the learner."""
        return JaxPolicy(
            jax.tree.map(np.asarray, state.parameters["actor"]),
            np.asarray(state.moments.mean),
            np.asarray(state.moments.variance),
            self.bounds,
        )

    def update(self, state: TrainingState) -> tuple[TrainingState, UpdateMetrics]:
        """One rollout and the gradient steps on it. Pure; :meth:`run` compiles it."""
        rollout_key, shuffle_key, key = jax.random.split(state.key, 3)
        act = partial(self._act, state.parameters, state.moments)
        episodes, steps = collect(
            self.environment, act, state.episodes, rollout_key, self.hyperparameters.rollout_length
        )
        rewards, return_scale = steps.reward, state.return_scale
        if self.hyperparameters.normalize_rewards:
            rewards, return_scale = scale_rewards(
                return_scale, rewards, steps.terminated | steps.truncated, self.hyperparameters.discount
            )
        samples = self._samples(state, steps, rewards)
        parameters, optimizer_state, losses = self._optimize(
            state.parameters, state.optimizer_state, samples, shuffle_key
        )
        moments = state.moments
        if self.hyperparameters.normalize_observations:
            # Only after the gradient steps: the recorded probabilities belong to the old statistics.
            moments = update_moments(moments, steps.observation)
        return (
            TrainingState(parameters, optimizer_state, moments, return_scale, episodes, key),
            _metrics(steps, losses, parameters),
        )

    def _act(
        self, parameters: Parameters, moments: RunningMoments, observations: Array, key: Array
    ) -> tuple[Array, Array, Array]:
        mean = action_mean(parameters, normalize(moments, observations))
        log_standard_deviation = parameters["log_standard_deviation"]
        raw_action = mean + jnp.exp(log_standard_deviation) * jax.random.normal(key, mean.shape, mean.dtype)
        action = self.bounds.from_unit(raw_action)
        return raw_action, action, log_probability(mean, log_standard_deviation, raw_action)

    def _samples(self, state: TrainingState, steps: Steps, rewards: Array) -> Samples:
        observations = normalize(state.moments, steps.observation)
        next_observations = normalize(state.moments, steps.next_observation)
        advantages, value_targets = generalized_advantages(
            rewards,
            state_value(state.parameters, observations),
            state_value(state.parameters, next_observations),
            steps.terminated,
            steps.truncated,
            self.hyperparameters.discount,
            self.hyperparameters.trace_decay,
        )
        samples = Samples(observations, steps.action, steps.log_probability, advantages, value_targets)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), samples)

    def _optimize(
        self, parameters: Parameters, optimizer_state: Any, samples: Samples, key: Array
    ) -> tuple[Parameters, Any, tuple[Array, ...]]:
        minibatch_count = self.hyperparameters.minibatch_count
        sample_count = samples.advantage.shape[0]

        def minibatch_step(carry: tuple[Parameters, Any], minibatch: Samples) -> tuple[tuple[Parameters, Any], Any]:
            parameters, optimizer_state = carry
            gradients, losses = jax.grad(self._loss, has_aux=True)(parameters, minibatch)
            updates, optimizer_state = self.optimizer.update(gradients, optimizer_state, parameters)
            return (jax.tree.map(jnp.add, parameters, updates), optimizer_state), losses

        def epoch(carry: tuple[Parameters, Any], epoch_key: Array) -> tuple[tuple[Parameters, Any], Any]:
            order = jax.random.permutation(epoch_key, sample_count)
            minibatches = jax.tree.map(lambda leaf: leaf[order].reshape(minibatch_count, -1, *leaf.shape[1:]), samples)
            return lax.scan(minibatch_step, carry, minibatches)

        keys = jax.random.split(key, self.hyperparameters.epochs)
        (parameters, optimizer_state), losses = lax.scan(epoch, (parameters, optimizer_state), keys)
        return parameters, optimizer_state, jax.tree.map(jnp.mean, losses)

    def _loss(self, parameters: Parameters, samples: Samples) -> tuple[Array, tuple[Array, ...]]:
        hyperparameters = self.hyperparameters
        log_standard_deviation = parameters["log_standard_deviation"]
        mean = action_mean(parameters, samples.observation)
        ratio = jnp.exp(log_probability(mean, log_standard_deviation, samples.action) - samples.log_probability)
        advantage = (samples.advantage - samples.advantage.mean()) / (samples.advantage.std() + 1e-8)
        policy_loss = -clipped_objective(ratio, advantage, hyperparameters.clip_range).mean()
        value_loss = jnp.mean((state_value(parameters, samples.observation) - samples.value_target) ** 2)
        loss = (
            policy_loss
            + hyperparameters.value_coefficient * value_loss
            - hyperparameters.entropy_coefficient * entropy(log_standard_deviation)
        )
        clipped_fraction = jnp.mean(jnp.abs(ratio - 1) > hyperparameters.clip_range)
        return loss, (policy_loss, value_loss, clipped_fraction)


def train(
    environment: Any,
    hyperparameters: Hyperparameters,
    seed: int,
    report: Callable[[int, float, int], None],
    should_stop: Callable[[JaxPolicy], bool],
) -> JaxPolicy:
    """Train until the steps are used up or ``should_stop`` says so.

    Args:
        environment: Functional environment.
        hyperparameters: How to train.
        seed: Of networks, worlds and noise; the same seed gives the same policy on the same machine.
        report: Told after each update: world-steps so far, mean return and number of the episodes that finished.
        should_stop: Asked ``hyperparameters.evaluations`` times with the policy as it stands.

    Raises:
        DivergedError: If a loss is no longer finite.
    """
    return learn(PPO(environment, hyperparameters), hyperparameters, seed, report, should_stop)


def clipped_objective(ratio: Array, advantage: Array, clip_range: float) -> Array:
    """PPO's objective of each sample: no reward for moving a probability further than the clip range.

    Args:
        ratio: New over old probability of the action.
        advantage: Of the action.
        clip_range: Largest change of the ratio from 1 that pays.
    """
    return jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip_range, 1 + clip_range) * advantage)


def _metrics(steps: Steps, losses: tuple[Array, ...], parameters: Parameters) -> UpdateMetrics:
    done = steps.terminated | steps.truncated
    policy_loss, value_loss, clipped_fraction = losses
    return UpdateMetrics(
        done.sum().astype(jnp.float32),
        jnp.sum(jnp.where(done, steps.episode_return, 0.0)),
        policy_loss,
        value_loss,
        entropy(parameters["log_standard_deviation"]),
        clipped_fraction,
    )
