"""Report of a fit as one HTML file that needs nothing else: tables, warnings, pictures inside."""

from __future__ import annotations

import base64
import io
from html import escape
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mathota_jax.fit import FitResult

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 1rem 0; } th, td { border-bottom: 1px solid #ddd; padding: .3rem .8rem; }
td { text-align: right; } th, td:first-child { text-align: left; } img { max-width: 100%; }
.warning { background: #fdf3e1; border-left: 4px solid #d9902f; padding: .5rem 1rem; margin: .5rem 0; }
.good { background: #eaf5ea; border-left: 4px solid #4a944a; padding: .5rem 1rem; margin: .5rem 0; }
"""
_COMPONENTS = (("x", "#c8553d"), ("y", "#5b8c5a"), ("z", "#7a9cc6"))
_TITLES = {
    "position": "position",
    "orientation": "orientation (rotation vector)",
    "velocity": "velocity",
    "angular_velocity": "angular velocity",
}


def write_report(path: Path, result: FitResult, title: str) -> None:
    """Writes estimates, intervals, warnings, correlations, starts and residual plots to an HTML file."""
    sections = [
        f"<h1>{escape(title)}</h1>",
        _summary(result),
        _warnings(result),
        "<h2>Estimates</h2>",
        _picture(interval_figure(result), "estimates and intervals"),
        _estimates(result),
        "<h2>Correlations</h2>",
        _correlations(result),
        "<h2>Residuals</h2><p>Simulated minus recorded, in units of the noise given; they should scatter evenly about 0 "
        "with a standard deviation of 1, and their histogram should follow the normal curve.</p>",
        _picture(residual_figure(result), "residuals over time"),
        _picture(histogram_figure(result), "histograms of the residuals"),
        "<h2>Starts</h2>",
        _starts(result),
    ]
    page = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title><style>{_STYLE}</style>'
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page + "<body>" + "\n".join(sections) + "</body></html>\n", encoding="utf-8")


def interval_figure(result: FitResult) -> Figure:
    """Each estimate with its interval, in shares of the estimate."""
    figure, axes = _figure(1, 1.0 + 0.4 * len(result.labels))
    rows = np.arange(len(result.labels))
    scale = np.where(result.values == 0, 1.0, np.abs(result.values))
    low, high = ((end - result.values) / scale * 100 for end in (result.lower, result.upper))
    shown = np.isfinite(low) & np.isfinite(high)
    axes[0, 0].errorbar(
        np.zeros(shown.sum()), rows[shown], xerr=[-low[shown], high[shown]], fmt="o", color="#3a5f8a", capsize=4
    )
    for row in rows[~shown]:
        axes[0, 0].text(0, row, "not determined", ha="center", va="center", color="#c8553d")
    axes[0, 0].set_yticks(rows, result.labels)
    axes[0, 0].set_ylim(len(rows) - 0.5, -0.5)
    axes[0, 0].set_xlabel(f"{result.confidence:.0%} interval about the estimate [%]")
    axes[0, 0].grid(alpha=0.3)
    return figure


def residual_figure(result: FitResult) -> Figure:
    """Residuals of all trajectories over time, a row for each channel and a column for each body."""
    names, bodies = list(result.residuals), result.data.bodies
    figure, axes = _figure(len(names), 2.4 * len(names), len(bodies))
    time = np.arange(result.data.frame_count) * result.data.dt
    size = 5 if result.data.count * result.data.frame_count < 500 else 2
    for row, name in enumerate(names):
        for column, body in enumerate(bodies):
            cell = axes[row, column]
            for k, (component, colour) in enumerate(_COMPONENTS):
                values = result.residuals[name][:, :, column, k]
                times = np.broadcast_to(time, values.shape)
                cell.plot(times.ravel(), values.ravel(), ".", markersize=size, alpha=0.5, color=colour, label=component)
            cell.axhline(0, color="black", linewidth=0.8)
            cell.set(title=f"{body}: {_TITLES[name]}", xlabel="time [s]", ylabel="residual / noise")
            cell.grid(alpha=0.3)
    axes[0, 0].legend(loc="upper left", fontsize="small", markerscale=8 / size)
    return figure


def histogram_figure(result: FitResult) -> Figure:
    """Distribution of the residuals of each channel beside the normal one."""
    names = list(result.residuals)
    figure, axes = _figure(1, 2.6, len(names))
    for column, name in enumerate(names):
        values = result.residuals[name]
        values = values[np.isfinite(values)]
        reach = max(4.0, float(np.quantile(np.abs(values), 0.99)))
        grid = np.linspace(-reach, reach, 201)
        cell = axes[0, column]
        cell.hist(np.clip(values, -reach, reach), bins=50, density=True, color="#7a9cc6")
        cell.plot(grid, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), color="#c8553d", label="normal, deviation 1")
        cell.set(title=_TITLES[name], xlabel="residual / noise", ylabel="density")
        cell.legend(fontsize="small")
    return figure


def _figure(rows: int, height: float, columns: int = 1) -> tuple[Figure, np.ndarray]:
    # A figure without pyplot needs no display and leaves no global state behind.
    figure = Figure(figsize=(9.0, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _picture(figure: Figure, description: str) -> str:
    memory = io.BytesIO()
    figure.savefig(memory, format="png", dpi=110)
    data = base64.b64encode(memory.getvalue()).decode("ascii")
    return f'<p><img alt="{escape(description)}" src="data:image/png;base64,{data}"></p>'


def _summary(result: FitResult) -> str:
    data = result.data
    count = sum(int(np.isfinite(values).sum()) for values in result.residuals.values())
    return (
        f"<p>{data.count} trajectories of up to {data.frame_count} frames, {data.dt:.6g} s apart; {count} residuals; "
        f"{'converged' if result.converged else '<b>not converged</b>'} in {result.steps} steps. "
        f"Root mean square of the residuals: {result.noise_factor:.3g} times the noise given.</p>"
    )


def _warnings(result: FitResult) -> str:
    if not result.warnings:
        return '<p class="good">No warnings: every parameter is determined and the residuals are as large as the noise.</p>'
    return "".join(f'<p class="warning">{escape(warning)}</p>' for warning in result.warnings)


def _estimates(result: FitResult) -> str:
    rows = zip(result.labels, result.values, result.units, result.lower, result.upper, strict=True)
    return _table(
        ["parameter", "estimate", "unit", f"{result.confidence:.0%} from", "to"],
        [[label, f"{value:.6g}", unit, f"{low:.6g}", f"{high:.6g}"] for label, value, unit, low, high in rows],
    )


def _correlations(result: FitResult) -> str:
    rows = [
        [label, *(f"{value:+.3f}" for value in row)]
        for label, row in zip(result.labels, result.correlation, strict=True)
    ]
    return _table(["", *result.labels], rows)


def _starts(result: FitResult) -> str:
    rows = [
        [str(k), *(f"{value:.6g}" for value in start.values), f"{start.cost:.6g}", "yes" if start.converged else "no"]
        for k, start in enumerate(result.starts)
    ]
    return _table(["start", *result.labels, "cost", "converged"], rows)


def _table(header: list[str], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"
