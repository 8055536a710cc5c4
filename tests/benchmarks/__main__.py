"""Measures speed against error and writes a report: JSON with every round, and Markdown."""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import importlib.metadata
import json
import os
import pathlib
import platform
import sys

from tests.benchmarks.process import ROOT, MeasurementError, launch
from tests.benchmarks.report import markdown
from tests.benchmarks.settings import QUICK, Settings

RESULTS = pathlib.Path(__file__).resolve().parent / "results"
MEASUREMENTS = {
    "slide": ("throughput", {"scene": "slide"}),
    "bounce": ("throughput", {"scene": "bounce"}),
    "gradient": ("gradient", {}),
    "compile_time": ("compile_time", {}),
    "accuracy": ("accuracy", {}),
}
PACKAGES = ("jax", "jaxlib", "numpy", "mujoco", "mujoco-mjx", "brax", "pybullet")


def main(arguments: list[str] | None = None) -> int:
    """Runs the measurements one after the other; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a few minutes, too short for publication")
    parser.add_argument("--only", nargs="+", choices=MEASUREMENTS, default=list(MEASUREMENTS), help="some measurements")
    parser.add_argument(
        "--output",
        type=pathlib.Path,
        help="folder to write to (default: tests/benchmarks/results, quick: runs/benchmarks)",
    )
    options = parser.parse_args(arguments)
    settings = QUICK if options.quick else Settings()
    output = options.output or (ROOT / "runs" / "benchmarks" if options.quick else RESULTS)
    output.mkdir(parents=True, exist_ok=True)

    report = {
        "date": datetime.date.today().isoformat(),
        "settings": dataclasses.asdict(settings),
        "machine": machine(),
        "measurements": {},
    }
    for name in options.only:
        print(f"{name} ...", flush=True)
        report["measurements"][name] = _measure(name, settings)
        write(report, output)  # what is measured is kept, should the run be broken off
    print(markdown(report))
    return int(any("failed" in result for result in report["measurements"].values()))


def _measure(name: str, settings: Settings) -> dict:
    module, arguments = MEASUREMENTS[name]
    try:
        return launch(module, settings, arguments)
    except MeasurementError as error:
        print(f"  failed: {error}", file=sys.stderr)
        return {"failed": str(error)}


def write(report: dict, output: pathlib.Path) -> None:
    """Writes `report.json` and `report.md`."""
    (output / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    (output / "report.md").write_text(markdown(report))


def machine() -> dict:
    """Processor, cores and versions; nothing that names the machine."""
    versions = {"Python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {"processor": _processor(), "cores": os.cpu_count(), "versions": versions}


def _processor() -> str:
    table = pathlib.Path("/proc/cpuinfo")
    if table.exists():
        for line in table.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


if __name__ == "__main__":
    sys.exit(main())
