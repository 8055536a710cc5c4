"""Interleaved timing in CPU-seconds.

CPU-seconds (`time.process_time`: all threads of the process) rather than wall time, so that an engine that uses every
core is not compared with one that uses one. Contestants take turns within a round, so that a change of clock frequency
or a busy neighbour meets all of them; ratios are taken inside a round.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping

import numpy as np

from tests.benchmarks.settings import Settings

Block = Callable[[], int]
"""Runs to completion and returns the work done (world-steps, or evaluations)."""


@dataclasses.dataclass
class Contestant:
    """A timed block with its settings, and the rates measured so far."""

    block: Block
    settings: dict
    error: dict | None = None
    rounds: int | None = None
    repeats: int = 1
    cpu_rates: list[float] = dataclasses.field(default_factory=list)
    wall_rates: list[float] = dataclasses.field(default_factory=list)

    def run(self) -> None:
        """Times one block of `repeats` calls."""
        cpu, wall = time.process_time(), time.perf_counter()
        work = sum(self.block() for _ in range(self.repeats))
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        self.cpu_rates.append(work / cpu)
        self.wall_rates.append(work / wall)

    def calibrate(self, settings: Settings) -> None:
        """Warms up, then chooses how many calls make a block long enough."""
        for _ in range(settings.warmup_blocks):
            self.block()
        cpu = time.process_time()
        self.block()
        self.repeats = max(1, math.ceil(settings.block_seconds / max(time.process_time() - cpu, 1e-6)))

    def report(self) -> dict:
        """Median and spread of the rates, and every round."""
        return {
            "settings": self.settings,
            "error": self.error,
            "cpu_rate": summary(self.cpu_rates),
            "wall_rate": summary(self.wall_rates),
            "calls_per_block": self.repeats,
            "rounds": {"cpu_rate": self.cpu_rates, "wall_rate": self.wall_rates},
        }


def interleave(contestants: Mapping[str, Contestant], settings: Settings) -> None:
    """Runs all rounds; the order rotates so that nobody always follows the same neighbour.

    A contestant with a `rounds` of its own (a slow peer) takes part in the first ones only.
    """
    for contestant in contestants.values():
        contestant.calibrate(settings)
    names = list(contestants)
    for turn in range(settings.rounds):
        shift = turn % len(names)
        for name in names[shift:] + names[:shift]:
            contestant = contestants[name]
            if contestant.rounds is None or turn < contestant.rounds:
                contestant.run()


def summary(values: list[float]) -> dict[str, float]:
    """Median with the 5th and 95th percentile."""
    low, middle, high = np.percentile(values, [5, 50, 95])
    return {"median": float(middle), "p5": float(low), "p95": float(high), "count": len(values)}


def paired_ratio(numerator: Contestant, denominator: Contestant) -> dict[str, float]:
    """Ratio of two CPU rates, taken within each round."""
    pairs = zip(numerator.cpu_rates, denominator.cpu_rates, strict=False)
    return summary([a / b for a, b in pairs])
