"""A batch of worlds of any JAX engine: compiled once, run at any time step and for any number of steps."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from tests.benchmarks.timing import Block
from tests.benchmarks.work_precision.scenes import Scene, kept_steps, steps_of
from tests.benchmarks.work_precision.worlds import Motion, stack


@dataclasses.dataclass
class JaxProgram:
    """One program, compiled when it is first needed.

    Attributes:
      parameters: dt -> pytree handed to `step`, so that XLA can not fold it into the program.
      states: all worlds at the start.
      step: (parameters, states) -> states.
      motion: (states, number of worlds) -> `Motion` of the first worlds.
      count: number of worlds.
      double: in float64.
      final: states at the end of the last record.
    """

    parameters: Callable[[float], Any]
    states: Any
    step: Callable[[Any, Any], Any]
    motion: Callable[[Any, int], Motion]
    count: int
    double: bool = False
    final: Any = None

    @functools.cached_property
    def _compiled(self) -> tuple[Any, float]:
        def advance(parameters: Any, states: Any, steps: Any) -> Any:
            return jax.lax.fori_loop(0, steps, lambda _, current: self.step(parameters, current), states)

        begin = time.process_time()
        with jax.enable_x64(self.double):
            run = jax.jit(advance).lower(self.parameters(1 / 240), self.states, np.int32(1)).compile()
        return run, time.process_time() - begin

    @property
    def compile_seconds(self) -> float:
        """CPU time of tracing and compiling [s]."""
        return self._compiled[1]

    @property
    def bytes_per_world(self) -> float:
        """Arguments, results and temporaries of the program."""
        found = self._compiled[0].memory_analysis()
        total = found.argument_size_in_bytes + found.output_size_in_bytes + found.temp_size_in_bytes
        return total / self.count

    def record(self, scene: Scene, dt: float) -> Motion:
        """Kept frames of the different worlds."""
        states, frames, done = self.states, [], 0
        with jax.enable_x64(self.double):
            parameters = self.parameters(dt)
            for step in kept_steps(scene, dt):
                states, done = self._compiled[0](parameters, states, np.int32(step - done)), step
                frames.append(self.motion(states, scene.worlds))
        self.final = states
        return stack(frames)

    def after(self, steps: int, dt: float, start: Any = None) -> Any:
        """States a number of steps after the start, or after other states."""
        with jax.enable_x64(self.double):
            return self._compiled[0](self.parameters(dt), self.states if start is None else start, np.int32(steps))

    def block(self, scene: Scene, dt: float) -> Block:
        """Runs the whole horizon."""
        return self.block_of(steps_of(scene, dt), dt)

    def block_of(self, steps: int, dt: float) -> Block:
        """Runs a number of steps from the start."""
        compiled = self._compiled[0]
        with jax.enable_x64(self.double):
            parameters = self.parameters(dt)

        def run() -> int:
            with jax.enable_x64(self.double):
                jax.block_until_ready(compiled(parameters, self.states, np.int32(steps)))
            return self.count * steps

        return run
