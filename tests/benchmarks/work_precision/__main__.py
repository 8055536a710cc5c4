"""Error against work in every scene and engine: Markdown, plots, JSON, and the table behind `Options.for_error`."""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import pathlib
import sys

from tests.benchmarks.__main__ import RESULTS, machine
from tests.benchmarks.process import ROOT, MeasurementError, launch
from tests.benchmarks.settings import Settings
from tests.benchmarks.work_precision import fronts, plots
from tests.benchmarks.work_precision.gradient import GRADIENT
from tests.benchmarks.work_precision.report import markdown, summary
from tests.benchmarks.work_precision.scenes import SCENES

FULL = Settings(rounds=5, block_seconds=0.1, warmup_blocks=0, time_steps=(1 / 60, 1 / 120, 1 / 240, 1 / 1000))
QUICK = Settings(
    mode="quick", rounds=3, block_seconds=0.05, warmup_blocks=0, time_steps=(1 / 60, 1 / 240), timeout_seconds=1200.0
)
QUICK_SCENES = ("slide", "bounce", "roll", "tumble", GRADIENT.name)
PACKAGE_TABLE = ROOT / "mathota_jax" / "error_table.json"
EXTRAS = {GRADIENT.name: "gradient", "features": "features", "scaling": "scaling"}


def main(arguments: list[str] | None = None) -> int:
    """Measures the scenes one after the other, each in a process of its own; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.work_precision", description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="few minutes: small scenes, few rounds; not for publication"
    )
    parser.add_argument("--only", nargs="+", choices=(*SCENES, *EXTRAS), help="some scenes or tables")
    parser.add_argument("--merge", action="store_true", help="keep what the output folder has of everything else")
    parser.add_argument(
        "--draw", action="store_true", help="measure nothing: write report and plots from the JSON there"
    )
    parser.add_argument(
        "--output", type=pathlib.Path, help="folder (default: tests/benchmarks/results, quick: runs/...)"
    )
    options = parser.parse_args(arguments)
    settings = QUICK if options.quick else FULL
    output = options.output or (ROOT / "runs" / "benchmarks" if options.quick else RESULTS)
    output.mkdir(parents=True, exist_ok=True)
    kept = output / "work_precision.json"
    report = json.loads(kept.read_text()) if options.merge or options.draw else {"scenes": {}}
    if not options.draw:
        report |= {"settings": dataclasses.asdict(settings), "machine": machine()}
        everything = QUICK_SCENES if options.quick else (*SCENES, *EXTRAS)
        for name in options.only or everything:
            print(f"{name} ...", flush=True)
            place = report["scenes"] if name in (*SCENES, GRADIENT.name) else report
            today, processor = datetime.date.today().isoformat(), report["machine"]["processor"]
            place[name] = _measure(name, settings) | {"date": today, "processor": processor}
            write(report, output)  # what is measured is kept, should the run be broken off
    write(report, output)
    print(summary(report["scenes"]))
    return int(any("failed" in result for result in report["scenes"].values()))


def _measure(name: str, settings: Settings) -> dict:
    module, arguments = (EXTRAS[name], {}) if name in EXTRAS else ("sweep", {"scene": name})
    try:
        return launch(f"work_precision.{module}", settings, arguments)
    except MeasurementError as error:
        print(f"  failed: {error}", file=sys.stderr)
        return {"failed": str(error)}


def write(report: dict, output: pathlib.Path) -> None:
    """Writes `work_precision.json`, `.md`, both plots and `error_table.json`: a complete set into the package."""
    order = [name for name in (*SCENES, GRADIENT.name) if name in report["scenes"]]
    report["scenes"] = {name: report["scenes"][name] for name in order}
    measured = {name: result for name, result in report["scenes"].items() if "failed" not in result}
    report["error_table"] = fronts.error_table(measured, "tests/benchmarks/results/work_precision.md")
    table = json.dumps(report["error_table"], indent=1) + "\n"
    (output / "work_precision.json").write_text(json.dumps(report, indent=1) + "\n")
    (output / "work_precision.md").write_text(markdown(report))
    complete = output.resolve() == RESULTS.resolve() and set(SCENES) <= set(measured)
    (PACKAGE_TABLE if complete else output / PACKAGE_TABLE.name).write_text(table)
    if measured:
        plots.draw(measured, output)


if __name__ == "__main__":
    sys.exit(main())
