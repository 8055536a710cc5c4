"""Poses of convex pairs, their exact distances, and the errors of the engine's answers."""

from __future__ import annotations

import dataclasses

import numpy as np

from tests.convex_oracle import FLAT, ROUND, Placed, Result, distance_to, oracle, random_scene, rounded

GATES = {"float32": (2e-5, 2e-5), "float64": (1e-9, 1e-6)}
"""Largest error [size] of the separation of polytopes (and round shapes), and of pairs with a cylinder or cone."""
GAPS = (1e-2, 1e-4, 1e-5, -1e-5, -1e-4, -1e-2)
FORMS = {
    "any": ("", ""),
    "needle, plate": ("needle", "plate"),
    "plates": ("plate", "plate"),
    "needles": ("needle", "needle"),
    "1:1000": ("small", ""),
    "1000:1": ("", "small"),
}
REACH = {"any": 2.0}
"""Largest distance [m] of the centres; 1 m where no other is given."""


@dataclasses.dataclass
class Sweep:
    """Poses of one kind with their exact separations, as the engine sees them in one precision."""

    scene: dict
    truths: np.ndarray
    sizes: np.ndarray


def gate(pair: tuple[str, str], dtype: np.dtype) -> float:
    """Largest allowed error of the separation, in units of the size of the larger shape."""
    polytopes, curved = GATES[np.dtype(dtype).name]
    return polytopes if set(pair) <= {*FLAT, *ROUND} else curved


def kinds_of_pose() -> list[str]:
    """Every kind of pose of the sweep."""
    kinds = []
    for form in FORMS:
        kinds += [f"{form}: random", f"{form}: centres 1e-6 apart"]
        kinds += [f"{form}: gap {gap:+g}" for gap in GAPS]
    return kinds


def sweep(pair: tuple[str, str], kind: str, count: int, dtype: np.dtype) -> Sweep:
    """Draws poses of one kind and finds their exact separations."""
    form, what = kind.split(": ")
    scene = random_scene(pair, count, FORMS[form], REACH.get(form, 1.0))
    if what.startswith("centres"):
        scene["pb"] = scene["pa"] + 1e-6 * (scene["pb"] - scene["pa"])
    if what.startswith("gap"):
        # Errors of the first answer do not matter: the separation after the shift is found anew.
        for index in range(count):
            placed = Placed(pair, scene, index)
            truth, normal = oracle(placed, 1e-8)
            scene["pb"][index] += (float(what.split()[1]) * placed.size() - truth) * normal
    scene = rounded(scene, dtype)
    placed = [Placed(pair, scene, index) for index in range(count)]
    return Sweep(scene, np.array([oracle(p)[0] for p in placed]), np.array([p.size() for p in placed]))


def measure(pair: tuple[str, str], poses: Sweep, dtype: np.dtype) -> dict[str, np.ndarray]:
    """Errors [size] of separation, normal (as the loss of separation along it) and witness points, one a pose."""
    result = Result(pair, poses.scene, dtype)
    placed = [Placed(pair, poses.scene, index) for index in range(len(poses.truths))]
    unit = result.normal / np.linalg.norm(result.normal, axis=1, keepdims=True)
    reach = np.array([p.reach(n) for p, n in zip(placed, unit, strict=True)])
    outside = [
        max(abs(distance_to(p, side, points[index])) for side, points in enumerate((result.point_a, result.point_b)))
        for index, p in enumerate(placed)
    ]
    return {
        "separation": np.abs(result.separation - poses.truths) / poses.sizes,
        "normal": np.abs(reach - poses.truths) / poses.sizes,
        "points": np.array(outside) / poses.sizes,
        "converged": result.converged,
    }
