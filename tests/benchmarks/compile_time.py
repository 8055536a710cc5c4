"""Time to trace and to compile one step, each in a fresh process without the persistent cache."""

from __future__ import annotations

import statistics

from tests.benchmarks.process import launch
from tests.benchmarks.settings import Settings

STACKS = {"one box on a plane": 1, "stack of ten boxes": 10}


def measure(settings: Settings) -> dict:
    """Medians over fresh processes, and every run."""
    return {
        name: _summary([_once(settings, count) for _ in range(settings.compile_repeats)])
        for name, count in STACKS.items()
    }


def _once(settings: Settings, count: int) -> dict:
    return launch("compile_probe", settings, {"box_count": count}, one_core=False)


def _summary(runs: list[dict]) -> dict:
    medians = {name: statistics.median(run[name] for run in runs) for name in runs[0]}
    return {**medians, "runs": runs}
