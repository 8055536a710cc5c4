"""The loop that every learner on the device shares: blocks of updates, reports, evaluations, an early stop."""

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from training.jax_policy import JaxPolicy


class DivergedError(FloatingPointError):
    """The losses or the parameters are no longer finite."""


class Learner(Protocol):
    """What learns: pure updates of a state, compiled by `run`."""

    def initial_state(self, seed: int) -> Any:
        """Fresh networks and worlds."""
        ...

    def run(self, state: Any, update_count: int, capacity: int) -> tuple[Any, Any]:
        """Some updates; the new state and the metrics, leading axis ``update_count``."""
        ...

    def policy(self, state: Any) -> JaxPolicy:
        """The deterministic policy as it stands."""
        ...


class BlockOfUpdates:
    """`Learner.run` for a learner with one pure `update` of its state.

    Attributes:
        metrics: Named tuple of what an update reports, scalars.
    """

    metrics: Any

    def __init__(self) -> None:
        self._run = jax.jit(self._run_updates, static_argnums=2)

    def update(self, state: Any) -> tuple[Any, Any]:
        """The new state and the metrics of one update. Pure."""
        raise NotImplementedError

    def run(self, state: Any, update_count: int, capacity: int) -> tuple[Any, Any]:
        """Run some updates in one call on the device.

        Args:
            state: Where to begin.
            update_count: At most ``capacity``; changing it compiles nothing anew.
            capacity: Room for metrics.

        Returns:
            The new state and the metrics with a leading axis of ``update_count``.
        """
        state, metrics = self._run(state, update_count, capacity)
        return state, jax.tree.map(lambda values: np.asarray(values)[:update_count], metrics)

    def _run_updates(self, state: Any, update_count: Array, capacity: int) -> tuple[Any, Any]:
        def body(index: Array, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            state, recorded = carry
            state, metrics = self.update(state)
            return state, jax.tree.map(lambda all, one: all.at[index].set(one), recorded, metrics)

        empty = self.metrics(*(jnp.zeros(capacity, jnp.float32) for _ in self.metrics._fields))
        return lax.fori_loop(0, update_count, body, (state, empty))


class Schedule(Protocol):
    """How long to learn."""

    @property
    def worlds(self) -> int: ...
    @property
    def evaluations(self) -> int: ...
    @property
    def rollout_length(self) -> int: ...
    @property
    def update_count(self) -> int: ...


def learn(
    learner: Learner,
    schedule: Schedule,
    seed: int,
    report: Callable[[int, float, int], None],
    should_stop: Callable[[JaxPolicy], bool],
) -> JaxPolicy:
    """Learn until the steps are used up or ``should_stop`` says so.

    Args:
        learner: Whose metrics name the ``finished_episodes`` and the ``return_sum`` of each update.
        schedule: How long.
        seed: Of networks, worlds and noise; the same seed gives the same policy on the same machine.
        report: Told after each update: world-steps so far, mean return and number of the episodes that finished.
        should_stop: Asked ``schedule.evaluations`` times with the policy as it stands.

    Raises:
        DivergedError: If a loss is no longer finite.
    """
    state = learner.initial_state(seed)
    capacity = -(-schedule.update_count // schedule.evaluations)
    samples_per_update = schedule.rollout_length * schedule.worlds
    for first in range(0, schedule.update_count, capacity):
        update_count = min(capacity, schedule.update_count - first)
        state, metrics = learner.run(state, update_count, capacity)
        for index in range(update_count):
            finished = int(metrics.finished_episodes[index])
            mean_return = float(metrics.return_sum[index]) / max(finished, 1)
            report((first + index + 1) * samples_per_update, mean_return, finished)
        if not all(np.isfinite(values).all() for values in metrics):
            raise DivergedError(
                f"training diverged before {(first + update_count) * samples_per_update} steps: a loss is not finite; "
                "lower the learning rate, and check that the environment's observations and rewards are finite"
            )
        if should_stop(learner.policy(state)):
            break
    return learner.policy(state)
