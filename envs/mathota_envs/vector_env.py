"""`GymVectorEnv`: many worlds of one environment as a `gymnasium.vector.VectorEnv`, one compiled call a step."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import jax.numpy as jnp
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jax import Array

from mathota_envs.base import Environment
from mathota_envs.frames import FrameMaker
from mathota_envs.host import (
    checked_actions,
    checked_reset_options,
    entropy_words,
    repeated,
    require_render_mode,
    require_world_count,
    seed_entropy,
    writable,
)
from mathota_envs.registration import resolve
from mathota_envs.worlds import (
    Transition,
    Worlds,
    restart_worlds,
    start_worlds,
    step_or_restart,
    step_then_restart,
    step_worlds,
    world_keys,
)


class GymVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many worlds in one array program, with the semantics of `gymnasium.vector.SyncVectorEnv`.

    World `i` behaves like a `GymEnv` that was reset with the same seed. All results are writable NumPy copies.

    Args:
        environment: id (see `mathota_envs.make`) or functional environment.
        num_envs: number of worlds.
        autoreset_mode: when a finished world starts anew: ``AutoresetMode.NEXT_STEP`` (default), ``SAME_STEP`` or
            ``DISABLED``, or the value of one.
        render_mode: ``"rgb_array"`` or None.
        width: columns of a picture.
        height: rows of a picture.
        camera: viewpoint; None for the scene's own.
        **options: options of the environment, if it is given by its id.

    Attributes:
        environment: the functional environment.
        worlds: where the worlds stand (`mathota_envs.worlds.Worlds`); None before the first reset.

    Raises:
        ValueError: the id, an option, the autoreset mode or the render mode is unknown, or `num_envs` is not positive.
    """

    def __init__(
        self,
        environment: str | Environment,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
        camera: Any = None,
        **options: Any,
    ) -> None:
        self.environment = resolve(environment, options)
        self.num_envs = require_world_count(num_envs)
        self.autoreset_mode = _checked_autoreset_mode(autoreset_mode)
        self.metadata = {**copy.deepcopy(self.environment.metadata), "autoreset_mode": self.autoreset_mode}
        require_render_mode(render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.single_observation_space = copy.deepcopy(self.environment.observation_space)
        self.single_action_space = copy.deepcopy(self.environment.action_space)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.worlds: Worlds | None = None
        self._frames = FrameMaker(self.environment, width, height, camera)
        self._done = np.zeros(self.num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: one seed for each world, or an integer `s` for the seeds s, s + 1, ...; None, for all or for some
                worlds, goes on with the present random keys.
            options: reset options, the same for every world; ``options["reset_mask"]``, a bool array ``(world,)``,
                restricts the reset to some worlds.

        Returns:
            ``(observations, {})``; worlds that are not reset show their latest observation.

        Raises:
            ValueError: the number of seeds is wrong, the mask has the wrong shape or selects nothing, or an option is
                unknown, has the wrong shape or is not finite.
            TypeError: the mask is not a NumPy array of bool.
            ResetNeeded: a mask was given before the first full reset.
        """
        mask = None
        if isinstance(options, Mapping):
            options = dict(options)
            mask = self._checked_mask(options.pop("reset_mask", None))
        single_options = checked_reset_options(self.environment, options)
        world_options = repeated(single_options, self.num_envs)
        key = self._checked_keys(seed)
        if self.worlds is None or mask is None:
            worlds = start_worlds(self.environment, key, world_options)
            self._done[:] = False
        else:
            worlds = restart_worlds(self.environment, self.worlds, mask, key, world_options)
            self._done[mask] = False
        self.worlds = worlds
        return writable(worlds.observation, self.single_observation_space.dtype), {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances every world by one control interval, or restarts it where the autoreset mode says so.

        Args:
            actions: of the shape of `action_space`; clipped to its bounds.

        Returns:
            ``(observations, rewards, terminations, truncations, infos)``. Each entry ``name`` of `infos` comes with a
            mask ``_name`` of the worlds that it concerns. In the mode ``SAME_STEP`` a finished world shows the first
            observation of its new episode, and ``final_obs`` and ``final_info`` hold the last of the old one.

        Raises:
            ValueError: the actions have the wrong shape.
            ResetNeeded: `reset` was never called, or the mode is ``DISABLED`` and a finished world was not reset.
        """
        if self.worlds is None:
            raise ResetNeeded("call reset before step")
        actions = checked_actions(actions, self.action_space, type(self.environment).__name__)
        restarted = np.zeros(self.num_envs, bool)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            restarted = self._done
            worlds, transition = step_or_restart(self.environment, self.worlds, actions, restarted)
        elif self.autoreset_mode is AutoresetMode.SAME_STEP:
            worlds, transition = step_then_restart(self.environment, self.worlds, actions)
        else:
            if self._done.any():
                raise ResetNeeded(
                    f"worlds {np.flatnonzero(self._done).tolist()} are finished: with autoreset_mode DISABLED call "
                    'reset(options={"reset_mask": terminations | truncations}) before the next step'
                )
            worlds, transition = step_worlds(self.environment, self.worlds, actions)
        self.worlds = worlds
        terminations, truncations = writable(transition.terminated), writable(transition.truncated)
        self._done = terminations | truncations
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            infos = self._same_step_infos(transition, self._done)
        else:
            infos = _masked_infos(transition.info, ~restarted)
        return (
            writable(worlds.observation, self.single_observation_space.dtype),
            writable(transition.reward, np.float64),
            terminations,
            truncations,
            infos,
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Picture of every world, each ``(height, width, 3)`` uint8; None without a render mode.

        Raises:
            ResetNeeded: `reset` was never called.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('render() draws nothing: the environment was made without render_mode="rgb_array"')
            return None
        if self.worlds is None:
            raise ResetNeeded("call reset before render")
        return self._frames.frames(self.worlds.env_state.state, range(self.num_envs))

    def _checked_keys(self, seed: int | Sequence[int | None] | None) -> Array:
        """Keys of all worlds after seeding: those without a seed keep the present ones, or get random ones at first."""
        if seed is None:
            if self.worlds is not None:
                return self.worlds.key
            return world_keys(np.stack([entropy_words(self.np_random) for _ in range(self.num_envs)]))
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
            return world_keys(seed_entropy([int(seed) + world for world in range(self.num_envs)]))
        if len(seed) != self.num_envs:
            raise ValueError(f"seed must hold one seed for each of the {self.num_envs} worlds, got {len(seed)}")
        seeded = world_keys(seed_entropy(seed))
        if self.worlds is None:
            return seeded
        return jnp.where(np.array([single is None for single in seed]), self.worlds.key, seeded)

    def _checked_mask(self, mask: Any) -> np.ndarray | None:
        if mask is None:
            return None
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            kind = mask.dtype if isinstance(mask, np.ndarray) else type(mask).__name__
            raise TypeError(f"options['reset_mask'] must be a NumPy array of bool, got {kind}")
        if mask.shape != (self.num_envs,):
            raise ValueError(f"options['reset_mask'] must have shape ({self.num_envs},), got {mask.shape}")
        if not mask.any():
            raise ValueError("options['reset_mask'] must select at least one world")
        if self.worlds is None and not mask.all():
            raise ResetNeeded("reset all worlds before resetting some with options['reset_mask']")
        return mask

    def _same_step_infos(self, transition: Transition, done: np.ndarray) -> dict[str, Any]:
        infos = _masked_infos(transition.info, ~done)
        if done.any():
            final = writable(transition.observation, self.single_observation_space.dtype)
            observations = np.full(self.num_envs, None, dtype=object)
            for world in np.flatnonzero(done):
                observations[world] = final[world].copy()
            infos |= {"final_obs": observations, "_final_obs": done.copy()}
            infos |= {"final_info": _masked_infos(transition.info, done), "_final_info": done.copy()}
        return infos


def _checked_autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        valid = ", ".join(repr(valid.value) for valid in AutoresetMode)
        raise ValueError(f"unknown autoreset_mode {mode!r}; valid: AutoresetMode or {valid}") from None


def _masked_infos(info: dict[str, Array], mask: np.ndarray) -> dict[str, Any]:
    """Entries of the worlds of the mask, zero elsewhere, each with its mask; nothing if the mask is empty."""
    if not mask.any():
        return {}
    infos: dict[str, Any] = {}
    for name, values in info.items():
        array = writable(values)
        array[~mask] = 0
        infos |= {name: array, f"_{name}": mask.copy()}
    return infos
