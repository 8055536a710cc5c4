"""Evaluate a saved policy: ``python -m training.evaluate runs/<run>``."""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mathota_envs import make
from mathota_envs.worlds import start_worlds, step_then_restart
from training.policies import Policy, load_policy
from training.presets import require_whole_number

# Keeps the random starts of evaluations apart from those of training with the same seed.
_EVALUATION_STREAM = 0x4556414C


@dataclass(frozen=True)
class Evaluation:
    """Results of some episodes.

    Attributes:
        returns: ``(episode,)`` undiscounted return of each.
        lengths: ``(episode,)`` steps of each.
        terminated: ``(episode,)`` True where the episode ended by itself, not by the time limit.
        trajectory: Environment states of the first episode before each of its steps; leaves ``(time, ...)``. None
            unless recorded.
    """

    returns: np.ndarray
    lengths: np.ndarray
    terminated: np.ndarray
    trajectory: Any = None

    def summary(self) -> dict[str, float | int]:
        """The figures for ``metrics.json``."""
        return {
            "episodes": len(self.returns),
            "mean_return": float(self.returns.mean()),
            "std_return": float(self.returns.std()),
            "min_return": float(self.returns.min()),
            "max_return": float(self.returns.max()),
            "mean_length": float(self.lengths.mean()),
            "std_length": float(self.lengths.std()),
            "terminated_fraction": float(self.terminated.mean()),
        }

    def __str__(self) -> str:
        figures = self.summary()
        return (
            f"return {figures['mean_return']:.1f} ± {figures['std_return']:.1f}, "
            f"length {figures['mean_length']:.1f} ± {figures['std_length']:.1f} over {figures['episodes']} episodes"
        )


class Evaluator:
    """Runs whole episodes side by side, one in each world.

    Args:
        environment: Functional environment.
        episode_count: Episodes in each evaluation.

    Raises:
        ValueError: If ``episode_count`` is less than 1 or the episodes could go on for ever.
    """

    def __init__(self, environment: Any, episode_count: int) -> None:
        require_whole_number("evaluation episodes", episode_count, minimum=1)
        self.episode_count = episode_count
        if environment.max_episode_steps is None:
            raise ValueError("evaluation needs an environment with a time limit: set its max_episode_steps")
        self._environment = environment

    def run(self, act: Callable[[np.ndarray], np.ndarray], seed: int, record: bool = False) -> Evaluation:
        """Run one episode in each world.

        Args:
            act: ``(episode, observation) -> (episode, action)``.
            seed: Of the random starts; other seeds than the training's own stream even if the number is the same.
            record: Keep the states of the first episode.
        """
        key = jax.random.fold_in(jax.random.key(seed), _EVALUATION_STREAM)
        worlds = start_worlds(self._environment, jax.random.split(key, self.episode_count))
        returns = np.zeros(self.episode_count)
        lengths = np.zeros(self.episode_count, int)
        terminations = np.zeros(self.episode_count, bool)
        running = np.ones(self.episode_count, bool)
        recorded = []
        for _ in range(self._environment.max_episode_steps):
            if record and running[0]:
                recorded.append(_first_world(worlds.env_state))
            actions = act(np.asarray(worlds.observation))
            # The same program as in SB3VecEnv: with as many worlds as in training nothing is compiled again.
            worlds, transition = step_then_restart(self._environment, worlds, actions)
            terminated = np.asarray(transition.terminated)
            returns += np.where(running, np.asarray(transition.reward), 0.0)
            lengths += running
            terminations |= running & terminated
            running &= ~(terminated | np.asarray(transition.truncated))
            if not running.any():
                break
        trajectory = jax.tree.map(lambda *leaves: np.stack(leaves), *recorded) if record else None
        return Evaluation(returns, lengths, terminations, trajectory)


def evaluate(policy: Policy, environment: Any, episode_count: int = 20, seed: int = 0) -> Evaluation:
    """Evaluate a policy once; use an :class:`Evaluator` to compile once and evaluate often."""
    return Evaluator(environment, episode_count).run(policy.act, seed)


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m training.evaluate", description=__doc__)
    parser.add_argument("run", type=Path, help="folder written by training.train")
    parser.add_argument("--episodes", type=int, default=20, help="number of episodes (default 20)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the random starts (default 1)")
    options = parser.parse_args(arguments)
    try:
        environment_id, policy = load_policy(options.run)
        print(f"{environment_id}: {evaluate(policy, make(environment_id), options.episodes, options.seed)}")
    except (ValueError, ImportError, FileNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _first_world(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf[0]), tree)


if __name__ == "__main__":
    sys.exit(main())
