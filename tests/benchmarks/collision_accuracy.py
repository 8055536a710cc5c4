"""Worst errors of the convex distance by pair of kinds, kind of pose and precision, against the float64 oracle.

    python -m tests.benchmarks.collision_accuracy [poses per kind] [--pairs box_cone,...]

Writes ``results/collision_accuracy.json`` and ``.md``; what earlier runs found for other pairs is kept.
"""

from __future__ import annotations

import jax
import numpy as np

from tests.benchmarks.pair_report import run
from tests.benchmarks.pose_sweep import GATES, gate, kinds_of_pose, measure, sweep
from tests.convex_oracle import PAIRS

PRECISIONS = ("float32", "float64")


def main(arguments: list[str] | None = None) -> None:
    """Runs the sweep and writes both files."""
    run("collision_accuracy", __doc__, (30, "poses of each kind"), PAIRS, in_each_precision, table, arguments)


def in_each_precision(pair: tuple[str, str], count: int) -> list[dict]:
    """Rows of a pair."""
    found = []
    for precision in PRECISIONS:
        with jax.enable_x64(precision == "float64"):
            found += [row(pair, kind, count, precision) for kind in kinds_of_pose()]
            jax.clear_caches()
    return found


def row(pair: tuple[str, str], kind: str, count: int, precision: str) -> dict:
    """Worst errors and counts of one class."""
    dtype = np.dtype(precision)
    errors = measure(pair, sweep(pair, kind, count, dtype), dtype)
    flagged = ~errors["converged"]
    wrong = ~(np.maximum(errors["separation"], errors["normal"]) <= gate(pair, dtype))
    return {
        "pair": "_".join(pair),
        "pose": kind,
        "precision": precision,
        "poses": count,
        "flagged": int(flagged.sum()),
        "wrong": int(wrong.sum()),
        "wrong_unflagged": int((wrong & ~flagged).sum()),
        **{name: float(errors[name].max()) for name in ("separation", "normal", "points")},
    }


def table(rows: list[dict]) -> str:
    """The report in Markdown: a summary by pair, then by kind of pose."""
    lines = [
        "# Accuracy of the convex distance",
        "",
        "Written by `python -m tests.benchmarks.collision_accuracy`: random poses of every kind and pair in each precision,",
        "against cutting planes in float64 (NNLS, Qhull). Errors in units of the larger shape: of the",
        "separation, of the normal (separation lost along it), and the distance of the contact points from the surfaces.",
        "*Flagged*: `converged` is false, the answer is not proved. *Wrong*: separation or normal beyond the gate of "
        f"{GATES['float32'][0]:g} (float32),",
        f"{GATES['float64'][0]:g} (float64), {GATES['float64'][1]:g} (float64 with a cylinder or cone).",
        'Spheres in "needles: random" are 50 to 1900 of their sizes apart, which float32 can not tell to the gate: they err',
        "by 3e-7 of the distance.",
    ]
    for precision in sorted({r["precision"] for r in rows}):
        for key, title in (("pair", "Pair"), ("pose", "Kind of pose")):
            lines += ["", f"## {precision} by {title.lower()}", "", f"| {title} | poses | flagged | wrong | wrong, not"]
            lines[-1] += " flagged | separation | normal | points |"
            lines.append("|---|---|---|---|---|---|---|---|")
            chosen = [r for r in rows if r["precision"] == precision]
            for name in dict.fromkeys(r[key] for r in chosen):
                lines.append(_line(name, [r for r in chosen if r[key] == name]))
            lines.append(_line("all", chosen))
    return "\n".join(lines) + "\n"


def _line(name: str, rows: list[dict]) -> str:
    counts = [sum(r[k] for r in rows) for k in ("poses", "flagged", "wrong", "wrong_unflagged")]
    worst = [f"{max(r[k] for r in rows):.1e}" for k in ("separation", "normal", "points")]
    return f"| {name} | {' | '.join(map(str, counts))} | {' | '.join(worst)} |"


if __name__ == "__main__":
    main()
