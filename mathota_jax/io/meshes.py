"""Shapes from mesh files: the convex hull, or a decomposition into convex parts (guide 12.1)."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from mathota_jax.geometry import Compound, Polyhedron
from mathota_jax.geometry.polyhedron import VERTEX_LIMIT
from mathota_jax.geometry.validation import positive_number

CACHE_FORMAT = 1
"""Part of the key of the cache: raised when its content changes its meaning."""

UNTURNED = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


def load_mesh(path: str | os.PathLike[str], scale: float = 1.0, vertex_limit: int = VERTEX_LIMIT) -> Polyhedron:
    """Convex hull of a mesh file (OBJ, STL and what else trimesh reads).

    Args:
      path: file.
      scale: metres for one unit of the file.
      vertex_limit: corners to keep at most, between 4 and 64; see `simplified_hull`.

    Returns:
      The hull in the frame of the file.

    Raises:
      ImportError: the extra `io` is not installed.
      FileNotFoundError: there is no such file.
      ValueError: the file holds no mesh, or one that is not closed.
    """
    scale = float(positive_number("load_mesh: scale", scale))
    vertices, _ = _closed_mesh(Path(path))
    return Polyhedron(scale * simplified_hull(vertices, vertex_limit))


def load_convex_parts(
    path: str | os.PathLike[str],
    scale: float = 1.0,
    *,
    threshold: float = 0.05,
    part_limit: int | None = None,
    vertex_limit: int = VERTEX_LIMIT,
    seed: int = 0,
    cache: bool | str | os.PathLike[str] = True,
) -> Compound:
    """Approximates a mesh by convex parts on one body.

    Source: X. Wei et al., "Approximate Convex Decomposition for 3D Meshes with Collision-Aware Concavity and Tree Search",
    SIGGRAPH 2022 (coacd). Mass properties are those of the parts.

    Args:
      path: mesh file.
      scale: metres for one unit of the file.
      threshold: concavity to tolerate, from 0.01 (many parts) to 1 (few), as a share of the size.
      part_limit: number of parts at most; None for no limit.
      vertex_limit: corners of a part at most, between 4 and 64.
      seed: of the search.
      cache: whether to keep the parts in a file beside the mesh, or a folder for that file. Its name holds a hash of the
        content of the mesh and of all settings, so that a change of either is never missed.

    Returns:
      The parts in the frame of the file.

    Raises:
      ImportError: the extra `io` is not installed.
      FileNotFoundError: there is no such file.
      ValueError: a setting is out of range; the file holds no mesh, or one that is not closed.
    """
    scale = float(positive_number("load_convex_parts: scale", scale))
    if not 0.01 <= threshold <= 1.0:
        raise ValueError(f"load_convex_parts: threshold must lie between 0.01 and 1, got {threshold!r}")
    if part_limit is not None and (not isinstance(part_limit, int) or part_limit < 1):
        raise ValueError(f"load_convex_parts: part_limit must be None or at least 1, got {part_limit!r}")
    _check_vertex_limit(vertex_limit)
    path = Path(path)
    settings = {"threshold": threshold, "part_limit": part_limit, "vertex_limit": vertex_limit, "seed": seed}
    stored = _cache_file(path, settings, cache)
    parts = None if stored is None else _read_parts(stored)
    if parts is None:
        parts = _decomposed(path, settings)
        if stored is not None:
            _write_parts(stored, parts)
    return Compound([(Polyhedron(scale * points), UNTURNED) for points in parts])


def simplified_hull(points: Any, vertex_limit: int = VERTEX_LIMIT) -> np.ndarray:
    """Corners of a convex hull, thinned out where they are too many. Needs no extra.

    From the extreme points along the principal directions, the point that lies farthest outside what is there is added
    until there are enough. The result is a subset of the points, so it never exceeds the hull.

    Args:
      points: (point, 3) [m].
      vertex_limit: corners to keep at most, between 4 and 64.

    Returns:
      (corner, 3) points for `Polyhedron`; all corners if they are few enough.

    Raises:
      ValueError: the limit is out of range, or the points have no hull with a volume.
    """
    _check_vertex_limit(vertex_limit)
    points = np.asarray(points, np.float64)
    scaled = points - points.mean(0)
    scaled /= max(np.abs(scaled).max(), np.finfo(float).tiny)
    try:
        corners = ConvexHull(scaled).vertices
    except (ValueError, RuntimeError):  # Polyhedron says what is wrong
        return points
    if len(corners) <= vertex_limit:
        return points[corners]
    scaled = scaled[corners]
    chosen = _tetrahedron(scaled)
    while len(chosen) < vertex_limit:
        planes = ConvexHull(scaled[chosen]).equations
        outside = (scaled @ planes[:, :3].T + planes[:, 3]).max(1)
        chosen.append(int(outside.argmax()))
    return points[corners[chosen]]


def _tetrahedron(points: np.ndarray) -> list[int]:
    """Four points that span a large volume: far ends along one direction, then off their line, then off their plane."""
    first = int(np.linalg.norm(points - points.mean(0), axis=1).argmax())
    second = int(np.linalg.norm(points - points[first], axis=1).argmax())
    along = points[second] - points[first]
    area = np.cross(points - points[first], along)
    third = int(np.linalg.norm(area, axis=1).argmax())
    fourth = int(np.abs((points - points[first]) @ area[third]).argmax())
    return [first, second, third, fourth]


def _check_vertex_limit(vertex_limit: int) -> None:
    if not isinstance(vertex_limit, int) or not 4 <= vertex_limit <= VERTEX_LIMIT:
        raise ValueError(f"vertex_limit must be a whole number from 4 to {VERTEX_LIMIT}, got {vertex_limit!r}")


def _require(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ImportError(f'reading meshes needs {module}: pip install "mathota-jax[io]"') from error


def _closed_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (vertex, 3) and triangles (triangle, 3) of a file that holds a closed surface."""
    trimesh = _require("trimesh")
    if not path.is_file():
        raise FileNotFoundError(f"mesh file '{path}' does not exist")
    try:
        mesh = trimesh.load_mesh(path, process=False)
        finite = bool(np.all(np.isfinite(mesh.vertices)))
        mesh.process()  # merges the corners of an STL; it also drops vertices that are not finite, without a word
        vertices, triangles = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    except Exception as error:  # its parsers raise whatever they come across
        raise ValueError(f"mesh file '{path}' can not be read: {error}") from error
    if not finite:
        raise ValueError(f"mesh file '{path}' holds vertices that are not finite")
    if not len(triangles):
        raise ValueError(f"mesh file '{path}' is empty: it holds no triangle")
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    count = np.unique(edges, axis=0, return_counts=True)[1]
    if np.any(count != 2):
        raise ValueError(
            f"mesh file '{path}' is not a closed (manifold) surface: {np.sum(count != 2)} of {len(count)} edges do not "
            "belong to exactly two triangles; close it in a mesh editor or with trimesh.repair, or pass its points to "
            "Polyhedron for their convex hull"
        )
    return vertices, triangles


