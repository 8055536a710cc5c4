"""Train with stable-baselines3's PPO on the ``VecEnv`` of ``mathota_envs``."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from mathota_envs.sb3 import SB3VecEnv
from training.presets import Hyperparameters
from training.sb3_policy import SB3Policy


def train(
    environment: Any,
    hyperparameters: Hyperparameters,
    seed: int,
    report: Callable[[int, float, int], None],
    should_stop: Callable[[SB3Policy], bool],
) -> SB3Policy:
    """Train until the steps are used up or ``should_stop`` says so.

    Args:
        environment: Functional environment.
        hyperparameters: How to train.
        seed: Of networks, worlds and noise.
        report: Told after each rollout: world-steps so far, mean return and number of the episodes that finished.
        should_stop: Asked ``hyperparameters.evaluations`` times with the policy as it stands.
    """
    # The networks are far too small to share between threads, and the simulation needs the cores.
    torch.set_num_threads(1)
    vector_environment = VecNormalize(
        VecMonitor(SB3VecEnv(environment, hyperparameters.worlds, seed=seed)),
        norm_obs=hyperparameters.normalize_observations,
        norm_reward=hyperparameters.normalize_rewards,
        gamma=hyperparameters.discount,
    )
    learning_rate = hyperparameters.learning_rate
    model = PPO(
        "MlpPolicy",
        vector_environment,
        learning_rate=(lambda remaining: learning_rate * remaining) if hyperparameters.anneal else learning_rate,
        n_steps=hyperparameters.rollout_length,
        batch_size=hyperparameters.minibatch_size,
        n_epochs=hyperparameters.epochs,
        gamma=hyperparameters.discount,
        gae_lambda=hyperparameters.trace_decay,
        clip_range=hyperparameters.clip_range,
        ent_coef=hyperparameters.entropy_coefficient,
        vf_coef=hyperparameters.value_coefficient,
        max_grad_norm=hyperparameters.maximum_gradient_norm,
        policy_kwargs={
            "net_arch": list(hyperparameters.hidden_sizes),
            "log_std_init": hyperparameters.initial_log_standard_deviation,
        },
        seed=seed,
        device="cpu",
    )
    try:
        progress = _Progress(hyperparameters, report, lambda: should_stop(_policy(model, vector_environment)))
        model.learn(hyperparameters.steps, callback=progress)
        return _policy(model, vector_environment)
    finally:
        vector_environment.close()


class _Progress(BaseCallback):
    """Reports each rollout and asks between updates whether to stop."""

    def __init__(
        self,
        hyperparameters: Hyperparameters,
        report: Callable[[int, float, int], None],
        should_stop: Callable[[], bool],
    ) -> None:
        super().__init__()
        self._report = report
        self._should_stop = should_stop
        self._interval = -(-hyperparameters.update_count // hyperparameters.evaluations)
        self._updates = 0
        self._finished_returns: list[float] = []
        self._stop = False

    def _on_rollout_start(self) -> None:
        # Here and not at the end of a rollout: the policy that is judged must be the one that is kept.
        if self._updates and self._updates % self._interval == 0:
            self._stop = self._should_stop()

    def _on_step(self) -> bool:
        if self._stop:
            return False
        if self.locals["dones"].any():
            self._finished_returns += [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
        return True

    def _on_rollout_end(self) -> None:
        self._updates += 1
        count = len(self._finished_returns)
        self._report(self.num_timesteps, float(np.mean(self._finished_returns)) if count else 0.0, count)
        self._finished_returns = []


def _policy(model: PPO, environment: VecNormalize) -> SB3Policy:
    statistics = environment.obs_rms if environment.norm_obs else None
    if isinstance(statistics, RunningMeanStd):
        return SB3Policy(model, statistics.mean.copy(), statistics.var.copy())
    size = environment.observation_space.shape or ()
    return SB3Policy(model, np.zeros(size), np.ones(size))
