"""`GymEnv`: a functional environment as a `gymnasium.Env`."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from jax import Array

from mathota_envs.base import Environment
from mathota_envs.compilation import compiled_sooner
from mathota_envs.frames import FrameMaker
from mathota_envs.host import (
    checked_actions,
    checked_reset_options,
    entropy_words,
    info_scalar,
    require_render_mode,
    writable,
)
from mathota_envs.registration import resolve
from mathota_envs.worlds import Worlds, start_world, step_world, world_keys

_start_world, _step_world = compiled_sooner(start_world), compiled_sooner(step_world)


class GymEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Single world for NumPy users; reset and step are compiled on their first call.

    ``reset(seed=)`` seeds `np_random`, from which the random keys of this and all later episodes follow.
    ``reset(options=)`` takes the `reset_options` of the environment.

    Args:
        environment: id (see `mathota_envs.make`) or functional environment.
        render_mode: ``"rgb_array"`` or None.
        width: columns of a picture.
        height: rows of a picture.
        camera: viewpoint; None for the scene's own.
        **options: options of the environment, if it is given by its id.

    Attributes:
        environment: the functional environment.
        env_state: its current `EnvState`; None before the first reset.

    Raises:
        ValueError: the id, an option or the render mode is unknown.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - as declared by gymnasium.Env

    def __init__(
        self,
        environment: str | Environment,
        *,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
        camera: Any = None,
        **options: Any,
    ) -> None:
        self.environment = resolve(environment, options)
        self.metadata = copy.deepcopy(self.environment.metadata)
        require_render_mode(render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        # Copies, because seeding a space must not seed the spaces of other wrappers.
        self.observation_space = copy.deepcopy(self.environment.observation_space)
        self.action_space = copy.deepcopy(self.environment.action_space)
        self.env_state: Any = None
        self._frames = FrameMaker(self.environment, width, height, camera)
        self._key: Array | None = None
        self._key_source: np.random.Generator | None = None

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: seed of this and all later random starts; None goes on with the present ones.
            options: reset options.

        Returns:
            ``(observation, {})``.

        Raises:
            ValueError: an option is unknown, has the wrong shape or is not finite.
        """
        checked_options = checked_reset_options(self.environment, options)
        super().reset(seed=seed)
        if self.np_random is not self._key_source:
            self._key_source = self.np_random
            self._key = world_keys(entropy_words(self._key_source)[None])[0]
        world: Worlds = _start_world(self.environment, self._key, checked_options)
        self._key, self.env_state = world.key, world.env_state
        return writable(world.observation, self.observation_space.dtype), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advances by one control interval.

        Args:
            action: of the shape of `action_space`; clipped to its bounds.

        Returns:
            ``(observation, reward, terminated, truncated, info)``.

        Raises:
            ValueError: the action has the wrong shape.
            ResetNeeded: `reset` was never called.
        """
        if self.env_state is None:
            raise ResetNeeded("call reset before step")
        action = checked_actions(action, self.action_space, type(self.environment).__name__)
        self.env_state, transition = _step_world(self.environment, self.env_state, action)
        return (
            writable(transition.observation, self.observation_space.dtype),
            float(transition.reward),
            bool(transition.terminated),
            bool(transition.truncated),
            {name: info_scalar(value) for name, value in transition.info.items()},
        )

    def render(self) -> np.ndarray | None:
        """Picture of the present state, ``(height, width, 3)`` uint8; None without a render mode.

        Raises:
            ResetNeeded: `reset` was never called.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('render() draws nothing: the environment was made without render_mode="rgb_array"')
            return None
        if self.env_state is None:
            raise ResetNeeded("call reset before render")
        return self._frames.frame(self.env_state.state)


def make_without_time_limit(environment: str, **arguments: Any) -> GymEnv:
    """Entry point for `gymnasium.make`, which limits the episodes itself (see `registration`)."""
    return GymEnv(environment, max_episode_steps=None, **arguments)


make_without_time_limit.metadata = GymEnv.metadata  # type: ignore[attr-defined] - gymnasium.make looks for it
