"""A deterministic toy task in pure JAX whose episodes end at known moments, without the engine."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box

from mathota_envs.base import Environment, EnvState, key_data, unbounded_box


@dataclasses.dataclass(frozen=True, kw_only=True)
class Counting(Environment):
    """A number that the action is added to; the episode terminates above `ceiling`.

    The start is random in [0, 1), so that worlds end at different times. Observation: number and steps so far. Reward:
    the number. All arithmetic is exact in float32 up to the first start, so results can be compared bit by bit.
    """

    max_episode_steps: int | None = 5
    ceiling: float = 3.0

    reset_options: ClassVar[dict[str, tuple[int, ...]]] = {"number": ()}

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_number("ceiling", minimum=1.0)
        self.set_derived(
            observation_space=unbounded_box(2),
            action_space=Box(-1.0, 1.0, (1,), np.float32),
            dt=0.5,
        )

    def reset(self, key: Any, options: Any = None) -> tuple[EnvState, Any]:
        start_key, later_key = jax.random.split(key)
        number = self.checked_reset_options(options).get("number", jax.random.uniform(start_key))
        env_state = EnvState(number, key_data(later_key), jnp.zeros((), jnp.int32), ())
        return env_state, self._observe(env_state)

    def step(self, env_state: EnvState, action: Any, model: Any = None) -> tuple:
        number = env_state.state + self.clipped(self.checked_action(action))[0]
        env_state = dataclasses.replace(env_state, state=number, step_count=env_state.step_count + 1)
        info = {
            "above_one": number > 1.0,
            "half": 0.5 * number,
            "steps": env_state.step_count,
            "pair": jnp.stack([number, -number]),
        }
        return (
            env_state,
            self._observe(env_state),
            number,
            number > self.ceiling,
            self.is_truncated(env_state.step_count),
            info,
        )

    @staticmethod
    def _observe(env_state: EnvState) -> Any:
        return jnp.stack([env_state.state, env_state.step_count.astype(env_state.state.dtype)])
