"""Signed distances of every pair in many random poses, separated to deep, against all directions that can separate.

    python -m tests.benchmarks.pose_classes [poses per pair] [--pairs box_polyhedron,...]

Writes ``results/pose_classes.json`` and ``.md``; what earlier runs found for other pairs is kept.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from mathota_jax import Box, Capsule, Cone, Cylinder, Geometry, Plane, Polyhedron, Sphere, manifold, signed_distance
from mathota_jax.collision.pairs import PAIRS as METHODS
from mathota_jax.collision.pairs import SEARCHED
from tests.benchmarks.pair_report import run
from tests.benchmarks.pose_sweep import GATES, gate
from tests.convex_oracle import CORNER_FACES, CORNERS, KINDS, PAIRS, Placed, Result, oracle, random_scene, rounded
from tests.direction_oracle import direction_distance, extent, plane_distance, separation_along
from tests.polytope_oracle import polytope_distance, polytope_pairs
from tests.round_oracle import KINDS as ROUND
from tests.round_oracle import round_distance

CLASSES = {
    "separated": (1e-2, 1.0),
    "touching": (-1e-4, 1e-4),
    "shallow": (-1e-2, -1e-4),
    "deep": (0.0, 0.0),
    "resting": (-3e-4, 3e-4),
}
"""Separation [size], uniform between these; deep poses stay where they are drawn."""
TILT = (-6.0, -1.5)
"""Faces of resting poses are parallel but for an angle of which the decimal logarithm lies between these."""
DEEP_REACH = 0.5
"""Largest distance [m] of the centres of deep poses."""
DOUBTFUL = 0.1
"""Where answer and oracle are further apart than this share of the gate, cutting planes decide."""
PREFER_FACES = (("capsule", "box"), ("box", "box"))
"""Pairs whose manifold takes a face for an edge up to 5 % shallower, and a direction close to a face normal for it."""
BY_SUPPORT = "by support functions"
EVERY = [("plane", kind) for kind in KINDS] + PAIRS
SHAPES = {
    "plane": Plane((0.0, 1.0, 0.0)),
    "sphere": Sphere(1.0),
    "capsule": Capsule(1.0, 1.0),
    "box": Box((1.0, 1.0, 1.0)),
    "cylinder": Cylinder(1.0, 1.0),
    "cone": Cone(1.0, 1.0),
    "polyhedron": Polyhedron(CORNERS),
}
"""A shape of each kind, whose sizes are replaced by those of the poses (a plane has none)."""


class Answer(NamedTuple):
    """What the engine says of each pose, float64."""

    separation: np.ndarray
    normal: np.ndarray
    converged: np.ndarray


Way = Callable[[tuple[str, str], dict, str], Answer]
DISTANCE, MANIFOLD = jax.jit(jax.vmap(signed_distance)), jax.jit(jax.vmap(manifold))


def main(arguments: list[str] | None = None) -> None:
    """Runs the sweep and writes both files."""
    meaning = "poses of each pair in each precision"
    run("pose_classes", __doc__, (20000, meaning), EVERY, in_each_precision, table, arguments)


def in_each_precision(pair: tuple[str, str], count: int) -> list[dict]:
    """Rows of a pair: the same poses in both precisions."""
    scene, kinds, sizes = draw(pair, count)
    found = []
    for precision in ("float32", "float64"):
        with jax.enable_x64(precision == "float64"):
            found += measure(pair, scene, kinds, sizes, precision, ways(pair, precision))
            jax.clear_caches()
    return found


def ways(pair: tuple[str, str], precision: str) -> dict[str, Way]:
    """Every way in which the engine finds the distance of a pair."""
    found: dict[str, Way] = {METHODS[pair].method: registered}
    if METHODS[pair].method not in SEARCHED and pair in PAIRS:
        found[BY_SUPPORT] = searched
    if METHODS[pair].distance is not None and pair not in PREFER_FACES and precision == "float32":
        found["deepest contact point"] = deepest
    return found


def exact(pair: tuple[str, str], scene: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances [m] and normals: in closed form where there is one."""
    if pair[0] == "plane":
        return plane_distance(pair, scene)
    if set(pair) <= set(ROUND):
        return round_distance(pair, scene)
    return (polytope_distance if pair in polytope_pairs() else direction_distance)(pair, scene)


