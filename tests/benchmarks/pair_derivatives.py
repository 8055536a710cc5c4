"""Derivatives of distance, normal and witness points of every pair of shapes, against central differences in float64.

    python -m tests.benchmarks.pair_derivatives [poses per pair] [--pairs box_cone,...]

Writes ``results/pair_derivatives.json`` and ``.md``; what earlier runs found for other pairs is kept. By poses, and by all
parameters of both shapes. Differences are of fourth order at several step lengths; where they disagree among themselves a
feature changes within the difference, and the pose is left out for that parameter and counted.
"""

from __future__ import annotations

import dataclasses
import itertools
import zlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.spatial.transform import Rotation

from mathota_jax import Box, Capsule, Cone, Cylinder, Geometry, Heightfield, Plane, Polyhedron, Sphere, signed_distance
from mathota_jax.collision.height_grid import window_size
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.geometry import SHAPES
from tests.benchmarks.pair_report import run

GATE = 1e-6
STEPS = (4e-3, 1e-3, 2.5e-4)
"""Step lengths [m, rad] of the central differences; shapes are half a metre in size."""
AGREEMENT = 3e-7
"""Largest disagreement of the differences of two step lengths that counts as smooth."""
OUTPUTS = ("separation", "normal", "point A", "point B")
ENDS = np.cumsum([1, 3, 3, 3])


def shape(kind: str) -> Any:
    """A shape of each kind, none of it symmetric by chance."""
    draw = np.random.default_rng(1)
    points = draw.normal(size=(10, 3))
    return {
        "plane": lambda: Plane((0.1, 1.0, 0.2), 0.2),
        "sphere": lambda: Sphere(0.4),
        "capsule": lambda: Capsule(0.2, 0.5),
        "box": lambda: Box((0.3, 0.4, 0.5)),
        "cylinder": lambda: Cylinder(0.3, 0.4),
        "cone": lambda: Cone(0.35, 0.4),
        "polyhedron": lambda: Polyhedron(0.5 * points / np.linalg.norm(points, axis=1)[:, None]),
        "heightfield": lambda: Heightfield(0.15 * draw.normal(size=(5, 5)), 0.6),
    }[kind]()


def geometries(pair: tuple[str, str]) -> tuple[Geometry, Geometry]:
    """Both shapes; a heightfield with the window that its sizes, which are traced, can not tell."""
    a, b = (Geometry.of(shape(kind)) for kind in pair)
    if b.kind == "heightfield":
        reach = float(SHAPES[a.kind].reach_of({name: np.asarray(value) for name, value in a.parameters.items()}))
        b = dataclasses.replace(b, window=window_size(reach, float(b.parameters["cell_size"])))
    return a, b


def random_poses(pair: tuple[str, str], count: int) -> np.ndarray:
    """Positions and quaternions of both shapes (pose, 14), apart and overlapping."""
    draw = np.random.default_rng(zlib.crc32("_".join(pair).encode()))
    places = draw.normal(size=(count, 2, 3)) * 0.1
    offset = draw.normal(size=(count, 3))
    offset *= draw.uniform(0.5, 1.3, (count, 1)) / np.linalg.norm(offset, axis=1, keepdims=True)
    turns = Rotation.random(2 * count, random_state=draw).as_quat()[:, [3, 0, 1, 2]].reshape(count, 2, 4)  # pyright: ignore[reportCallIssue]
    if pair[1] == "heightfield":
        # The field stays all but level; what meets it is above it.
        places[:, 1], offset = 0.0, np.stack([*draw.uniform(-0.8, 0.8, (2, count)), draw.uniform(0.3, 0.8, count)], 1)
        offset = -offset[:, [0, 2, 1]]
        turns[:, 1] = np.array([1.0, 0.02, -0.03, 0.01]) / np.linalg.norm([1.0, 0.02, -0.03, 0.01])
        places[:, 0] = -offset
    else:
        places[:, 1] += offset
    return np.concatenate([places[:, 0], turns[:, 0], places[:, 1], turns[:, 1]], axis=1)


def parameters_of(pair: tuple[str, str]) -> tuple[list[str], Callable[[Any, Any], Any], np.ndarray]:
    """Label of each entry of the vector that is differentiated by; the outputs as its function; where it begins.

    The vector holds position [m] and rotation vector [rad] of both shapes from the pose given, then their sizes.
    """
    a, b = geometries(pair)
    sizes, unravel = ravel_pytree((a.parameters, b.parameters))
    labels = [f"{what} {side}" for side in "AB" for what in ("position", "orientation") for _ in range(3)]
    for side, geometry in zip("AB", (a, b), strict=True):
        # ravel_pytree takes the leaves in the order of their names.
        labels += [
            f"{name} {side}" for name in sorted(geometry.parameters) for _ in range(geometry.parameters[name].size)
        ]

    def outputs(vector: Any, pose: Any) -> Any:
        by_a, by_b = unravel(vector[12:])
        found = signed_distance(
            dataclasses.replace(a, parameters=by_a),
            (pose[:3] + vector[:3], _turned(vector[3:6], pose[3:7])),
            dataclasses.replace(b, parameters=by_b),
            (pose[7:10] + vector[6:9], _turned(vector[9:12], pose[10:14])),
        )
        return jnp.concatenate([found.separation[None], found.normal, found.point_a, found.point_b])

    return labels, outputs, np.concatenate([np.zeros(12), np.asarray(sizes)])


