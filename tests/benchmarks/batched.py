"""A batch of worlds in any JAX engine, timed and tracked in the same way."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from tests.benchmarks.timing import Block


@dataclasses.dataclass(frozen=True)
class BatchedScene:
    """Worlds ready to run.

    Attributes:
      parameters: pytree handed to `step` as an argument, so that XLA can not fold it into the program.
      states: pytree of all worlds at the start.
      step: (parameters, states) -> states of all worlds one step later.
      observe: states -> (world,) coordinate whose error is measured [m].
      count: number of worlds.
    """

    parameters: Any
    states: Any
    step: Callable[[Any, Any], Any]
    observe: Callable[[Any], Any]
    count: int

    def block(self, steps: int) -> Block:
        """Compiles a rollout; the block runs it from the start and returns the number of world-steps."""

        @jax.jit
        def rollout(parameters: Any, states: Any) -> Any:
            return jax.lax.scan(lambda s, _: (self.step(parameters, s), None), states, None, length=steps)[0]

        compiled = rollout.lower(self.parameters, self.states).compile()

        def run() -> int:
            jax.block_until_ready(compiled(self.parameters, self.states))
            return self.count * steps

        return run

    def track(self, steps: int) -> np.ndarray:
        """Observed coordinate before the first and after every step, (steps + 1, world)."""

        @jax.jit
        def rollout(parameters: Any, states: Any) -> Any:
            def advance(states: Any, _: None) -> tuple[Any, Any]:
                states = self.step(parameters, states)
                return states, self.observe(states)

            return jax.lax.scan(advance, states, None, length=steps)[1]

        return np.vstack([self.observe(self.states), rollout(self.parameters, self.states)])