def draw(
    pair: tuple[str, str], count: int, classes: Sequence[str] = tuple(CLASSES)
) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Poses with the name of the class of each, in equal shares, and the extent [m] of the larger shape of each."""
    rng = np.random.default_rng(count)
    scene: dict[str, Any] = random_scene(pair, count)
    kinds = np.array(classes)[np.arange(count) % len(classes)]
    scene["pb"] = np.where(
        (kinds == "deep")[:, None], scene["pa"] + DEEP_REACH / 2 * (scene["pb"] - scene["pa"]), scene["pb"]
    )
    face_to_face(pair, scene, kinds == "resting", rng)
    extents = [extent(kind, scene[side]) for side, kind in zip("ab", pair, strict=True) if kind != "plane"]
    sizes = np.max(extents, axis=0)
    truths, normals = exact(pair, scene)
    limits = np.array([CLASSES[kind] for kind in kinds])
    gaps = rng.uniform(limits[:, 0], limits[:, 1]) * sizes
    shift = np.where(kinds == "deep", 0.0, gaps - truths)
    scene["pb"] = scene["pb"] + shift[:, None] * normals
    return scene, kinds, sizes


def face_to_face(pair: tuple[str, str], scene: dict[str, Any], chosen: np.ndarray, rng: np.random.Generator) -> None:
    """Turns and places B, in the chosen poses, so that a face, side or end of it lies on one of A, as in a heap."""
    turn_a, turn_b = (Rotation.from_quat(scene["q" + side][chosen][:, [1, 2, 3, 0]]) for side in "ab")
    shapes = [{name: value[chosen] for name, value in scene[side].items()} for side in "ab"]
    up, down = (
        turn.apply(outward(kind, shape, rng, len(turn)))
        for turn, kind, shape in zip((turn_a, turn_b), pair, shapes, strict=True)
    )
    # Half a turn about the line midway between two directions exchanges them.
    middle = up - down
    onto = Rotation.from_rotvec(np.pi * middle / np.linalg.norm(middle, axis=1, keepdims=True))
    tilt = Rotation.from_rotvec(_directions(rng, len(up)) * 10.0 ** rng.uniform(*TILT, (len(up), 1)))
    scene["qb"][chosen] = (tilt * onto * turn_b).as_quat()[:, [3, 0, 1, 2]]
    scene["pb"][chosen] = scene["pa"][chosen] + 2.0 * up + 0.5 * np.cross(up, _directions(rng, len(up)))


def outward(kind: str, shape: dict[str, np.ndarray], rng: np.random.Generator, count: int) -> np.ndarray:
    """Normal of a face or an end, or of a straight side, of each shape (count, 3) in its own frame."""
    if kind == "plane":
        return np.tile([0.0, 1.0, 0.0], (count, 1))
    if kind == "sphere":
        return _directions(rng, count)
    if kind == "box":
        return np.eye(3)[rng.integers(3, size=count)] * rng.choice([-1.0, 1.0], (count, 1))
    if kind == "polyhedron":
        faces = CORNER_FACES[rng.integers(len(CORNER_FACES), size=count)]
        first, second, third = (shape["vertices"][np.arange(count), faces[:, k]] for k in range(3))
        normal = np.cross(second - first, third - first)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)
    angle, zero = rng.uniform(0.0, 2.0 * np.pi, count), np.zeros(count)
    rise = shape["radius"] / np.hypot(shape["radius"], 2.0 * shape["half_height"]) if kind == "cone" else zero
    across = np.sqrt(1.0 - rise**2)
    side = np.stack([across * np.cos(angle), rise, across * np.sin(angle)], axis=1)
    sign = {"capsule": zero, "cone": zero - 1.0}.get(kind, rng.choice([-1.0, 1.0], count))
    end = np.stack([zero, sign, zero], axis=1)
    return np.where((rng.random(count) < 0.5)[:, None] & (sign != 0)[:, None], end, side)


def _directions(rng: np.random.Generator, count: int) -> np.ndarray:
    found = rng.normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def searched(pair: tuple[str, str], scene: dict, precision: str) -> Answer:
    """By support functions, also where there is a closed form."""
    found = Result(pair, scene, np.dtype(precision))
    return Answer(found.separation, found.normal, found.converged)


def registered(pair: tuple[str, str], scene: dict, precision: str) -> Answer:
    """As `signed_distance` answers."""
    found = DISTANCE(*arguments(pair, scene, precision))
    return Answer(*(np.asarray(x, float) for x in (found.separation, found.normal)), np.asarray(found.converged))


def deepest(pair: tuple[str, str], scene: dict, precision: str) -> Answer:
    """The deepest point of the manifold, with the flag of the distance."""
    found = MANIFOLD(*arguments(pair, scene, precision))
    separation = jnp.where(found.active, found.separation, jnp.inf).min(axis=1)
    converged = DISTANCE(*arguments(pair, scene, precision)).converged
    return Answer(*(np.asarray(x, float) for x in (separation, found.normal)), np.asarray(converged))


def arguments(pair: tuple[str, str], scene: dict, precision: str) -> tuple:
    """Geometries and poses as `signed_distance` takes them, one a row."""
    dtype = np.dtype(precision)
    geometries, poses = [], []
    for side, kind in zip("ab", pair, strict=True):
        geometry = Geometry.of(SHAPES[kind])
        same = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(scene["pa"]), *leaf.shape)), geometry.parameters)
        sizes = same if kind == "plane" else {n: jnp.asarray(v, dtype) for n, v in scene[side].items()}
        geometries.append(dataclasses.replace(geometry, parameters=sizes))
        poses.append(tuple(jnp.asarray(scene[what + side], dtype) for what in "pq"))
    return geometries[0], poses[0], geometries[1], poses[1]


def measure(
    pair: tuple[str, str],
    scene: dict,
    kinds: np.ndarray,
    sizes: np.ndarray,
    precision: str,
    answers: dict[str, Way] | None = None,
) -> list[dict]:
    """Worst errors and counts of each class in one precision, by each of the ways; by support functions if not given."""
    scene = rounded(scene, precision)
    truths, _ = exact(pair, scene)
    missed = np.zeros(len(truths), bool)
    rows = []
    for method, answer in ({BY_SUPPORT: searched} if answers is None else answers).items():
        result = answer(pair, scene, precision)
        rows += _compare(pair, scene, kinds, sizes, precision, truths, missed, method, result)
    return rows


def _compare(
    pair: tuple[str, str],
    scene: dict,
    kinds: np.ndarray,
    sizes: np.ndarray,
    precision: str,
    truths: np.ndarray,
    missed: np.ndarray,
    method: str,
    result: Answer,
) -> list[dict]:
    """Rows of one way. Where a direction or cutting planes do better than `truths`, these are replaced, `missed` set."""
    reach = separation_along(pair, scene, result.normal / np.linalg.norm(result.normal, axis=1, keepdims=True))
    limit = gate(pair, np.dtype(precision))

    def errors() -> np.ndarray:
        return np.abs([result.separation - truths, reach - truths]) / sizes

    if pair[0] != "plane":
        # No separation along any direction, the engine's included, is more than the signed distance.
        missed |= reach > truths + DOUBTFUL * limit * sizes
        np.maximum(truths, reach, out=truths)
        for index in np.flatnonzero(~(errors().max(0) <= DOUBTFUL * limit)):
            better = oracle(Placed(pair, scene, index), 1e-11)[0]
            missed[index] |= better > truths[index] + DOUBTFUL * limit * sizes[index]
            truths[index] = max(truths[index], better)
    separation, normal = errors()
    wrong = ~(np.maximum(separation, normal) <= limit)
    flips = ((result.separation < 0) != (truths < 0)) & (np.abs(truths) > limit * sizes)
    rows = []
    for kind in dict.fromkeys(kinds.tolist()):
        chosen = kinds == kind
        rows.append(
            {
                "pair": "_".join(pair),
                "method": method,
                "class": kind,
                "precision": precision,
                "poses": int(chosen.sum()),
                "flagged": int((~result.converged & chosen).sum()),
                "wrong": int((wrong & chosen).sum()),
                "wrong_unflagged": int((wrong & chosen & result.converged).sum()),
                "flips": int((flips & chosen).sum()),
                "separation": float(separation[chosen].max()),
                "normal": float(normal[chosen].max()),
                "oracle_missed": int((missed & chosen).sum()),
            }
        )
    return rows


def table(rows: list[dict]) -> str:
    """The report in Markdown."""
    lines = [
        "# Signed distances in many random poses",
        "",
        "Written by `python -m tests.benchmarks.pose_classes`: a fifth of the poses of each pair separated (0.01 to 1",
        "size), touching (within 1e-4), shallow (1e-4 to 0.01 deep), deep (centres within 0.5 m) and resting (a face, end",
        "or side parallel to one of the other but for 1e-6 to 0.03 rad, within 3e-4). Answers of `signed_distance`; where",
        "it has a closed form or its own axes also of the search by support functions; where the manifold is found apart",
        "from the distance, in float32 also its deepest point.",
        "Truth in float64: closed forms (planes, spheres, capsules), the best of all directions that can separate",
        "(polytopes), else a search of all directions. Where an answer is further from it than a tenth of the gate, cutting",
        "planes with a proof (NNLS, Qhull) decide; *oracle missed* counts where these, or the separation along the engine's",
        "normal (a lower bound, taken by the oracle), did better. Errors in units of the larger shape: of the separation,",
        "and of the normal (separation lost along it).",
        f"*Flagged*: `converged` is false. *Wrong*: either beyond {GATES['float32'][0]:g} (float32), "
        f"{GATES['float64'][0]:g} (float64),",
        f"{GATES['float64'][1]:g} (float64 with a cylinder or cone). *Flips*: wrong sign beyond that.",
    ]
    keys = ("poses", "flagged", "wrong", "wrong_unflagged", "flips", "oracle_missed")
    for precision in ("float32", "float64"):
        lines += ["", f"## {precision}", "", "| Pair | method | class | poses | flagged | wrong | wrong, not flagged |"]
        lines[-1] += " flips | oracle missed | separation | normal |"
        lines.append("|---|---|---|---|---|---|---|---|---|---|---|")
        chosen = [row for row in rows if row["precision"] == precision]
        for row in chosen:
            cells = [row["pair"], row["method"], row["class"], *(str(row[key]) for key in keys)]
            lines.append(f"| {' | '.join(cells)} | {row['separation']:.1e} | {row['normal']:.1e} |")
        totals = " | ".join(str(sum(row[key] for row in chosen)) for key in keys)
        worst = [f"{max(row[key] for row in chosen):.1e}" for key in ("separation", "normal")]
        lines.append(f"| all |  |  | {totals} | {' | '.join(worst)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
