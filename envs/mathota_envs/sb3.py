"""`SB3VecEnv`: many worlds of one environment as a stable-baselines3 `VecEnv`, one compiled call a step."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError(
        "mathota_envs.sb3 needs stable-baselines3; install it with: pip install 'mathota-jax[train]'"
    ) from error

from mathota_envs.base import Environment
from mathota_envs.frames import FrameMaker
from mathota_envs.host import (
    checked_actions,
    checked_reset_options,
    require_render_mode,
    require_world_count,
    seed_entropy,
    writable,
)
from mathota_envs.registration import resolve
from mathota_envs.worlds import Transition, Worlds, restart_worlds, start_worlds, step_then_restart, world_keys

Indices = int | Iterable[int] | None


class SB3VecEnv(VecEnv):
    """Many worlds in one array program, with the semantics of stable-baselines3's `DummyVecEnv`.

    A finished world restarts within the step: its info holds ``terminal_observation`` (the last observation of the old
    episode) and ``TimeLimit.truncated`` (the episode was cut off, not ended by the task). All results are NumPy copies,
    since stable-baselines3 writes into them.

    The worlds share one functional environment. `get_attr` and `env_method` reach its attributes and methods;
    `set_attr` can add attributes to worlds but not change the environment.

    Args:
        environment: id (see `mathota_envs.make`) or functional environment.
        num_envs: number of worlds.
        seed: seed of the first reset (world `i` gets ``seed + i``); None for random starts.
        render_mode: ``"rgb_array"`` or None.
        width: columns of a picture.
        height: rows of a picture.
        camera: viewpoint; None for the scene's own.
        **options: options of the environment, if it is given by its id.

    Raises:
        ValueError: the id, an option or the render mode is unknown, or `num_envs` is not positive.
    """

    def __init__(
        self,
        environment: str | Environment,
        num_envs: int = 1,
        *,
        seed: int | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
        camera: Any = None,
        **options: Any,
    ) -> None:
        self.environment = resolve(environment, options)
        world_count = require_world_count(num_envs)
        if render_mode is not None:
            require_render_mode(render_mode, self.environment.metadata["render_modes"])
        self.worlds: Worlds | None = None
        self._attributes: list[dict[str, Any]] = [{"render_mode": render_mode} for _ in range(world_count)]
        self._frames = FrameMaker(self.environment, width, height, camera)
        self._pending: Transition | None = None
        super().__init__(
            world_count,
            copy.deepcopy(self.environment.observation_space),
            copy.deepcopy(self.environment.action_space),
        )
        self._batched_action_space = gymnasium.vector.utils.batch_space(self.action_space, world_count)
        if seed is not None:
            self.seed(seed)

    def reset(self) -> np.ndarray:
        """Starts an episode in every world, with the seeds and options that were set since the last reset.

        Returns:
            First observations ``(world, observation)``.

        Raises:
            ValueError: an option is unknown, has the wrong shape or is not finite.
        """
        options = [checked_reset_options(self.environment, single) or {} for single in self._options]
        key = self._next_keys()
        worlds = start_worlds(self.environment, key)
        for names in {tuple(sorted(single)) for single in options if single}:
            mask = np.array([tuple(sorted(single)) == names for single in options])
            # Worlds outside the mask need some values of the right shape.
            rows = [single if chosen else options[mask.argmax()] for single, chosen in zip(options, mask, strict=True)]
            stacked = jax.tree.map(lambda *values: jnp.stack(values), *rows)
            worlds = restart_worlds(self.environment, worlds, mask, key, stacked)
        self.worlds = worlds
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        self._pending = None
        return writable(worlds.observation, self.observation_space.dtype)

    def step_async(self, actions: np.ndarray) -> None:
        """Starts the step on the device; `step_wait` fetches it.

        Raises:
            ValueError: the actions have the wrong shape.
            RuntimeError: `reset` was never called, or a step is under way.
        """
        if self.worlds is None:
            raise RuntimeError("call reset before step")
        if self._pending is not None:
            raise RuntimeError("call step_wait before the next step_async")
        actions = checked_actions(actions, self._batched_action_space, type(self.environment).__name__)
        self.worlds, self._pending = step_then_restart(self.environment, self.worlds, actions)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Results of the step begun by `step_async`.

        Returns:
            ``(observations, rewards, dones, infos)``: ``(world, observation)``, ``(world,)`` float32, ``(world,)`` bool
            and one dictionary for each world.

        Raises:
            RuntimeError: no step is under way.
        """
        if self.worlds is None or self._pending is None:
            raise RuntimeError("call step_async before step_wait")
        transition, self._pending = self._pending, None
        terminated, truncated = np.asarray(transition.terminated), np.asarray(transition.truncated)
        dones = terminated | truncated
        columns = {name: np.asarray(values).tolist() for name, values in transition.info.items()}
        columns["TimeLimit.truncated"] = (truncated & ~terminated).tolist()
        infos = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        if dones.any():
            final = writable(transition.observation, self.observation_space.dtype)
            for world in np.flatnonzero(dones):
                infos[world]["terminal_observation"] = final[world].copy()
                self.reset_infos[world] = {}
        observations = writable(self.worlds.observation, self.observation_space.dtype)
        return observations, writable(transition.reward, np.float32), dones, infos

    def close(self) -> None:
        """Drops the simulation's state."""
        self.worlds = None
        self._pending = None

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Picture of every world, each ``(height, width, 3)`` uint8; None for each without a render mode.

        Raises:
            RuntimeError: `reset` was never called.
        """
        if self.render_mode != "rgb_array":
            warnings.warn('no pictures: the environment was made without render_mode="rgb_array"', stacklevel=2)
            return [None] * self.num_envs
        return self._images(range(self.num_envs))

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Attribute of each world: what `set_attr` set, or else that of the functional environment.

        Raises:
            AttributeError: there is none of that name.
        """
        return [
            self._attributes[world][attr_name]
            if attr_name in self._attributes[world]
            else getattr(self.environment, attr_name)
            for world in self._worlds_of(indices)
        ]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Sets an attribute of some worlds.

        Raises:
            ValueError: the functional environment, which all worlds share, has an attribute of that name.
        """
        if hasattr(self.environment, attr_name):
            raise ValueError(
                f"cannot set {attr_name!r}: the worlds share one immutable environment; "
                "make a new SB3VecEnv with other options"
            )
        for world in self._worlds_of(indices):
            self._attributes[world][attr_name] = value

    def env_method(self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any) -> list:
        """Result, for each world, of a method of the functional environment, or of ``render``.

        Raises:
            AttributeError: there is no method of that name.
        """
        worlds = list(self._worlds_of(indices))
        if method_name == "render":
            return list(self._images(worlds)) if self.render_mode == "rgb_array" else [None] * len(worlds)
        return [getattr(self.environment, method_name)(*method_args, **method_kwargs) for _ in worlds]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: Indices = None) -> list[bool]:
        """False for each world: there are no wrappers inside."""
        return [False for _ in self._worlds_of(indices)]

    def _next_keys(self) -> Any:
        """Keys of the next episodes: from the seeds that were set, else the present ones, else random."""
        unseeded = np.array([seed is None for seed in self._seeds])
        if self.worlds is not None and unseeded.all():
            return self.worlds.key
        seeded = world_keys(seed_entropy(self._seeds))
        return seeded if self.worlds is None else jnp.where(unseeded, self.worlds.key, seeded)

    def _images(self, worlds: Iterable[int]) -> tuple[np.ndarray, ...]:
        if self.worlds is None:
            raise RuntimeError("call reset before asking for pictures")
        return self._frames.frames(self.worlds.env_state.state, worlds)

    def _worlds_of(self, indices: Indices) -> Iterable[int]:
        """World numbers of `indices`, which may be negative; IndexError for a world that does not exist."""
        return [range(self.num_envs)[world] for world in self._get_indices(indices)]
