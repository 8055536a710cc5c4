"""Many worlds of one environment side by side: the compiled functions behind the wrappers for NumPy users.

Every array has a leading world axis. The environment is a static argument, so wrappers of equal environments share one
compilation. Each world owns a chain of random keys, which decides all its episodes: world `i` of a batch behaves like a
single environment with the same seed.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax


class Worlds(NamedTuple):
    """Where the worlds stand.

    Attributes:
        env_state: states of the functional environment.
        observation: ``(world, observation)`` latest observations.
        key: ``(world,)`` random keys of the next episodes.
    """

    env_state: Any
    observation: Array
    key: Array


class Transition(NamedTuple):
    """What a step returned, before any reset.

    Attributes:
        observation: ``(world, observation)``.
        reward: ``(world,)``.
        terminated: ``(world,)`` bool.
        truncated: ``(world,)`` bool.
        info: arrays ``(world, ...)`` by name.
    """

    observation: Array
    reward: Array
    terminated: Array
    truncated: Array
    info: dict[str, Array]

    @property
    def done(self) -> Array:
        """``(world,)`` bool, whether the episode ended."""
        return self.terminated | self.truncated


@jax.jit
def world_keys(entropy: Array) -> Array:
    """Random keys from two uint32 words for each world, ``(world, 2) -> (world,)``."""
    return jax.vmap(lambda words: jax.random.fold_in(jax.random.key(words[0]), words[1]))(entropy)


@partial(jax.jit, static_argnums=0)
def start_world(environment: Any, key: Array, options: dict[str, Array] | None = None) -> Worlds:
    """Starts an episode in one world; no world axes.

    Args:
        environment: functional environment, static.
        key: () random key: the head of the world's chain.
        options: reset options, or None.
    """
    next_key, start_key = jax.random.split(key)
    env_state, observation = environment.reset(start_key, *(() if options is None else (options,)))
    return Worlds(env_state, observation, next_key)


@partial(jax.jit, static_argnums=0)
def start_worlds(environment: Any, key: Array, options: dict[str, Array] | None = None) -> Worlds:
    """Starts an episode in every world: `start_world` with a leading world axis on keys and options."""
    return jax.vmap(partial(start_world, environment))(key, options)


@partial(jax.jit, static_argnums=0)
def restart_worlds(
    environment: Any, worlds: Worlds, mask: Array, key: Array | None = None, options: dict[str, Array] | None = None
) -> Worlds:
    """Starts new episodes in the worlds of the mask; the others stay as they are.

    Args:
        environment: functional environment, static.
        worlds: where the worlds stand.
        mask: ``(world,)`` bool.
        key: ``(world,)`` keys to continue with; None for those of the worlds.
        options: reset options with a leading world axis, or None.
    """
    fresh = start_worlds(environment, worlds.key if key is None else key, options)
    return select_worlds(mask, fresh, worlds)


@partial(jax.jit, static_argnums=0)
def step_world(environment: Any, env_state: Any, action: Array) -> tuple[Any, Transition]:
    """Steps one world; no world axes."""
    env_state, *results = environment.step(env_state, action)
    return env_state, Transition(*results)


@partial(jax.jit, static_argnums=0)
def step_worlds(environment: Any, worlds: Worlds, action: Array) -> tuple[Worlds, Transition]:
    """Steps every world; no resets (autoreset mode "disabled")."""
    env_state, transition = jax.vmap(partial(step_world, environment))(worlds.env_state, action)
    return Worlds(env_state, transition.observation, worlds.key), transition


@partial(jax.jit, static_argnums=0)
def step_then_restart(environment: Any, worlds: Worlds, action: Array) -> tuple[Worlds, Transition]:
    """Steps every world and restarts at once those that are done (autoreset mode "same step").

    Returns:
        The worlds, with the first observations of new episodes, and the transition, with the last of the old ones.
    """
    worlds, transition = step_worlds(environment, worlds, action)
    return _restart_if_any(environment, worlds, transition.done), transition


@partial(jax.jit, static_argnums=0)
def step_or_restart(environment: Any, worlds: Worlds, action: Array, restart: Array) -> tuple[Worlds, Transition]:
    """Steps the worlds, except those to `restart`, whose action is ignored (autoreset mode "next step").

    Returns:
        The worlds and the transition: with reward 0, not done and the first observation where a world restarted.
    """
    worlds, transition = step_worlds(environment, worlds, action)
    worlds = _restart_if_any(environment, worlds, restart)
    return worlds, transition._replace(
        observation=worlds.observation,
        reward=jnp.where(restart, 0.0, transition.reward),
        terminated=transition.terminated & ~restart,
        truncated=transition.truncated & ~restart,
    )


def select_worlds(mask: Array, when_true: Any, when_false: Any) -> Any:
    """Chooses whole worlds from one of two pytrees of equal structure by a ``(world,)`` mask."""

    def select(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (b.ndim - 1)), a, b)

    return jax.tree.map(select, when_true, when_false)


def _restart_if_any(environment: Any, worlds: Worlds, mask: Array) -> Worlds:
    # The predicate is one number for the whole batch, so most steps skip the work of resetting.
    return lax.cond(mask.any(), lambda: restart_worlds(environment, worlds, mask), lambda: worlds)