def _turned(vector: Any, quaternion: Any) -> Any:
    """The orientation turned by a small rotation vector (world frame)."""
    turn = jnp.concatenate([jnp.ones(1), 0.5 * vector])
    turn = turn / jnp.linalg.norm(turn)
    w, v = turn[0], turn[1:]
    qw, qv = quaternion[0], quaternion[1:]
    return jnp.concatenate([(w * qw - v @ qv)[None], w * qv + qw * v + jnp.cross(v, qv)])


def differences(outputs: Any, start: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Central differences (pose, output, entry) of fourth order, and whether two step lengths agree on them."""
    size = len(start)
    run = jax.jit(jax.vmap(jax.vmap(outputs, (0, None)), (None, 0)))
    found = []
    for length in STEPS:
        offsets = np.concatenate([k * length * np.eye(size) for k in (1, -1, 2, -2)])
        values = np.moveaxis(np.asarray(run(start + offsets, poses)), 1, -1).reshape(len(poses), -1, 4, size)
        near, far = values[:, :, 0] - values[:, :, 1], values[:, :, 2] - values[:, :, 3]
        found.append((8 * near - far) / (12 * length))
    scale = np.maximum(1.0, np.abs(found[-1]))
    gaps = np.stack([np.abs(b - a) / scale for a, b in itertools.pairwise(found)])
    best = gaps.argmin(0)
    chosen = np.where(best == 0, found[1], found[2])
    return chosen, gaps.min(0) <= AGREEMENT


def measure(pair: tuple[str, str], count: int) -> list[dict]:
    """Worst errors of each parameter of a pair, over all poses that are smooth in it."""
    labels, outputs, start = parameters_of(pair)
    poses = random_poses(pair, count)
    derivative = np.asarray(jax.jit(jax.vmap(jax.jacfwd(outputs), (None, 0)))(start, poses))
    truth, smooth = differences(outputs, start, poses)
    error = np.abs(derivative - truth) / np.maximum(1.0, np.abs(truth))
    rows = []
    for label in dict.fromkeys(labels):
        entries = np.array([index for index, name in enumerate(labels) if name == label])
        kept = smooth[:, :, entries].all((1, 2))
        worst = {
            name: float(error[kept][:, end - width : end][:, :, entries].max(initial=0.0))
            for name, end, width in zip(OUTPUTS, ENDS, (1, 3, 3, 3), strict=True)
        }
        finite = bool(np.isfinite(derivative[:, :, entries]).all())
        rows.append({"pair": "_".join(pair), "parameter": label, "kept": int(kept.sum()), "finite": finite, **worst})
        rows[-1]["largest"] = float(np.abs(truth[kept][:, :, entries]).max(initial=0.0))
        rows[-1]["poses"] = count
    return rows


def main(arguments: list[str] | None = None) -> None:
    """Measures the chosen pairs and writes both files."""
    run("pair_derivatives", __doc__, (24, "poses of each pair"), PAIRS, in_float64, table, arguments)


def in_float64(pair: tuple[str, str], count: int) -> list[dict]:
    """Rows of a pair, the worst of which is printed."""
    with jax.enable_x64(True):
        found = measure(pair, count)
        jax.clear_caches()
    print(pair, max(max(row[name] for name in OUTPUTS) for row in found), flush=True)
    return found


def table(rows: list[dict]) -> str:
    """The report in Markdown: a line for each pair, then one for each pair and parameter."""
    pairs = list(dict.fromkeys(row["pair"] for row in rows))
    lines = [
        "# Derivatives of the distance of two shapes",
        "",
        "Written by `python -m tests.benchmarks.pair_derivatives`: `signed_distance` of random poses, apart and",
        "overlapping, differentiated by poses (rotation vector of the orientation) and all sizes, against central",
        "differences of fourth order in float64. Errors are absolute where a derivative is below 1 and relative above; gate",
        f"{GATE:g}. Left out are poses in which differences of two lengths disagree by more than {AGREEMENT:g}: there a",
        "feature (face, edge, corner) changes within the difference. *Kept* counts the others.",
        "",
        "## By pair",
        "",
        "| Pair | kept | separation | normal | point A | point B | NaN |",
        "|---|---|---|---|---|---|---|",
    ]
    for pair in pairs:
        chosen = [row for row in rows if row["pair"] == pair]
        lines.append(_line(pair, chosen))
    lines.append(_line("all", rows))
    missing = [name for name in ("_".join(pair) for pair in PAIRS) if name not in pairs]
    if missing:
        lines += ["", f"Not measured: {', '.join(missing)}."]
    lines += [
        "",
        "## By pair and parameter",
        "",
        "| Pair | parameter | kept | separation | normal | point A | point B |",
    ]
    lines += ["|---|---|---|---|---|---|---|"]
    for row in rows:
        cells = [f"{row['kept']} of {row['poses']}", *(f"{row[name]:.0e}" for name in OUTPUTS)]
        lines.append(f"| {row['pair']} | {row['parameter']} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _line(name: str, rows: list[dict]) -> str:
    kept = f"{sum(row['kept'] for row in rows)} of {sum(row['poses'] for row in rows)}"
    worst = [f"{max(row[output] for row in rows):.1e}" for output in OUTPUTS]
    return f"| {name} | {kept} | {' | '.join(worst)} | {'none' if all(row['finite'] for row in rows) else 'yes'} |"


if __name__ == "__main__":
    main()
