"""What the points of a scene say: Pareto fronts, time to an error, targets, and the table behind `Options.for_error`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from mathota_jax.description import scene_sizes
from tests.benchmarks.work_precision import engine
from tests.benchmarks.work_precision.scenes import OURS as SETTINGS_OF_ALL
from tests.benchmarks.work_precision.scenes import SCENES
from tests.benchmarks.work_precision.sweep import OURS

TARGET_DT = 1 / 240
RELATIVE_ERRORS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)

Point = dict[str, Any]


def cost(point: Point) -> float:
    """CPU-seconds per simulated second of one world."""
    return 1 / (point["rate"] * point["dt"])


def judged(points: Iterable[Point]) -> list[Point]:
    """Those whose run stayed finite."""
    return [point for point in points if point["error"] is not None]


def front(points: Iterable[Point]) -> list[Point]:
    """Points that no other beats in both error and cost, by rising cost."""
    kept: list[Point] = []
    for point in sorted(judged(points), key=lambda point: (cost(point), point["error"])):
        if not kept or point["error"] < kept[-1]["error"]:
            kept.append(point)
    return kept


def cheapest(points: Iterable[Point], error: float) -> Point | None:
    """The cheapest one whose error is at most `error` [unit of the scene]."""
    return min((point for point in judged(points) if point["error"] <= error), key=cost, default=None)


def at(points: Iterable[Point], dt: float = TARGET_DT) -> list[Point]:
    """Points of one time step."""
    return [point for point in points if math.isclose(point["dt"], dt, rel_tol=1e-9)]


def of(points: Iterable[Point], engine: str) -> list[Point]:
    """Points of one engine."""
    return [point for point in points if point["engine"] == engine]


def engines(points: Iterable[Point]) -> list[str]:
    """Engines that took part, in order."""
    return list(dict.fromkeys(point["engine"] for point in points))


class Verdict(NamedTuple):
    """Our fastest point at the target's error and time step, and its rate over the target's."""

    point: Point | None
    ratio: float


def verdict(name: str, points: list[Point]) -> Verdict:
    """Whether a scene's target is met: `ratio` of at least 1."""
    target = SCENES[name].target
    found = cheapest(at(of(points, OURS)), target.error)
    return Verdict(found, found["rate"] / target.rate if found else 0.0)


def against(points: list[Point], peer: Point) -> tuple[Point | None, float]:
    """Our fastest point of the peer's time step whose error is no larger than the peer's, and its rate over the peer's."""
    found = cheapest(at(of(points, OURS), peer["dt"]), peer["error"])
    return found, found["rate"] / peer["rate"] if found else math.nan


def error_table(scenes: dict[str, dict], source: str) -> dict:
    """For each kind of scene, setting and time step the worst relative error and the mean cost over the scenes of the kind.

    Kind "any" is all scenes that every setting is run with. The cost [CPU-seconds per simulated second and world] is a
    geometric mean.
    """
    kinds = {"any": [name for name in kinds_of_all(scenes) if set(SETTINGS_OF_ALL) <= set(SCENES[name].settings)]}
    for name in kinds_of_all(scenes):
        kinds.setdefault(SCENES[name].kind, []).append(name)
    entries = []
    for kind, names in kinds.items():
        for setting in SETTINGS_OF_ALL:
            for dt in dict.fromkeys(point["dt"] for name in names for point in scenes[name]["points"]):
                found = [
                    (SCENES[name].scale, point)
                    for name in names
                    for point in at(of(scenes[name]["points"], OURS), dt)
                    if point["setting"] == setting
                ]
                if len(found) < len(names) or any(point["error"] is None for _, point in found):
                    continue
                error = max(point["error"] / scale for scale, point in found)
                mean = math.exp(np.mean([math.log(cost(point)) for _, point in found]))
                entries.append({"kind": kind, "setting": setting, "dt": dt, "error": error, "cost": mean})
    settings = {setting: engine.SETTINGS[setting] for setting in SETTINGS_OF_ALL}
    costs = {setting: _linear_cost(scenes, setting) for setting in SETTINGS_OF_ALL}
    return {
        "source": source,
        "settings": settings,
        "scenes": kinds,
        "entries": entries,
        "sizes": ("1", "moving bodies", "contact slots", "joints"),
        "costs": {setting: found for setting, found in costs.items() if found},
    }


def _linear_cost(scenes: dict[str, dict], setting: str) -> dict | None:
    """CPU-seconds of a step as a sum of shares of its sizes, none negative, and the largest factor it is wrong by.

    Least squares of the logarithm of the misfit at dt 1/240: costs of scenes differ by orders of magnitude.
    """
    rows, costs = [], []
    for name in kinds_of_all(scenes):
        found = [p for p in at(of(scenes[name]["points"], OURS)) if p["setting"] == setting]
        if found:
            model, _ = engine.build(SCENES[name].world, engine.undamped(SCENES[name], setting))
            rows.append((1, *scene_sizes(model.scene)))
            costs.append(1 / found[0]["rate"])
    if not rows:
        return None
    matrix, seconds = np.array(rows, float), np.array(costs)
    begin = np.log(seconds.min() / np.maximum(matrix.max(0), 1.0))
    found = least_squares(lambda shares: np.log(matrix @ np.exp(shares) / seconds), begin)
    coefficients = np.where(matrix.any(0), np.exp(found.x), 0.0)
    ratio = matrix @ coefficients / seconds
    return {"coefficients": coefficients.tolist(), "factor": float(np.exp(np.abs(np.log(ratio)).max()))}


def kinds_of_all(scenes: dict[str, dict]) -> list[str]:
    """Measured scenes of the registry."""
    return [name for name in scenes if name in SCENES]
