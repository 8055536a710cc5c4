"""How exact the settings of the engine are and what they cost, as the work-precision report measured them.

`error_table.json` is written by `python -m tests.benchmarks.work_precision`; its figures, and the scenes behind them,
are in tests/benchmarks/results/work_precision.md.
"""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path
from typing import Any, NamedTuple


class Choice(NamedTuple):
    """A setting at a time step.

    Attributes:
      dt: time step [s].
      options: other fields of `Options`, by name.
      error: worst error over the scenes of the kind, relative to their scale.
      cost: geometric mean over them [CPU-seconds per simulated second and world].
    """

    dt: float
    options: dict[str, Any]
    error: float
    cost: float


class Cost(NamedTuple):
    """Expected CPU time of a step of one world of a batch [s], and the factor by which measured scenes missed it."""

    seconds: float
    factor: float


@functools.cache
def table() -> dict[str, Any]:
    """The table as it was written."""
    return json.loads((Path(__file__).parent / "error_table.json").read_text())


def kinds() -> tuple[str, ...]:
    """Kinds of scenes."""
    return tuple(table()["scenes"])


def cheapest(error: float, kind: str) -> Choice:
    """The cheapest setting whose error in every scene of a kind is at most `error`.

    Raises:
      ValueError: none is so exact; the message says what the least error is.
    """
    entries = [entry for entry in table()["entries"] if entry["kind"] == kind]
    reached = [entry for entry in entries if entry["error"] <= error]
    if not reached:
        least = min((entry["error"] for entry in entries), default=math.inf)
        least = f"{least:.2g}" if math.isfinite(least) else "not measured"
        raise ValueError(
            f"Options.for_error: no measured setting has an error of at most {error:g} in scenes of kind {kind!r}; "
            f"the least is {least}"
        )
    best = min(reached, key=lambda entry: entry["cost"])
    return Choice(best["dt"], table()["settings"][best["setting"]], best["error"], best["cost"])


def expected_cost(setting: str, sizes: tuple[int, ...]) -> Cost | None:
    """CPU time of a step, linear in the sizes of a scene; None for a setting that was not measured.

    Args:
      setting: name in the table.
      sizes: numbers that `table()["sizes"]` names, without the leading 1.
    """
    found = table()["costs"].get(setting)
    if found is None:
        return None
    return Cost(sum(a * b for a, b in zip(found["coefficients"], (1, *sizes), strict=True)), found["factor"])
