"""What is measured on a device: rate under random pushes, error without them, memory, compile time."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from tests.benchmarks.accelerator import pushes, warp_engine
from tests.benchmarks.timing import Block, summary
from tests.benchmarks.work_precision import engine, jax_engines
from tests.benchmarks.work_precision.jax_program import JaxProgram
from tests.benchmarks.work_precision.scenes import SCENES, TIGHT_QUICK, Scene, start_of
from tests.benchmarks.work_precision.worlds import Motion

DT = 1 / 240
NAMES = ("slide", "bounce", "stack10", "pile27 spheres", "pile27 boxes", "hulls8")
OURS, MJX, WARP = "mathota_jax", "MJX", "MuJoCo Warp"
FASTEST = 1e3
"""Speeds [m/s] beyond which a run means nothing."""


@dataclasses.dataclass
class Entry:
    """One engine in one scene.

    Attributes:
      block_of: steps -> block under random pushes.
      record: () -> kept frames of the scene without pushes.
      compile_seconds: wall time until the first step is done [s].
      bytes_per_world: None where the engine does not say.
      final: () -> bodies after the last block, and the share of worlds that raised a flag.
      off_cpu: () -> how far a step after the record is off that of a CPU [m/s]; None for peers.
    """

    block_of: Callable[[int], Block]
    record: Callable[[], Motion]
    compile_seconds: float
    bytes_per_world: float | None
    final: Callable[[], tuple[Motion, float]]
    off_cpu: Callable[[], float] | None = None
    rates: list[float] = dataclasses.field(default_factory=list)


def missing() -> dict[str, str]:
    """Peers that can not take part, and why."""
    found = {WARP: warp_engine.missing(), MJX: jax_engines.missing().get(MJX)}
    return {name: reason for name, reason in found.items() if reason}


def scene(name: str, worlds: int, rounds: int, seconds: float, engines: tuple[str, ...]) -> dict[str, Any]:
    """Every engine in one scene, in turns.

    Args:
      name: of a scene.
      worlds: side by side; at least those of the scene that differ.
      rounds: timed blocks of each engine.
      seconds: least wall time of a block.
      engines: that take part.
    """
    found = SCENES[name]
    entries = {key: _start(key, found, worlds) for key in engines}
    blocks = {key: _long_enough(entry, seconds) for key, entry in entries.items()}
    for _ in range(rounds):
        for key, entry in entries.items():
            entry.rates.append(_rate(blocks[key]))
    return {"worlds": worlds, "engines": {key: _report(found, entry) for key, entry in entries.items()}}


def _start(key: str, found: Scene, worlds: int) -> Entry:
    table = pushes.forces(found, worlds)
    if key == WARP:
        return _warp(found, worlds, table)
    setting = TIGHT_QUICK if TIGHT_QUICK in found.settings else found.settings[0]
    plain = engine.program(found, setting, worlds) if key == OURS else jax_engines.program(MJX, found, worlds)
    program = (pushes.pushed_ours if key == OURS else pushes.pushed_mjx)(plain, table)
    begin = time.perf_counter()
    program.block_of(1, DT)()
    compile_seconds = time.perf_counter() - begin
    last = []

    def block_of(steps: int) -> Block:
        inner = program.block_of(steps, DT)
        last[:] = [steps]
        return inner

    return Entry(
        block_of,
        lambda: plain.record(found, DT),
        compile_seconds,
        program.bytes_per_world,
        lambda: _after(program, found, last[0], key),
        (lambda: _off_cpu(plain, found)) if key == OURS else None,
    )


def _warp(found: Scene, worlds: int, table: Any) -> Entry:
    pushed = warp_engine.WarpProgram(found, DT, worlds, table)
    return Entry(
        pushed.block_of,
        lambda: warp_engine.WarpProgram(found, DT, worlds).record(),
        pushed.compile_seconds,
        None,
        lambda: (pushed.motion(), 0.0),
    )


def _after(program: JaxProgram, found: Scene, steps: int, key: str) -> tuple[Motion, float]:
    final = program.after(steps, DT)
    flagged = float(np.mean(np.asarray(final[1].flags) != 0)) if key == OURS else 0.0
    return program.motion(final, min(found.worlds, program.count)), flagged


def _off_cpu(plain: JaxProgram, found: Scene) -> float:
    """Largest difference of the velocities after one more step from those that a CPU computes [m/s]."""
    worlds = min(found.worlds, plain.count)
    cpu = jax.local_devices(backend="cpu")[0]
    here = plain.motion(plain.after(1, DT, plain.final), worlds).velocity
    start, parameters = jax.device_put((jax.tree.map(lambda x: x[:worlds], plain.final), plain.parameters(DT)), cpu)
    there = plain.motion(jax.jit(plain.step)(parameters, start), worlds).velocity
    return float(np.abs(here - there).max())


def _long_enough(entry: Entry, seconds: float) -> Block:
    """A block of at least so much wall time."""
    steps = pushes.ENTRIES
    while True:
        block = entry.block_of(steps)
        block()
        begin = time.perf_counter()
        block()
        taken = time.perf_counter() - begin
        if taken >= seconds:
            return block
        steps = max(2 * steps, int(1.2 * steps * seconds / taken))


def _rate(block: Block) -> float:
    begin = time.perf_counter()
    work = block()
    return work / (time.perf_counter() - begin)


def _report(found: Scene, entry: Entry) -> dict[str, Any]:
    """Figures of one engine; a run that means nothing has no rate.

    A rate counts if the pushed bodies are finite, their orientations of unit length, their speeds bounded.
    """
    pushed, flagged = entry.final()
    norm_error = np.abs(np.linalg.norm(pushed.orientation, axis=-1) - 1).max()
    means = bool(pushed.finite and norm_error < 1e-3 and np.abs(pushed.velocity).max() < FASTEST)
    frames = entry.record()
    start = start_of(found.name, found.worlds)
    return {
        "rate": summary(entry.rates)["median"] if means else None,
        "rates": entry.rates,
        "error": float(found.judge(start, frames, DT).max()),
        "unit": found.unit,
        "off_cpu": None if entry.off_cpu is None else entry.off_cpu(),
        "flagged": flagged,
        "compile_seconds": entry.compile_seconds,
        "bytes_per_world": entry.bytes_per_world,
    }


def device() -> dict[str, str]:
    """What JAX computes on."""
    first = jax.devices()[0]
    return {"platform": first.platform, "kind": first.device_kind, "jax": jax.__version__}
