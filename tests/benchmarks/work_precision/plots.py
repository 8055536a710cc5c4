"""Error against work, one panel a scene, and a summary: what each engine pays for the error of the target."""

from __future__ import annotations

import math
import pathlib
from typing import Any

from tests.benchmarks.work_precision import fronts
from tests.benchmarks.work_precision.gradient import GRADIENT
from tests.benchmarks.work_precision.scenes import OURS as SETTINGS
from tests.benchmarks.work_precision.scenes import SCENES
from tests.benchmarks.work_precision.sweep import OURS

FLOOR = 1e-9
"""Relative errors of zero are drawn here."""
COLORS = {OURS: "#0b5fa5", "MuJoCo": "#c8501e", "PyBullet": "#7a7a7a", "MJX": "#9a6fb0", "Brax spring": "#3f8f5f"}
MARKERS = ("o", "s", "^", "D", "v", "P")
COLUMNS = 4


def draw(scenes: dict[str, dict], folder: pathlib.Path) -> None:
    """Writes `work_precision.png` and `work_precision_summary.png`."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure = _multiples(scenes, pyplot)
    figure.savefig(folder / "work_precision.png", dpi=100)
    pyplot.close(figure)
    figure = _summary(scenes, pyplot)
    figure.savefig(folder / "work_precision_summary.png", dpi=110)
    pyplot.close(figure)


def relative(scene: str, error: float) -> float:
    """Error as a share of the scene's scale."""
    return error / SCENES[scene].scale if scene in SCENES else error


def _multiples(scenes: dict[str, dict], pyplot: Any) -> Any:
    rows = math.ceil(len(scenes) / COLUMNS)
    columns = min(COLUMNS, len(scenes))
    figure, panels = pyplot.subplots(
        rows, columns, figsize=(4.6 * columns, 3.7 * rows + 0.8), layout="constrained", squeeze=False
    )
    handles: dict[str, Any] = {}
    for panel, (scene, result) in zip(panels.flat, scenes.items(), strict=False):
        _panel(panel, scene, fronts.judged(result["points"]), handles)
    for panel in list(panels.flat)[len(scenes) :]:
        panel.axis("off")
    for panel in list(panels.flat)[max(0, len(scenes) - columns) : len(scenes)]:
        panel.set_xlabel("CPU-seconds per simulated second and world")
    for panel in panels[:, 0]:
        panel.set_ylabel("error / scale of the scene")
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=5, fontsize=9, frameon=False)
    return figure


def _panel(panel: Any, scene: str, points: list[dict], handles: dict[str, Any]) -> None:
    for engine in fronts.engines(points):
        own = fronts.of(points, engine)
        for setting in dict.fromkeys(point["setting"] for point in own):
            line = [point for point in own if point["setting"] == setting]
            marker = MARKERS[_rank(engine, setting) % len(MARKERS)]
            (drawn,) = panel.loglog(
                [fronts.cost(point) for point in line],
                [max(relative(scene, point["error"]), FLOOR) for point in line],
                marker=marker, ms=4.5, lw=0.8, color=COLORS[engine], alpha=0.85,
            )  # fmt: skip
            handles.setdefault(f"{engine}, {setting}", drawn)
    best = fronts.front(fronts.of(points, OURS))
    panel.loglog(
        [fronts.cost(point) for point in best], [max(relative(scene, point["error"]), FLOOR) for point in best],
        lw=3, color=COLORS[OURS], alpha=0.25, zorder=0,
    )  # fmt: skip
    if scene in SCENES:
        target = SCENES[scene].target
        aim = 1 / (target.rate * fronts.TARGET_DT)
        panel.plot(aim, relative(scene, target.error), "x", ms=10, mew=2.5, color="black")
    panel.set_title(scene)
    panel.grid(True, which="major", alpha=0.3)
    panel.tick_params(labelsize=8)
    # Where an axis spans less than two decades, names of all its ticks would run into one another.
    panel.xaxis.set_minor_formatter("")
    panel.yaxis.set_minor_formatter("")


def _rank(engine: str, setting: str) -> int:
    if engine != OURS:
        return int(setting != "default")
    return SETTINGS.index(setting) if setting in SETTINGS else len(SETTINGS)


def aimed(scene: str) -> float:
    """Error [unit of the scene] at which the summary compares costs: that of the target."""
    return SCENES[scene].target.error if scene in SCENES else GRADIENT.aim


def _summary(scenes: dict[str, dict], pyplot: Any) -> Any:
    figure, panel = pyplot.subplots(figsize=(9.5, 0.5 * len(scenes) + 1.9), layout="constrained")
    labels = []
    for row, (scene, result) in enumerate(scenes.items()):
        error, found = aimed(scene), {}
        for engine in fronts.engines(result["points"]):
            point = fronts.cheapest(fronts.of(result["points"], engine), error)
            if point:
                found[engine] = fronts.cost(point)
        if found:
            panel.plot([min(found.values()), max(found.values())], [row, row], color="#cccccc", lw=1.5, zorder=0)
        for engine, value in found.items():
            panel.plot(value, row, "o", ms=9 if engine == OURS else 6.5, color=COLORS[engine])
        labels.append(f"{scene}\nerror at most {error_text(scene, error)}")
    panel.set_xscale("log")
    panel.set_yticks(range(len(scenes)), labels, fontsize=8)
    panel.set_ylim(-0.6, len(scenes) - 0.4)
    panel.invert_yaxis()
    panel.grid(True, axis="x", which="major", alpha=0.3)
    panel.set_xlabel("CPU-seconds per simulated second and world (left is better)")
    title = "What an error costs: each engine at its cheapest setting and time step; no dot: not reached"
    panel.set_title(title, fontsize=10)
    handles = [
        pyplot.Line2D([], [], marker="o", ls="", color=color, label=engine)
        for engine, color in COLORS.items()
        if any(engine in fronts.engines(result["points"]) for result in scenes.values())
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=9, frameon=False)
    return figure


def error_text(scene: str, error: float) -> str:
    """An error with its unit."""
    unit = SCENES[scene].unit if scene in SCENES else GRADIENT.unit
    return f"{100 * error:.2g} %" if unit == "1" else f"{error:.2g} {unit}"
