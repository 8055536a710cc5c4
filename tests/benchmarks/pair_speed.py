"""Pairs per CPU-second of the narrow phase with its errors, beside Coal (C++) and MJX where they are installed.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.pair_speed [--count 4096] [--cases hull16_apart,...]

All contestants of a case see the same poses and take turns within a round (`timing`). Writes
``results/pair_speed.json`` and ``.md``; what earlier runs measured of other cases is kept.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from mathota_jax.collision.convex import convex_distance
from mathota_jax.collision.pairs import PAIRS, SEARCHED
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import to_matrix
from tests.benchmarks import pair_peers
from tests.benchmarks.process import ONE_CORE
from tests.benchmarks.settings import QUICK
from tests.benchmarks.timing import Contestant, interleave, paired_ratio, summary
from tests.convex_oracle import Placed, oracle, to_engine
from tests.direction_oracle import direction_distance
from tests.hulls import hull

RESULTS = pathlib.Path(__file__).parent / "results"
CHECKED = 100
"""Poses whose separation is compared with the float64 oracle."""
PEER_ROUNDS = 5


def _unit_points(count: int) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


POINTS = {count: _unit_points(count) for count in (16, 64)}
"""Corners of the hulls, on the unit sphere."""


class Case(NamedTuple):
    """Kinds, distance of the centres [m] of shapes about 1 m in radius, corners of the hulls, and the separations [m]."""

    pair: tuple[str, str]
    distance: float
    corners: int = 16
    separations: tuple[float, float] | None = None
    """Least and largest, uniform between them, by moving B along the normal; None leaves it where it is."""


CASES = {
    "sphere_box": Case(("sphere", "box"), 1.0),
    "capsule_capsule": Case(("capsule", "capsule"), 1.0),
    "capsule_box": Case(("capsule", "box"), 1.2),
    "box_box": Case(("box", "box"), 1.0),
    "capsule_hull16": Case(("capsule", "polyhedron"), 2.0),
    "hull16_apart": Case(("polyhedron", "polyhedron"), 2.2),
    "hull16_deep": Case(("polyhedron", "polyhedron"), 0.5),
    "hull64_deep": Case(("polyhedron", "polyhedron"), 0.5, 64),
    "cylinder_cylinder_apart": Case(("cylinder", "cylinder"), 2.2),
    "cylinder_cylinder_touching": Case(("cylinder", "cylinder"), 1.0, separations=(-1e-3, 1e-4)),
    "cylinder_cylinder_deep": Case(("cylinder", "cylinder"), 0.5),
}
VALUE, MANIFOLD, GRADIENT = "signed distance", "manifold", "value and gradient"
TARGETS = {
    ("box_box", VALUE, "Coal"): 20.0,
    ("box_box", MANIFOLD, "MJX"): 20.0,
    ("hull16_apart", VALUE, "Coal"): 4.0,
    ("hull16_deep", VALUE, "Coal"): 1.0,
    ("capsule_hull16", VALUE, "Coal"): 2.0,
}
GRADIENT_SHARE, COMPILE_LIMIT = 0.25, 3.0
"""Least rate of value and gradient as a share of the value's; most CPU seconds to trace and compile."""


