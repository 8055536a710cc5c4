"""The convex distance in many random poses, separated to deep, against every direction that can separate (float64).

    python -m tests.benchmarks.pose_classes [poses per pair] [--pairs box_polyhedron,...]

Writes ``results/pose_classes.json`` and ``.md``; what earlier runs found for other pairs is kept.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from tests.benchmarks.pair_report import run
from tests.benchmarks.pose_sweep import GATES
from tests.convex_oracle import Result, random_scene, rounded
from tests.polytope_oracle import placed, polytope_distance, polytope_pairs, separations
from tests.round_oracle import KINDS as ROUND
from tests.round_oracle import round_distance

CLASSES = {"separated": (1e-2, 1.0), "touching": (-1e-4, 1e-4), "shallow": (-1e-2, -1e-4), "deep": (0.0, 0.0)}
"""Separation [size], uniform between these; deep poses stay where they are drawn."""
DEEP_REACH = 0.5
"""Largest distance [m] of the centres of deep poses."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the sweep and writes both files."""
    meaning = "poses of each pair in each precision"
    run("pose_classes", __doc__, (20000, meaning), polytope_pairs(), in_each_precision, table, arguments)


def in_each_precision(pair: tuple[str, str], count: int) -> list[dict]:
    """Rows of a pair: the same poses in both precisions."""
    scene, kinds, sizes = draw(pair, count)
    found = []
    for precision in ("float32", "float64"):
        with jax.enable_x64(precision == "float64"):
            found += measure(pair, scene, kinds, sizes, precision)
            jax.clear_caches()
    return found


def exact(pair: tuple[str, str], scene: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances [m] and normals: in closed form where there is one."""
    return (round_distance if set(pair) <= set(ROUND) else polytope_distance)(pair, scene)


def draw(pair: tuple[str, str], count: int) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Poses with the name of the class of each, in equal shares, and the extent [m] of the larger shape of each."""
    rng = np.random.default_rng(count)
    scene: dict[str, Any] = random_scene(pair, count)
    kinds = np.array(list(CLASSES))[np.arange(count) % len(CLASSES)]
    scene["pb"] = np.where(
        (kinds == "deep")[:, None], scene["pa"] + DEEP_REACH / 2 * (scene["pb"] - scene["pa"]), scene["pb"]
    )
    extents = [
        np.linalg.norm(cores.corners - scene["p" + side][:, None], axis=2).max(1) + cores.radius
        for side, cores in zip("ab", placed(pair, scene), strict=True)
    ]
    sizes = np.maximum(extents[0], extents[1])
    truths, normals = exact(pair, scene)
    limits = np.array([CLASSES[kind] for kind in kinds])
    gaps = rng.uniform(limits[:, 0], limits[:, 1]) * sizes
    shift = np.where(kinds == "deep", 0.0, gaps - truths)
    scene["pb"] = scene["pb"] + shift[:, None] * normals
    return scene, kinds, sizes


def measure(pair: tuple[str, str], scene: dict, kinds: np.ndarray, sizes: np.ndarray, precision: str) -> list[dict]:
    """Worst errors and counts of each class in one precision."""
    scene = rounded(scene, precision)
    truths, _ = exact(pair, scene)
    result = Result(pair, scene, np.dtype(precision))
    unit = result.normal / np.linalg.norm(result.normal, axis=1, keepdims=True)
    a, b = placed(pair, scene)
    reach = separations(a, b, unit[:, None])[:, 0]
    separation, normal = np.abs(result.separation - truths) / sizes, np.abs(reach - truths) / sizes
    gate = GATES[precision][0]
    wrong = ~(np.maximum(separation, normal) <= gate)
    flips = ((result.separation < 0) != (truths < 0)) & (np.abs(truths) > gate * sizes)
    rows = []
    for kind in CLASSES:
        chosen = kinds == kind
        rows.append(
            {
                "pair": "_".join(pair),
                "class": kind,
                "precision": precision,
                "poses": int(chosen.sum()),
                "flagged": int((~result.converged & chosen).sum()),
                "wrong": int((wrong & chosen).sum()),
                "wrong_unflagged": int((wrong & chosen & result.converged).sum()),
                "flips": int((flips & chosen).sum()),
                "separation": float(separation[chosen].max()),
                "normal": float(normal[chosen].max()),
            }
        )
    return rows


def table(rows: list[dict]) -> str:
    """The report in Markdown."""
    lines = [
        "# Convex distance in many random poses",
        "",
        "Written by `python -m tests.benchmarks.pose_classes`: a quarter of the poses of each pair separated (0.01 to 1",
        "size), touching (within 1e-4), shallow (1e-4 to 0.01 deep) and deep (centres within 0.5 m). Truth in float64 by",
        "closed forms (spheres, capsules) or the best of all directions that can separate polytopes. Errors in units of the",
        "larger shape: of the separation, and of the normal (separation lost along it). *Flagged*: `converged` is false.",
        f"*Wrong*: either beyond {GATES['float32'][0]:g} (float32), {GATES['float64'][0]:g} (float64). *Flips*:",
        "wrong sign beyond that. Pairs with a cylinder or cone: see [collision_accuracy](collision_accuracy.md).",
    ]
    keys = ("poses", "flagged", "wrong", "wrong_unflagged", "flips")
    for precision in ("float32", "float64"):
        lines += ["", f"## {precision}", "", "| Pair | class | poses | flagged | wrong | wrong, not flagged | flips |"]
        lines[-1] += " separation | normal |"
        lines.append("|---|---|---|---|---|---|---|---|---|")
        chosen = [row for row in rows if row["precision"] == precision]
        for row in chosen:
            cells = [row["pair"], row["class"], *(str(row[key]) for key in keys)]
            lines.append(f"| {' | '.join(cells)} | {row['separation']:.1e} | {row['normal']:.1e} |")
        totals = " | ".join(str(sum(row[key] for row in chosen)) for key in keys)
        worst = [f"{max(row[key] for row in chosen):.1e}" for key in ("separation", "normal")]
        lines.append(f"| all |  | {totals} | {' | '.join(worst)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
