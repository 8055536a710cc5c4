"""Learning curves as PNG files."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

_TRAINING_COLOUR = "#7a9cc6"
_EVALUATION_COLOUR = "#c8553d"


def save_learning_curve(
    path: Path,
    curve: Sequence[dict[str, float]],
    evaluations: Sequence[dict[str, float]],
    title: str,
    target_return: float | None = None,
) -> None:
    """Plot returns against world-steps.

    Args:
        path: PNG file to write.
        curve: Entries with ``steps`` and ``mean_return`` of the exploring policy.
        evaluations: Entries with ``steps``, ``mean_return`` and ``std_return`` of the deterministic policy.
        title: Above the axes.
        target_return: Drawn as a dashed line.
    """
    # A figure without pyplot needs no display and leaves no global state behind.
    figure = Figure(figsize=(7.5, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    if curve:
        axes.plot(
            _column(curve, "steps"),
            _column(curve, "mean_return"),
            color=_TRAINING_COLOUR,
            marker="." if len(curve) < 50 else None,
            label="training episodes (exploring)",
        )
    if evaluations:
        steps, mean, deviation = (_column(evaluations, name) for name in ("steps", "mean_return", "std_return"))
        axes.errorbar(
            steps,
            mean,
            yerr=deviation,
            color=_EVALUATION_COLOUR,
            marker="o",
            markersize=4,
            capsize=3,
            label="evaluation (deterministic), mean ± standard deviation",
        )
    if target_return is not None:
        axes.axhline(target_return, color="black", linestyle="--", linewidth=1, label=f"target {target_return:g}")
    axes.set(title=title, xlabel="world-steps", ylabel="return of an episode")
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="best", fontsize="small")
    figure.savefig(path, dpi=130)


def _column(entries: Sequence[dict[str, float]], name: str) -> np.ndarray:
    return np.array([entry[name] for entry in entries])