def main(arguments: list[str] | None = None) -> None:
    """Measures the chosen cases and writes both files."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.pair_speed", description=__doc__)
    parser.add_argument("--count", type=int, default=4096)
    parser.add_argument("--cases", default=",".join(CASES))
    options = parser.parse_args(arguments)
    os.environ.update(ONE_CORE)  # read when XLA starts, with the first computation
    RESULTS.mkdir(exist_ok=True)
    stored = RESULTS / "pair_speed.json"
    known = json.loads(stored.read_text()) if stored.exists() else {}
    found = known["cases"] if known.get("count") == options.count else {}
    for name in options.cases.split(","):
        found[name] = measure(CASES[name], options.count)
        ordered = {case: found[case] for case in CASES if case in found}
        stored.write_text(json.dumps({"count": options.count, "cases": ordered}, indent=1) + "\n")
        (RESULTS / "pair_speed.md").write_text(table(ordered, options.count))


def measure(case: Case, count: int) -> dict[str, Any]:
    """Rates [pairs per CPU-second], compile times [CPU-s], ratios of rates and errors [m] of one case."""
    scene = poses(case, count)
    contestants: dict[str, Contestant] = {}
    compile_seconds: dict[str, float] = {}
    errors: dict[str, float] = {}
    truths = np.array([oracle(Placed(case.pair, scene, index), 1e-9)[0] for index in range(CHECKED)])
    shared = {side: {name: rows[:1] for name, rows in scene[side].items()} for side in "ab"}
    arguments = to_engine({**scene, **shared}, np.float32)
    for label, function in functions(case).items():
        started = time.process_time()
        compiled = jax.jit(function).lower(*arguments).compile()
        compile_seconds[label] = time.process_time() - started
        contestants[label] = Contestant(_block(compiled, arguments, count), {})
        if label == VALUE:
            errors[label] = float(np.abs(np.asarray(compiled(*arguments)[0])[0, :CHECKED] - truths).max())
    missing = pair_peers.missing()
    if "Coal" not in missing:
        peer = pair_peers.Coal(case.pair, scene)
        contestants["Coal"] = Contestant(peer.block, {}, rounds=PEER_ROUNDS)
        errors["Coal"] = float(np.abs(peer.separations(CHECKED) - truths).max())
    if "MJX" not in missing and case.pair == ("box", "box"):
        block, compile_seconds["MJX"] = pair_peers.mjx_boxes(scene)
        contestants["MJX"] = Contestant(block, {}, rounds=PEER_ROUNDS)
    interleave(contestants, QUICK)
    pairs = [(ours, peer) for ours in (VALUE, MANIFOLD) for peer in ("Coal", "MJX")] + [(GRADIENT, VALUE)]
    return {
        "overlapping": float((truths < 0).mean()),
        "rates": {label: summary(contestant.cpu_rates) for label, contestant in contestants.items()},
        "compile_cpu_seconds": compile_seconds,
        "ratios": {
            f"{a} / {b}": paired_ratio(contestants[a], contestants[b])["median"]
            for a, b in pairs
            if a in contestants and b in contestants
        },
        "errors": errors,
        "missing": missing,
    }


def poses(case: Case, count: int) -> dict[str, Any]:
    """A scene of `convex_oracle`: one shape of each kind, random directions and turns."""
    rng = np.random.default_rng(0)
    shapes = {
        "sphere": {"radius": 0.5},
        "capsule": {"radius": 0.2, "half_height": 0.5},
        "box": {"half_extents": (0.5, 0.6, 0.4)},
        "cylinder": {"radius": 0.5, "half_height": 0.6},
        "polyhedron": {"vertices": POINTS[case.corners]},
    }
    offsets = rng.normal(size=(count, 3))
    offsets *= case.distance / np.linalg.norm(offsets, axis=1, keepdims=True)
    scene: dict[str, Any] = {"pa": np.zeros((count, 3)), "pb": offsets}
    for side, kind in zip("ab", case.pair, strict=True):
        scene[side] = {n: np.repeat(np.asarray(v, float)[None], count, axis=0) for n, v in shapes[kind].items()}
        scene["q" + side] = Rotation.random(count, random_state=rng).as_quat()[:, [3, 0, 1, 2]]  # pyright: ignore[reportCallIssue]
    if case.separations is not None:
        truths, normals = direction_distance(case.pair, scene)
        scene["pb"] = scene["pb"] + (rng.uniform(*case.separations, size=count) - truths)[:, None] * normals
    return scene


def functions(case: Case) -> dict[str, Callable]:
    """What is timed, of the shapes and poses as `to_engine` gives them; the shapes are shared by all pairs."""
    kind_a, kind_b = case.pair

    def placed(*arguments: Any) -> tuple:
        a, pa, qa, b, pb, qb = arguments
        return _with_faces(a), Pose(pa, to_matrix(qa)), _with_faces(b), Pose(pb, to_matrix(qb))

    def manifold(*arguments: Any) -> Any:
        return PAIRS[case.pair].function(*placed(*arguments))

    def value(*arguments: Any) -> Any:
        if PAIRS[case.pair].method in SEARCHED:
            a, pose_a, b, pose_b = placed(*arguments)
            found = convex_distance(kind_a, a, pose_a, kind_b, b, pose_b)
            return found.separation, found.normal, found.point_a
        if (distance := PAIRS[case.pair].distance) is not None:
            found = distance(*placed(*arguments))
            return found.separation, found.normal, found.point_a
        found = manifold(*arguments)
        active = [jnp.where(point.active, point.separation, jnp.inf) for point in found.points]
        return jnp.min(jnp.stack(jnp.broadcast_arrays(*active)), axis=0), found.normal

    def total(*arguments: Any) -> Any:
        return value(*arguments)[0].sum()

    return {VALUE: value, MANIFOLD: manifold, GRADIENT: jax.value_and_grad(total, argnums=(1, 2, 4, 5))}


def _with_faces(shape: dict[str, Any]) -> dict[str, Any]:
    if "vertices" not in shape:
        return shape
    return {**shape, "faces": hull(POINTS[shape["vertices"].x.shape[0]])[1][None]}


def _block(compiled: Callable, arguments: Any, count: int) -> Callable[[], int]:
    def block() -> int:
        jax.block_until_ready(compiled(*arguments))
        return count

    return block


def table(cases: dict[str, Any], count: int) -> str:
    """The report in Markdown."""
    lines = [
        "# Speed of the narrow phase",
        "",
        f"Written by `python -m tests.benchmarks.pair_speed --count {count}`: {count} pairs in float32 (Coal: float64, from",
        "a Python loop), XLA in one thread, process CPU time, contestants in turns, medians. All see the same poses;",
        "shapes are about 1 m in radius. Signed distance: with normal and points, of most closed forms the",
        f"least of the manifold. Error: the largest of {CHECKED} separations [m] against cutting planes in float64.",
        "",
        "| case | method | overlapping | contestant | pairs per CPU-s | error | compile CPU-s |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, case in cases.items():
        for label, rate in case["rates"].items():
            seconds, error = case["compile_cpu_seconds"].get(label), case["errors"].get(label)
            cells = [
                name,
                PAIRS[CASES[name].pair].method,
                f"{case['overlapping']:.0%}",
                label,
                f"{rate['median']:.3g}",
                "" if error is None else f"{error:.1e}",
                "" if seconds is None else f"{seconds:.1f}",
            ]
            lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        "Ratios of rates taken within a round: above 1 the first is faster. Targets: as given; value and gradient at least",
        f"{GRADIENT_SHARE:g} of the value's rate, compilation at most {COMPILE_LIMIT:g} CPU-s.",
        "",
        "| case | ratio | measured | target | |",
        "|---|---|---|---|---|",
    ]
    for name, case in cases.items():
        for label, ratio in case["ratios"].items():
            first, second = label.split(" / ")
            target = TARGETS.get((name, first, second), GRADIENT_SHARE if second == VALUE else None)
            verdict = "" if target is None else "met" if ratio >= target else "missed"
            lines.append(f"| {name} | {label} | {ratio:.3g} | {'' if target is None else f'{target:g}'} | {verdict} |")
    absent = {peer: why for case in cases.values() for peer, why in case["missing"].items()}
    lines += [f"\n{peer}: {why}." for peer, why in absent.items()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
