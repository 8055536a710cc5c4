"""One scene in every engine at every setting and time step: error, cost, compile time and memory."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.benchmarks.settings import Settings
from tests.benchmarks.timing import Block, Contestant, interleave
from tests.benchmarks.work_precision import bullet_engine, engine, jax_engines, mujoco_engine
from tests.benchmarks.work_precision.jax_program import JaxProgram
from tests.benchmarks.work_precision.scenes import SCENES, Scene, start_of, steps_of
from tests.benchmarks.work_precision.worlds import Motion

OURS = "mathota_jax"
SLOW_STEPS = (1 / 60, 1 / 240)
"""Time steps of engines whose runs take long."""
SECONDS_OF_A_POINT = 2.0
"""A block that takes long is run in fewer rounds; one that takes longer is timed once, with the frames it is judged by."""
PROBE_STEPS = 60


@dataclasses.dataclass(frozen=True)
class Point:
    """One engine at one setting and time step, ready to be judged and timed."""

    engine: str
    setting: str
    dt: float
    batch: int
    worlds: int
    record: Callable[[], Motion]
    block: Block
    compile_cpu_seconds: float
    bytes_per_world: Callable[[], float | None]
    profile: dict | None = None
    flags: Callable[[], int] = lambda: 0


def measure(settings: Settings, scene: str) -> dict:
    """All points of one scene.

    Returns:
      "points" (engine, setting, dt, batch, error, rates with every round, compile time, memory), "batches" (world-steps
      per CPU-second against the number of worlds) and "missing" (engine -> why).
    """
    chosen = SCENES[scene]
    points, batches = _ours(chosen, settings)
    missing: dict[str, str] = {}
    points += _mujoco(chosen, settings, missing) + _bullet(chosen, settings, missing)
    points += _jax(chosen, settings, missing)
    contestants, found = {}, []
    for point in points:
        begin = time.process_time()
        frames = point.record()
        seconds = time.process_time() - begin  # a little more than a block takes
        work = point.worlds * steps_of(chosen, point.dt)
        entry = {
            "engine": point.engine,
            "setting": point.setting,
            "dt": point.dt,
            "batch": point.batch,
            **_judge(chosen, point.dt, frames),
            "rate": work / seconds,
            "cpu_rates": [work / seconds],
            "compile_cpu_seconds": point.compile_cpu_seconds,
            "bytes_per_world": point.bytes_per_world(),
            "profile": point.profile,
            "flags": point.flags(),
        }
        found.append(entry)
        if seconds < SECONDS_OF_A_POINT:
            rounds = max(1, min(settings.rounds, int(SECONDS_OF_A_POINT / seconds)))
            contestants[len(found) - 1] = Contestant(point.block, {}, rounds=rounds)
    interleave(contestants, settings)
    for place, contestant in contestants.items():
        report = contestant.report()
        found[place] |= {"rate": report["cpu_rate"]["median"], "cpu_rates": report["rounds"]["cpu_rate"]}
    return {"points": found, "batches": batches, "missing": missing}


def _time_steps(scene: Scene, settings: Settings) -> list[float]:
    return [dt for dt in settings.time_steps if dt > 0.99 * scene.finest]


def _judge(scene: Scene, dt: float, frames: Motion) -> dict[str, Any]:
    """Errors over the worlds; a run that blows up has none."""
    if not frames.finite:
        return {"error": None, "error_median": None}
    errors = scene.judge(start_of(scene.name, scene.worlds), frames, dt)
    return {"error": float(errors.max()), "error_median": float(np.median(errors))}


def _jax_point(engine_name: str, setting: str, scene: Scene, program: JaxProgram, dt: float) -> Point:
    return Point(
        engine=engine_name,
        setting=setting,
        dt=dt,
        batch=program.count,
        worlds=program.count,
        record=lambda: program.record(scene, dt),
        block=program.block(scene, dt),
        compile_cpu_seconds=program.compile_seconds,
        bytes_per_world=lambda: program.bytes_per_world,
        flags=lambda: int(np.bitwise_or.reduce(np.asarray(getattr(program.final, "flags", [0])))),
    )


def _ours(scene: Scene, settings: Settings) -> tuple[list[Point], list[dict]]:
    """All settings, at the number of worlds at which the first one is fastest."""
    programs, batches = {}, []
    for count in scene.batches[:1] if settings.mode == "quick" else scene.batches:
        program = engine.program(scene, scene.settings[0], max(count, scene.worlds))
        probe = Contestant(program.block_of(PROBE_STEPS, engine.DT), {})
        interleave({"": probe}, dataclasses.replace(settings, rounds=5))
        rate = probe.report()["cpu_rate"]["median"]
        batches.append({"batch": program.count, "rate": rate, "bytes_per_world": program.bytes_per_world})
        programs[rate] = program
    best = programs[max(programs)]
    points = []
    for setting in scene.settings:
        first = setting == scene.settings[0]
        program = best if first else engine.program(scene, setting, best.count)
        points += [_jax_point(OURS, setting, scene, program, dt) for dt in _time_steps(scene, settings)]
    return points, batches


def _mujoco(scene: Scene, settings: Settings, missing: dict[str, str]) -> list[Point]:
    if reason := mujoco_engine.missing():
        missing["MuJoCo"] = reason
        return []
    points = []
    for profile in mujoco_engine.PROFILES:
        for dt in _time_steps(scene, settings):
            program = mujoco_engine.MujocoProgram(scene, profile, dt)
            memory, given = program.bytes_per_world, getattr(scene, profile)
            points.append(
                Point("MuJoCo", profile, dt, 1, scene.worlds, program.record, program.block(), 0.0, memory, given)
            )
    return points


def _bullet(scene: Scene, settings: Settings, missing: dict[str, str]) -> list[Point]:
    if "PyBullet" not in scene.peers:
        missing["PyBullet"] = "left out of this scene"
        return []
    if reason := bullet_engine.missing():
        missing["PyBullet"] = reason
        return []
    points = []
    for profile, given in bullet_engine.PROFILES.items():
        for dt in _time_steps(scene, settings):
            program = bullet_engine.BulletProgram(scene, profile, dt)
            run = program.record, program.block()
            points.append(Point("PyBullet", profile, dt, 1, scene.worlds, *run, 0.0, lambda: None, given))
    return points


def _jax(scene: Scene, settings: Settings, missing: dict[str, str]) -> list[Point]:
    points = []
    absent = jax_engines.missing()
    for name in jax_engines.BATCHES:
        if settings.mode == "quick" and name not in absent:
            missing[name] = "left out of quick runs"
            continue
        if name not in scene.peers:
            missing[name] = "left out of this scene: a step of several bodies takes minutes to compile"
            continue
        if name in absent:
            missing[name] = absent[name]
            continue
        program = jax_engines.program(name, scene)
        points += [
            _jax_point(name, "default", scene, program, dt)
            for dt in _time_steps(scene, settings)
            if any(abs(dt / slow - 1) < 1e-9 for slow in SLOW_STEPS)
        ]
    return points