def _decomposed(path: Path, settings: dict[str, Any]) -> list[np.ndarray]:
    vertices, triangles = _closed_mesh(path)
    coacd = _require("coacd")
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(vertices, triangles),
        threshold=settings["threshold"],
        max_convex_hull=settings["part_limit"] or -1,
        seed=settings["seed"],
    )
    return [simplified_hull(points, settings["vertex_limit"]) for points, _ in parts]


def _cache_file(path: Path, settings: dict[str, Any], cache: bool | str | os.PathLike[str]) -> Path | None:
    if cache is False:
        return None
    if not path.is_file():
        raise FileNotFoundError(f"mesh file '{path}' does not exist")
    key = hashlib.sha256(json.dumps([CACHE_FORMAT, settings], sort_keys=True).encode())
    key.update(path.read_bytes())
    folder = path.parent if cache is True else Path(cache)
    return folder / f"{path.stem}.{key.hexdigest()[:16]}.parts.npz"


def _read_parts(path: Path) -> list[np.ndarray] | None:
    """Parts from the cache; None if there are none or the file is damaged."""
    try:
        with np.load(path) as file:
            return [file[f"arr_{index}"] for index in range(len(file.files))] or None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _write_parts(path: Path, parts: list[np.ndarray]) -> None:
    """Whole or not at all: another process may be reading."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, suffix=".npz")
    except OSError as error:
        raise OSError(f"can not keep convex parts in '{path.parent}': {error}; pass cache=False or a folder") from error
    with os.fdopen(handle, "wb") as file:
        np.savez_compressed(file, *parts)
    os.replace(name, path)
