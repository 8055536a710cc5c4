"""One compilation of a step, to be run in a process of its own."""

from __future__ import annotations

import time

import jax

from mathota_jax import Box, Options, Plane, SceneBuilder, step
from tests.benchmarks.settings import TIME_STEP, Settings

HALF = 0.1


def measure(settings: Settings, box_count: int) -> dict:
    """Wall and CPU seconds of building, tracing (with lowering) and compiling a step of `box_count` stacked boxes.

    ``older_xla`` is the time that XLA's older code generator takes for the same program.
    """
    del settings
    clock = _Clock()
    model, state = stack(box_count)
    clock.mark("build")
    lowered = jax.jit(lambda model, state: step(model, state)).lower(model, state)
    clock.mark("trace")
    lowered.compile()
    clock.mark("xla")
    lowered.compile(compiler_options={"xla_cpu_use_fusion_emitters": False})
    clock.mark("older_xla")
    marks = clock.marks
    return {
        **marks,
        "compile_seconds": marks["trace_seconds"] + marks["xla_seconds"],
        "compile_cpu_seconds": marks["trace_cpu_seconds"] + marks["xla_cpu_seconds"],
    }


def stack(box_count: int, dt: float = TIME_STEP) -> tuple:
    """Boxes of 0.1 m half size on top of each other, touching."""
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
    for level in range(box_count):
        builder.add_body(Box((HALF, HALF, HALF)), mass=1.0, position=(0, HALF * (2 * level + 1), 0))
    return builder.build(Options(dt=dt))


class _Clock:
    def __init__(self) -> None:
        self.marks: dict[str, float] = {}
        self._last = time.perf_counter(), time.process_time()

    def mark(self, name: str) -> None:
        now = time.perf_counter(), time.process_time()
        self.marks[f"{name}_seconds"] = now[0] - self._last[0]
        self.marks[f"{name}_cpu_seconds"] = now[1] - self._last[1]
        self._last = now
