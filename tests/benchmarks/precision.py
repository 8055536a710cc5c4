"""Error against cost over time steps: work and precision of both scenes, ours beside MuJoCo."""

from __future__ import annotations

from collections.abc import Callable

from tests.benchmarks import mujoco_peer, ours, scenes, throughput
from tests.benchmarks.batched import BatchedScene
from tests.benchmarks.settings import Settings
from tests.benchmarks.timing import Contestant, interleave

BATCH = 512
ROUNDS = 7
ERROR_NAME = {"slide": "distance_error", "bounce": "apex_error"}
SECONDS = {"slide": 0.4, "bounce": 2.0}
"""Timed horizon: the cube slides throughout; the sphere falls and bounces three times."""


def measure(settings: Settings) -> dict:
    """For each scene a list of points (engine, dt, error, CPU-seconds per simulated second and world)."""
    result: dict[str, list[dict]] = {}
    for scene in ERROR_NAME:
        contestants = {}
        for dt in settings.time_steps:
            contestants.update(_at(scene, dt))
        interleave(contestants, settings)
        result[scene] = [_point(scene, name, contestant) for name, contestant in contestants.items()]
    return result


def _at(scene: str, dt: float) -> dict[str, Contestant]:
    make, error = {"slide": (ours.slide, throughput.slide_error), "bounce": (ours.bounce, throughput.bounce_error)}[
        scene
    ]
    steps = scenes.step_count(SECONDS[scene], dt)
    found = {f"mathota_jax|{dt}": _own(make, error, dt, steps)}
    if not mujoco_peer.missing():
        for label, run in mujoco_peer.precision_runs(scene, dt).items():
            block = run.rollout(steps)
            found[f"{label}|{dt}"] = Contestant(block, {"dt": dt}, run.error(), ROUNDS)
    return found


def _own(make: Callable, error: Callable, dt: float, steps: int) -> Contestant:
    worlds: BatchedScene = make(dt, BATCH)
    return Contestant(worlds.block(steps), {"dt": dt, "batch": BATCH}, error(worlds, dt), ROUNDS)


def _point(scene: str, name: str, contestant: Contestant) -> dict:
    dt = contestant.settings["dt"]
    rate = contestant.report()["cpu_rate"]["median"]
    error = (contestant.error or {})[ERROR_NAME[scene]]
    return {"engine": name.split("|")[0], "dt": dt, "error": error, "cpu_per_world_second": 1 / (rate * dt)}
