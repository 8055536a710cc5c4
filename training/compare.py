"""Compare training runs of one environment: ``python -m training.compare runs/a runs/b --output comparison.png``.

Prints a Markdown table, and plots the evaluations of every run against world-steps.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from training.run_folder import METRICS_FILE

_COLOURS = ("#c8553d", "#3a5f8a", "#5a8f4e", "#8a5fa0", "#c29b2f", "#555555")


def read_runs(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """What ``metrics.json`` of each folder holds.

    Raises:
        ValueError: If a folder holds no run, or the environments differ.
    """
    runs = []
    for folder in folders:
        path = folder / METRICS_FILE
        if not path.is_file():
            raise ValueError(f"{folder} holds no {METRICS_FILE}: give folders written by training.train")
        runs.append(json.loads(path.read_text(encoding="utf-8")))
    environments = {run["environment"] for run in runs}
    if len(environments) > 1:
        raise ValueError(f"the runs are of different environments: {', '.join(sorted(environments))}")
    return runs


def steps_to(run: dict[str, Any], mean_return: float) -> float | None:
    """World-steps after which an evaluation first reached this mean return; None for never."""
    reached = [entry["steps"] for entry in run["training_evaluations"] if entry["mean_return"] >= mean_return]
    return reached[0] if reached else None


def table(runs: Sequence[dict[str, Any]]) -> str:
    """Markdown: a line for each run."""
    best = max(run["evaluation"]["mean_return"] for run in runs)
    lines = [
        "| backend | worlds | steps | final return | steps to 90 % of the best return | training [s] |",
        "|---|---|---|---|---|---|",
    ]
    for run in runs:
        final = run["evaluation"]
        reached = steps_to(run, 0.9 * best)
        lines.append(
            f"| {run['backend']} | {run['hyperparameters']['worlds']} | {run['steps']} | "
            f"{final['mean_return']:.1f} ± {final['std_return']:.1f} | {'never' if reached is None else reached} | "
            f"{run['training_seconds']:.0f} |"
        )
    return "\n".join(lines) + "\n"


def save_comparison(path: Path, runs: Sequence[dict[str, Any]]) -> None:
    """Plot mean and standard deviation of the evaluations against world-steps."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # A figure without pyplot needs no display and leaves no global state behind.
    figure = Figure(figsize=(7.5, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for index, run in enumerate(runs):
        colour = _COLOURS[index % len(_COLOURS)]
        final = {"steps": run["steps"], **run["evaluation"]}
        entries = [*run["training_evaluations"], final]
        steps, mean, deviation = ([entry[name] for entry in entries] for name in ("steps", "mean_return", "std_return"))
        label = f"{run['backend']}, seed {run['seed']}"
        axes.plot(steps, mean, color=colour, marker="o", markersize=3, label=label)
        low, high = ([m + sign * d for m, d in zip(mean, deviation, strict=True)] for sign in (-1, 1))
        axes.fill_between(steps, low, high, color=colour, alpha=0.2, linewidth=0)
    axes.set(title=runs[0]["environment"], xlabel="world-steps", ylabel="return of an episode, evaluated")
    axes.set_xlim(0, min(run["steps"] for run in runs))  # equal steps for all
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize="small")
    figure.savefig(path, dpi=130)


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m training.compare", description="Compare training runs.")
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="written by training.train")
    parser.add_argument("--output", type=Path, metavar="FILE", help="PNG file for the learning curves")
    options = parser.parse_args(arguments)
    try:
        runs = read_runs(options.folders)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(table(runs), end="")
    if options.output is not None:
        save_comparison(options.output, runs)
        print(f"wrote {options.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
