"""Worlds by the thousand on the device that JAX finds: rate under random pushes, and error, beside MJX and MuJoCo Warp."""

from __future__ import annotations

import argparse
import datetime
import json
import os
import pathlib
import sys
from typing import Any

# Warp takes its memory beside that of JAX.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

from tests.benchmarks.__main__ import RESULTS, machine
from tests.benchmarks.accelerator import measure
from tests.benchmarks.figures import rate
from tests.benchmarks.work_precision.plots import error_text

WORLDS = 8192
HEAD = (
    "scene",
    "engine",
    "worlds",
    "world-steps per second",
    "of ours",
    "error",
    "off a CPU [m/s]",
    "flagged",
    "bytes a world",
    "first step [s]",
)


def main(arguments: list[str] | None = None) -> int:
    """Measures scene after scene and writes ``accelerator.json`` and ``.md`` after each; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.accelerator", description=__doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[WORLDS], help="side by side")
    parser.add_argument("--only", nargs="+", choices=measure.NAMES, default=measure.NAMES, help="some scenes")
    parser.add_argument("--engines", nargs="+", choices=(measure.OURS, measure.MJX, measure.WARP), help="some engines")
    parser.add_argument("--rounds", type=int, default=7, help="timed blocks of each engine, in turns")
    parser.add_argument("--seconds", type=float, default=0.5, help="least wall time of a block")
    parser.add_argument("--output", type=pathlib.Path, default=RESULTS, help="folder")
    options = parser.parse_args(arguments)
    absent = measure.missing()
    for name, reason in absent.items():
        print(f"without {name}: {reason}")
    engines = tuple(name for name in options.engines or (measure.OURS, measure.MJX, measure.WARP) if name not in absent)
    report: dict[str, Any] = {
        "date": datetime.date.today().isoformat(),
        "device": measure.device(),
        "machine": machine(),
        "settings": {"dt": measure.DT, "rounds": options.rounds, "seconds": options.seconds},
        "scenes": {},
    }
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        for worlds in options.worlds:
            print(f"{name}, {worlds} worlds ...", flush=True)
            found = measure.scene(name, worlds, options.rounds, options.seconds, engines)
            report["scenes"].setdefault(name, []).append(found)
            (options.output / "accelerator.json").write_text(json.dumps(report, indent=1) + "\n")
            (options.output / "accelerator.md").write_text(markdown(report))
    return 0


def markdown(report: dict[str, Any]) -> str:
    """The report."""
    device, settings = report["device"], report["settings"]
    lines = [
        "# Thousands of worlds on one device",
        "",
        f"Written by `python -m tests.benchmarks.accelerator` on {report['date']}: {device['kind']} "
        f"({device['platform']}), jax {device['jax']}, steps of 1/{round(1 / settings['dt'])} s, float32.",
        f"Rates are medians of {settings['rounds']} blocks of at least {settings['seconds']:g} s of wall time, the engines",
        "in turns, all collisions on, a random force on every body in every step (standard deviation 5 m/s^2 times its",
        "mass), the same in every engine. Errors are those of the same scene left alone, in the same batch, as",
        "[work_precision.md](work_precision.md) defines them. *Off a CPU*: largest difference of the velocities after one",
        "more step from those that a CPU computes. *Flagged*: worlds in which our engine reports trouble. A dash: the",
        "engine does not say, or its run meant nothing (not finite, or faster than a km/s).",
        "",
        f"| {' | '.join(HEAD)} |",
        "|---" * len(HEAD) + "|",
    ]
    for name, runs in report["scenes"].items():
        for run in runs:
            ours = run["engines"].get(measure.OURS, {}).get("rate")
            lines += [_row(name, run["worlds"], key, row, ours) for key, row in run["engines"].items()]
    return "\n".join(lines) + "\n"


def _row(name: str, worlds: int, key: str, row: dict[str, Any], ours: float | None) -> str:
    means = row["rate"] is not None
    cells = (
        name,
        key,
        str(worlds),
        rate(row["rate"]) if means else "-",
        f"{row['rate'] / ours:.2g}" if means and ours else "-",
        error_text(name, row["error"]),
        "-" if row["off_cpu"] is None else f"{row['off_cpu']:.1g}",
        f"{100 * row['flagged']:.2g} %" if key == measure.OURS else "-",
        "-" if row["bytes_per_world"] is None else f"{row['bytes_per_world']:.0f}",
        f"{row['compile_seconds']:.1f}",
    )
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(main())
