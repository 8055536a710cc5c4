"""Cost against the number of worlds, bodies and contacts, and of a single world."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from mathota_jax import State, step
from tests.benchmarks import body_count
from tests.benchmarks.settings import TIME_STEP, Settings
from tests.benchmarks.timing import Contestant, interleave
from tests.benchmarks.work_precision import engine, mujoco_engine
from tests.benchmarks.work_precision.scenes import SCENES, start_of

WORLDS = (1, 16, 128, 512, 2048, 16384)
BODIES = (1, 8, 32, 128, 512)
STEPS = 60
CALLS = 200


def measure(settings: Settings) -> dict:
    """ "worlds": sliding cube, with the error of each batch; "bodies": spheres; "single": one cube, see `_single`."""
    quick = settings.mode == "quick"
    return {
        "worlds": _worlds(WORLDS[:4] if quick else WORLDS, settings),
        "bodies": [body_count.measure(count) for count in (BODIES[:3] if quick else BODIES)],
        "single": _single(settings),
    }


def _worlds(counts: tuple[int, ...], settings: Settings) -> list[dict]:
    scene = SCENES["slide"]
    programs = {count: engine.program(scene, "pgs", count) for count in counts}
    contestants = {
        str(count): Contestant(program.block_of(STEPS, TIME_STEP), {}) for count, program in programs.items()
    }
    # By what it does in the same rounds the rates can be compared with those of another day.
    if not mujoco_engine.missing():
        contestants["MuJoCo"] = Contestant(mujoco_engine.MujocoProgram(scene, "default", TIME_STEP).block(), {})
    interleave(contestants, settings)
    peer = contestants["MuJoCo"].report()["cpu_rate"]["median"] if "MuJoCo" in contestants else None
    rows = []
    for count, program in programs.items():
        report = contestants[str(count)].report()
        start, frames = start_of("slide", scene.worlds), program.record(scene, TIME_STEP)
        kept = min(count, scene.worlds)
        error = scene.judge(start.map(lambda leaf, n=kept: leaf[:n]), frames, TIME_STEP).max()
        rows.append(
            {
                "worlds": count, "rate": report["cpu_rate"]["median"], "wall_rate": report["wall_rate"]["median"],
                "bytes_per_world": program.bytes_per_world, "compile_cpu_seconds": program.compile_seconds,
                "error": float(error), "cpu_rates": report["rounds"]["cpu_rate"], "mujoco_rate": peer,
            }
        )  # fmt: skip
    return rows


def _single(settings: Settings) -> dict[str, Any]:
    """CPU and wall time [us] of a step of one cube on a plane: called from Python, or inside a loop.

    "constant": called with the model as a constant of the program, so that its leaves are not handed over at each call.
    """
    model, state = engine.build(SCENES["slide"].world, engine.undamped(SCENES["slide"], "pgs"))
    loop = engine.program(SCENES["slide"], "pgs", 1).block_of(CALLS, TIME_STEP)

    def calls(advance: Callable[[State], State]) -> int:
        current = state
        for _ in range(CALLS):
            current = advance(current)
        jax.block_until_ready(current)
        return CALLS

    call = functools.partial(jax.jit(step), model)
    constant = jax.jit(functools.partial(step, model))
    blocks = {"call": lambda: calls(call), "constant": lambda: calls(constant), "loop": loop}
    found = {}
    for name, block in blocks.items():
        block()
        cpu, wall = [], []
        for _ in range(settings.rounds):
            begin = time.process_time(), time.perf_counter()
            count = block()
            cpu.append(1e6 * (time.process_time() - begin[0]) / count)
            wall.append(1e6 * (time.perf_counter() - begin[1]) / count)
        found[name] = {"cpu_microseconds": float(np.median(cpu)), "wall_microseconds": float(np.median(wall))}
    return found
