"""Pairs per CPU-second of the narrow phase, beside Coal (C++) and MJX where they are installed.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.pair_speed [--count 4096] [--cases hull16_apart,...]

All contestants of a case see the same poses in float32 and take turns within a round (`timing`). Writes
``results/pair_speed.json`` and ``.md``.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from mathota_jax.collision.convex import convex_distance
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, to_matrix
from mathota_jax.spatial.vector import Vec3
from tests.benchmarks.settings import QUICK
from tests.benchmarks.timing import Contestant, interleave, paired_ratio, summary

RESULTS = pathlib.Path(__file__).parent / "results"
CASES = {
    "box_box": ("box", "box", 1.0),
    "hull16_apart": ("polyhedron", "polyhedron", 2.2),
    "hull16_deep": ("polyhedron", "polyhedron", 0.5),
    "capsule_hull16": ("capsule", "polyhedron", 1.5),
}
"""Kinds, and distance of the centres of shapes about 1 m in radius."""
HALF_EXTENTS = (0.5, 0.6, 0.4)
CAPSULE = (0.2, 0.5)
VERTICES = 16


def main(arguments: list[str] | None = None) -> None:
    """Measures the chosen cases and writes both files."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.pair_speed", description=__doc__)
    parser.add_argument("--count", type=int, default=4096)
    parser.add_argument("--cases", default=",".join(CASES))
    options = parser.parse_args(arguments)
    report = {name: measure(name, options.count) for name in options.cases.split(",")}
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "pair_speed.json").write_text(json.dumps({"count": options.count, "cases": report}, indent=1) + "\n")
    (RESULTS / "pair_speed.md").write_text(table(report, options.count))


