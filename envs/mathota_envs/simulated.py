"""`SimulatedEnvironment`: what every task on the engine shares. A task adds a scene, a start, a view and a reward."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from jax import Array, lax

from mathota_envs.base import Environment, EnvState, key_data
from mathota_jax import Flag, Model, State, step


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimulatedEnvironment(Environment):
    """Task on the engine.

    A world that becomes non-finite ends its episode: `terminated` with reward 0, ``info["non_finite"]`` true, and the
    non-finite entries of its observation replaced by 0, because learners average over all worlds and one NaN would
    spread to every weight. The other worlds do not notice.

    Attributes:
        frame_skip: time steps in one control step, all under the same action.
        substeps: steps of the engine in one time step: more are more accurate and slower.
        time_step: duration of a time step [s].
        observation_size: entries of the observation.
        action_limit: largest magnitude of each entry of the action.
        rest_state: state of the scene as built.
    """

    frame_skip: int = 1
    substeps: int = 1

    time_step: ClassVar[float]
    observation_size: ClassVar[int]
    action_limit: ClassVar[tuple[float, ...]]
    rest_state: State = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_whole_number("frame_skip", minimum=1)
        self.require_whole_number("substeps", minimum=1)
        # An environment may be made while another function is traced; its model must not keep that trace's values.
        with jax.ensure_compile_time_eval():
            model, rest_state = self.build()
        dt = self.time_step * self.frame_skip
        limit = np.array(self.action_limit, np.float32)
        self.set_derived(
            model=model,
            rest_state=rest_state,
            dt=dt,
            metadata={"render_modes": ["rgb_array"], "render_fps": round(1 / dt)},
            observation_space=Box(-np.inf, np.inf, (self.observation_size,), np.float32),
            action_space=Box(-limit, limit, dtype=np.float32),
        )

    @property
    def engine_step(self) -> float:
        """Duration of one step of the engine [s]."""
        return self.time_step / self.substeps

    @abc.abstractmethod
    def build(self) -> tuple[Model, State]:
        """The scene, with the engine's step of `engine_step` seconds."""

    @abc.abstractmethod
    def start(self, key: Array, options: dict[str, Array]) -> tuple[State, Any]:
        """State at the start of an episode, drawn with `key` except for what the checked options give, and extras."""

    @abc.abstractmethod
    def observe(self, model: Model, env_state: EnvState) -> Array:
        """Observation, ``(observation_size,)``."""

    @abc.abstractmethod
    def judge(self, observation: Array, action: Array) -> tuple[Array, Array, dict[str, Array]]:
        """``(reward, terminated, info)`` of a step from the observation after it and the clipped action."""

    def reset(self, key: Array, options: Mapping[str, Any] | None = None) -> tuple[EnvState, Array]:
        """See `Environment.reset`."""
        return _reset(self, key, self.checked_reset_options(options))

    def step(
        self, env_state: EnvState, action: Any, model: Model | None = None
    ) -> tuple[EnvState, Array, Array, Array, Array, dict[str, Array]]:
        """See `Environment.step`. Another `model` of the same scene does not compile anew."""
        return _step(self, self.model if model is None else model, env_state, self.checked_action(action))


@partial(jax.jit, static_argnums=0)
def _reset(environment: SimulatedEnvironment, key: Array, options: dict[str, Array]) -> tuple[EnvState, Array]:
    start_key, later_key = jax.random.split(key)
    state, extras = environment.start(start_key, options)
    env_state = EnvState(state, key_data(later_key), jnp.zeros((), jnp.int32), extras)
    return env_state, environment.observe(environment.model, env_state)


@partial(jax.jit, static_argnums=0)
def _step(
    environment: SimulatedEnvironment, model: Model, env_state: EnvState, action: Array
) -> tuple[EnvState, Array, Array, Array, Array, dict[str, Array]]:
    action = environment.clipped(action)
    length = environment.frame_skip * environment.substeps
    # A loop, not an unrolled chain: the compile time must not grow with the frame skip.
    state, _ = lax.scan(lambda state, _: (step(model, state, action), None), env_state.state, None, length=length)
    env_state = dataclasses.replace(env_state, state=state, step_count=env_state.step_count + 1)
    raw_observation = environment.observe(model, env_state)
    finite = jnp.isfinite(raw_observation)
    observation = jnp.where(finite, raw_observation, 0.0)
    non_finite = ((state.flags & Flag.NON_FINITE) != 0) | ~finite.all()
    reward, terminated, info = environment.judge(observation, action)
    finite_info = {name: jnp.where(non_finite, jnp.zeros_like(value), value) for name, value in info.items()}
    return (
        env_state,
        observation,
        jnp.where(non_finite, 0.0, reward),
        terminated | non_finite,
        environment.is_truncated(env_state.step_count),
        {**finite_info, "non_finite": non_finite},
    )
