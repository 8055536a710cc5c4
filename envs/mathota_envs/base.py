"""`Environment`: a task as two pure functions, `reset` and `step`, on pytrees. The wrappers build on nothing else."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from jax import Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class EnvState:
    """Everything that changes while an episode runs; a pytree of one world (or of many, with leading axes).

    Attributes:
        state: State of the simulation, a pytree; of the engine a `mathota_jax.State`.
        key: Random key data, uint32, for what the task draws later in the episode. A plain array, so that the whole
            pytree converts to NumPy.
        step_count: () int32, control steps since the start of the episode.
        extras: What the task itself remembers, a pytree.
    """

    state: Any
    key: Array
    step_count: Array
    extras: Any


@dataclasses.dataclass(frozen=True, kw_only=True)
class Environment(abc.ABC):
    """A task in functional form. Subclasses are frozen dataclasses whose fields are the options of the task.

    Two environments of one class with equal options are equal and share their compiled programs. What a subclass
    derives from its options (spaces, model) it sets in `__post_init__` with `set_derived`.

    Attributes:
        max_episode_steps: `step` reports `truncated` from this many steps on; None for never.
        metadata: ``render_modes`` and, where there are any, ``render_fps``.
        reset_options: names and shapes of what `reset` accepts in `options`.
        observation_space: `Box` of one observation, one-dimensional.
        action_space: `Box` of one action, one-dimensional.
        dt: control interval [s]: simulated time of one `step`.
        model: parameters of the simulation, for rendering; None if there is nothing to draw.
    """

    max_episode_steps: int | None = 1000

    reset_options: ClassVar[dict[str, tuple[int, ...]]] = {}
    metadata: dict[str, Any] = dataclasses.field(
        init=False, repr=False, compare=False, default_factory=lambda: {"render_modes": []}
    )
    observation_space: Box = dataclasses.field(init=False, repr=False, compare=False)
    action_space: Box = dataclasses.field(init=False, repr=False, compare=False)
    dt: float = dataclasses.field(init=False, repr=False, compare=False)
    model: Any = dataclasses.field(init=False, repr=False, compare=False, default=None)

    def __post_init__(self) -> None:
        if self.max_episode_steps is not None:
            self.require_whole_number("max_episode_steps", minimum=1)

    @abc.abstractmethod
    def reset(self, key: Array, options: Mapping[str, Array] | None = None) -> tuple[EnvState, Array]:
        """Starts an episode of one world. Pure; for many worlds use `jax.vmap`.

        Args:
            key: random key (`jax.random.key`) or its data.
            options: what to use instead of the random start, by the names in `reset_options`.

        Returns:
            ``(env_state, observation)``.

        Raises:
            ValueError: an option is unknown or has the wrong shape.
        """

    @abc.abstractmethod
    def step(
        self, env_state: EnvState, action: Array, model: Any = None
    ) -> tuple[EnvState, Array, Array, Array, Array, dict[str, Array]]:
        """Advances one world by one control interval. Pure and differentiable; never resets; compiled by itself.

        Args:
            env_state: where the world stands.
            action: of the shape of `action_space`; clipped to its bounds.
            model: parameters to use in place of `self.model`, to differentiate with respect to them or to give every
                world its own.

        Returns:
            ``(env_state, observation, reward, terminated, truncated, info)``: reward () float, terminated and
            truncated () bool, which can both be true; info a flat dictionary of arrays.

        Raises:
            ValueError: the action has the wrong shape.
        """

    def set_derived(self, **values: Any) -> None:
        """Sets attributes that follow from the options; only for `__post_init__`."""
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def require_whole_number(self, name: str, minimum: int) -> None:
        """Raises ValueError unless the option `name` is an integer of at least `minimum`."""
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
            raise ValueError(f"{type(self).__name__}: {name} must be an integer of at least {minimum}, got {value!r}")

    def require_number(self, name: str, minimum: float = -math.inf, maximum: float = math.inf) -> None:
        """Raises ValueError unless the option `name` is a finite number within the bounds."""
        value = getattr(self, name)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and math.isfinite(value) and minimum <= value <= maximum):
            raise ValueError(
                f"{type(self).__name__}: {name} must be a number between {minimum} and {maximum}, got {value!r}"
            )

    def checked_action(self, action: Any) -> Any:
        """The action as an array, not yet clipped.

        Raises:
            ValueError: its shape is not that of `action_space`.
        """
        action = action if isinstance(action, Array | np.ndarray) else np.asarray(action, self.action_space.dtype)
        if action.shape != self.action_space.shape:
            raise ValueError(
                f"{type(self).__name__}: an action must have shape {self.action_space.shape}, got {action.shape}"
            )
        return action

    def clipped(self, action: Any) -> Array:
        """The action within the bounds of `action_space`."""
        return jnp.clip(action, self.action_space.low, self.action_space.high)

    def checked_reset_options(self, options: Mapping[str, Any] | None) -> dict[str, Array]:
        """The options of a reset as arrays.

        Raises:
            ValueError: the options have no names, or an option is unknown, is no array of numbers or has the wrong shape.
        """
        if options is not None and not isinstance(options, Mapping):
            raise ValueError(
                f"{type(self).__name__}: reset options must be a dict of names and values, got {options!r}"
            )
        checked = {}
        for name, value in (options or {}).items():
            if name not in self.reset_options:
                valid = ", ".join(self.reset_options) or "none"
                raise ValueError(f"{type(self).__name__}: unknown reset option {name!r}; valid options: {valid}")
            try:
                array = jnp.asarray(value, float)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{type(self).__name__}: reset option {name!r} must be numbers: {error}") from error
            if array.shape != self.reset_options[name]:
                raise ValueError(
                    f"{type(self).__name__}: reset option {name!r} must have shape {self.reset_options[name]}, "
                    f"got {array.shape}"
                )
            checked[name] = array
        return checked

    def is_truncated(self, step_count: Array) -> Array:
        """Whether the time limit is reached, () bool."""
        if self.max_episode_steps is None:
            return jnp.zeros(step_count.shape, bool)
        return step_count >= self.max_episode_steps


def key_data(key: Array) -> Array:
    """Plain uint32 data of a random key of either kind."""
    return jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key


def unbounded_box(size: int) -> Box:
    """Space of `size` unlimited float32 numbers."""
    return Box(-np.inf, np.inf, (size,), np.float32)