def measure(name: str, count: int) -> dict[str, Any]:
    """Rates [pairs per CPU-second], compile times [CPU-s] and ratios of one case."""
    kind_a, kind_b, distance = CASES[name]
    rng = np.random.default_rng(0)
    offsets = rng.normal(size=(count, 3))
    offsets *= distance / np.linalg.norm(offsets, axis=1, keepdims=True)
    turns = [Rotation.random(count, random_state=rng) for _ in range(2)]  # pyright: ignore[reportCallIssue]
    points = rng.normal(size=(VERTICES, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    contestants: dict[str, Contestant] = {}
    compile_seconds: dict[str, float] = {}
    for label, function in _functions(kind_a, kind_b, points).items():
        inputs = [_vector(offsets), *(_quaternion(turn) for turn in turns)]
        started = time.process_time()
        compiled = jax.jit(function).lower(*inputs).compile()
        compile_seconds[label] = time.process_time() - started
        contestants[label] = Contestant(_block(compiled, inputs, count), {"count": count})
    missing = {}
    for label, module, build in (("Coal", "coal", _coal), ("MJX", "mujoco.mjx", _mjx)):
        if not _installed(module):
            missing[label] = "not installed"
        elif (block := build(kind_a, kind_b, points, offsets, turns)) is None:
            missing[label] = "has no such pair"
        else:
            contestants[label] = Contestant(block, {"count": count}, rounds=3)
    interleave(contestants, QUICK)
    ratios = {
        f"{ours} / {peer}": paired_ratio(contestants[ours], contestants[peer])["median"]
        for ours in ("value", "manifold", "value and gradient")
        for peer in ("Coal", "MJX", "value")
        if ours in contestants and peer in contestants and ours != peer
    }
    rates = {label: summary(contestant.cpu_rates) for label, contestant in contestants.items()}
    return {"rates": rates, "compile_cpu_seconds": compile_seconds, "ratios": ratios, "missing": missing}


def _functions(kind_a: str, kind_b: str, points: np.ndarray) -> dict[str, Callable]:
    def shape(kind: str) -> dict[str, Any]:
        if kind == "box":
            return {"half_extents": Vec3(*(jnp.full((1, 1), h, jnp.float32) for h in HALF_EXTENTS))}
        if kind == "capsule":
            return dict(
                zip(("radius", "half_height"), (jnp.full((1, 1), x, jnp.float32) for x in CAPSULE), strict=True)
            )
        return {"vertices": Vec3(*(jnp.asarray(points[:, k, None, None], jnp.float32) for k in range(3)))}

    a, b = shape(kind_a), shape(kind_b)

    def poses(offset: Vec3, turn_a: Quaternion, turn_b: Quaternion) -> tuple[Pose, Pose]:
        return Pose(offset * 0.0, to_matrix(turn_a)), Pose(offset, to_matrix(turn_b))

    def value(*inputs: Any) -> Any:
        pose_a, pose_b = poses(*inputs)
        if (kind_a, kind_b) == ("box", "box"):
            return PAIRS["box", "box"].function(a, pose_a, b, pose_b)
        return convex_distance(kind_a, a, pose_a, kind_b, b, pose_b)

    def total(*inputs: Any) -> Any:
        found = value(*inputs)
        return sum(p.separation.sum() for p in found.points) if hasattr(found, "points") else found.separation.sum()

    return {
        "manifold" if kind_a == "box" else "value": value,
        "value and gradient": jax.value_and_grad(total, argnums=(0, 1, 2)),
    }


def _vector(rows: np.ndarray) -> Vec3:
    return Vec3(*(jnp.asarray(rows[None, :, k], jnp.float32) for k in range(3)))


def _quaternion(turn: Rotation) -> Quaternion:
    rows = turn.as_quat()
    return Quaternion(*(jnp.asarray(rows[None, :, k], jnp.float32) for k in (3, 0, 1, 2)))


def _block(compiled: Callable, inputs: list, count: int) -> Callable[[], int]:
    def block() -> int:
        jax.block_until_ready(compiled(*inputs))
        return count

    return block


def _installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def _coal(kind_a: str, kind_b: str, points: np.ndarray, offsets: np.ndarray, turns: list) -> Callable[[], int]:
    """Signed distances of all pairs in a Python loop; the loop itself is a few per cent of it."""
    import coal  # pyright: ignore[reportMissingImports]

    def shape(kind: str) -> Any:
        if kind == "box":
            return coal.Box(*(2 * h for h in HALF_EXTENTS))
        if kind == "capsule":
            return coal.Capsule(CAPSULE[0], 2 * CAPSULE[1])
        found = coal.StdVec_Vec3s()
        for point in points:
            found.append(point)
        return coal.ConvexBase.convexHull(found, False, None)

    a, b = shape(kind_a), shape(kind_b)
    identity = np.zeros(3)
    places_a = [coal.Transform3s(r, identity) for r in turns[0].as_matrix()]
    places_b = [coal.Transform3s(r, p) for r, p in zip(turns[1].as_matrix(), offsets, strict=True)]
    request, result = coal.DistanceRequest(), coal.DistanceResult()

    def block() -> int:
        for place_a, place_b in zip(places_a, places_b, strict=True):
            result.clear()
            coal.distance(a, place_a, b, place_b, request, result)
        return len(places_a)

    return block


def _mjx(kind_a: str, kind_b: str, points: np.ndarray, offsets: np.ndarray, turns: list) -> Callable[[], int] | None:
    """MJX's manifold of two boxes; its other pairs answer another question (deepest overlap only)."""
    from mujoco.mjx._src import collision_convex, collision_types, mesh  # pyright: ignore[reportMissingImports]

    del points
    if (kind_a, kind_b) != ("box", "box"):
        return None
    size = jnp.asarray(HALF_EXTENTS, jnp.float32)

    def manifold(offset: jax.Array, turn_a: jax.Array, turn_b: jax.Array) -> Any:
        boxes = [
            mesh.box(collision_types.GeomInfo(place, turn, size))
            for place, turn in ((jnp.zeros(3), turn_a), (offset, turn_b))
        ]
        return collision_convex._box_box(*boxes)

    inputs = [jnp.asarray(x, jnp.float32) for x in (offsets, turns[0].as_matrix(), turns[1].as_matrix())]
    return _block(jax.jit(jax.vmap(manifold)), inputs, len(offsets))


def table(report: dict, count: int) -> str:
    """The report in Markdown."""
    lines = [
        "# Speed of the narrow phase",
        "",
        f"Written by `python -m tests.benchmarks.pair_speed --count {count}`: {count} pairs in float32 (Coal: float64), one",
        "thread, process CPU time, contestants in turns; medians. Coal answers with the signed distance and one pair of",
        "points. Ratios are rates taken within a round: above 1 the first is faster.",
        "",
        "| case | contestant | pairs per CPU-s | compile CPU-s |",
        "|---|---|---|---|",
    ]
    for name, case in report.items():
        for label, rate in case["rates"].items():
            seconds = case["compile_cpu_seconds"].get(label)
            lines.append(f"| {name} | {label} | {rate['median']:.3g} | {'' if seconds is None else f'{seconds:.1f}'} |")
        lines += [f"| {name} | {label} | {reason} | |" for label, reason in case["missing"].items()]
    lines += ["", "| case | ratio | |", "|---|---|---|"]
    lines += [f"| {name} | {label} | {x:.3g} |" for name, case in report.items() for label, x in case["ratios"].items()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
