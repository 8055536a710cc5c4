"""Error against cost over time steps."""

from __future__ import annotations

import pathlib

TITLES = {"slide": "sliding cube: stopping distance", "bounce": "bouncing sphere: first apex"}
FLOOR = 1e-8
"""Errors of zero are drawn here."""


def speed_error(points: dict, path: pathlib.Path) -> None:
    """Draws one panel a scene; `points` is the result of `precision.measure`."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot, ticker

    figure, panels = pyplot.subplots(1, len(points), figsize=(6 * len(points), 4.5), layout="constrained")
    for panel, (scene, entries) in zip(panels, points.items(), strict=True):
        for engine in dict.fromkeys(entry["engine"] for entry in entries):
            own = [entry for entry in entries if entry["engine"] == engine]
            costs = [entry["cpu_per_world_second"] for entry in own]
            panel.loglog(costs, [max(entry["error"], FLOOR) for entry in own], marker="o", label=engine)
            for entry, cost in zip(own, costs, strict=True):
                label = f"1/{1 / entry['dt']:.0f}"
                place = (cost, max(entry["error"], FLOOR))
                panel.annotate(label, place, xytext=(4, 4), textcoords="offset points", fontsize=7)
        panel.set(
            title=TITLES[scene],
            xlabel="CPU-seconds per simulated second and world",
            ylabel="largest relative error over the worlds",
        )
        panel.xaxis.set_minor_formatter(ticker.NullFormatter())
        panel.grid(True, which="both", alpha=0.3)
        panel.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
