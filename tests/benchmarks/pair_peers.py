"""Narrow phases of other engines on the poses of `pair_speed`: Coal (C++, float64) and MJX (JAX, float32)."""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from tests.benchmarks.timing import Block

try:
    import coal  # pyright: ignore[reportMissingImports]
except ImportError:
    coal = None
try:
    from mujoco.mjx._src import collision_convex, collision_types, mesh  # pyright: ignore[reportMissingImports]
except ImportError:
    mesh = None

UPRIGHT = Rotation.from_rotvec([-np.pi / 2, 0, 0])
"""Axes of round shapes: along z in Coal, along y here."""


def missing() -> dict[str, str]:
    """Peers that can not take part, and why."""
    found = {"Coal": coal, "MJX": mesh}
    return {name: "not installed" for name, module in found.items() if module is None}


class Coal:
    """Signed distances of all pairs of a scene of `convex_oracle`, one call each from a Python loop."""

    def __init__(self, pair: tuple[str, str], scene: dict[str, Any]) -> None:
        assert coal is not None
        self.shapes = [_coal_shape(kind, scene[side]) for kind, side in zip(pair, "ab", strict=True)]
        self.places = [_coal_places(kind, scene, side) for kind, side in zip(pair, "ab", strict=True)]
        self.request, self.result = coal.DistanceRequest(), coal.DistanceResult()

    def distance(self, place_a: Any, place_b: Any) -> float:
        """Signed distance [m]; the result holds normal and nearest points too."""
        self.result.clear()
        return coal.distance(self.shapes[0], place_a, self.shapes[1], place_b, self.request, self.result)  # pyright: ignore[reportOptionalMemberAccess]

    def block(self) -> int:
        """Tests every pair."""
        for places in zip(*self.places, strict=True):
            self.distance(*places)
        return len(self.places[0])

    def separations(self, count: int) -> np.ndarray:
        """Signed distances [m] of the first pairs."""
        return np.array([self.distance(*places) for places in itertools.islice(zip(*self.places, strict=True), count)])


def _coal_shape(kind: str, shape: dict[str, np.ndarray]) -> Any:
    assert coal is not None
    if kind == "sphere":
        return coal.Sphere(shape["radius"][0])
    if kind == "box":
        return coal.Box(*(2 * shape["half_extents"][0]))
    if kind == "polyhedron":
        points = coal.StdVec_Vec3s()
        for point in shape["vertices"][0]:
            points.append(point)
        return coal.ConvexBase.convexHull(points, True, "Qt")
    return {"capsule": coal.Capsule, "cylinder": coal.Cylinder}[kind](shape["radius"][0], 2 * shape["half_height"][0])


def _coal_places(kind: str, scene: dict[str, Any], side: str) -> list:
    assert coal is not None
    turns = Rotation.from_quat(scene["q" + side][:, [1, 2, 3, 0]])
    if kind in ("capsule", "cylinder"):
        turns = turns * UPRIGHT
    return [coal.Transform3s(r, p) for r, p in zip(turns.as_matrix(), scene["p" + side], strict=True)]


def mjx_boxes(scene: dict[str, Any]) -> tuple[Block, float]:
    """MJX's manifold of two boxes: a timed block, and the CPU seconds of its compilation."""
    import time

    infos = []
    for side in "ab":
        matrices = Rotation.from_quat(scene["q" + side][:, [1, 2, 3, 0]]).as_matrix()
        arrays = (scene["p" + side], matrices, scene[side]["half_extents"])
        infos.append(mesh.box(collision_types.GeomInfo(*(jnp.asarray(x, jnp.float32) for x in arrays))))  # pyright: ignore[reportOptionalMemberAccess, reportPossiblyUnbound]
    axes = [jax.tree.map(lambda _: None, info).replace(pos=0, mat=0, size=0, face=0, vert=0) for info in infos]
    started = time.process_time()
    manifold = jax.jit(jax.vmap(collision_convex._box_box, in_axes=axes)).lower(*infos).compile()  # pyright: ignore[reportPossiblyUnbound]
    seconds = time.process_time() - started

    def block() -> int:
        jax.block_until_ready(manifold(*infos))
        return len(scene["pa"])

    return block, seconds
