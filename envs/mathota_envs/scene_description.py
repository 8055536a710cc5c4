"""What there is to draw: the shapes of a model as plain NumPy data, with their colours and extents."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.geometry import SHAPES
from mathota_jax.geometry.bounds import bounding_radius
from mathota_jax.spatial.vector import Vec3

PALETTE = (
    (0.25, 0.53, 0.80),
    (0.93, 0.53, 0.22),
    (0.31, 0.66, 0.41),
    (0.82, 0.33, 0.31),
    (0.57, 0.44, 0.77),
    (0.87, 0.69, 0.24),
    (0.30, 0.71, 0.75),
    (0.80, 0.45, 0.66),
)
"""Colours (sRGB, 0 to 1) of the bodies, in the order in which they first own a bounded shape."""

GROUND, GROUND_COLOUR = ("plane", "heightfield"), (0.62, 0.64, 0.67)
"""Kinds that are ground to the others, drawn in squares."""


def by_component(size: dict[str, Any]) -> dict[str, Any]:
    """Sizes, NumPy or JAX, whose vectors (last axis) are each a `Vec3`."""
    vectors = ("half_extents", "normal", "vertices")
    return {name: Vec3(*(v[..., k] for k in range(3))) if name in vectors else v for name, v in size.items()}


def body_colours(shapes: Iterable[Any]) -> dict[int, tuple[float, float, float]]:
    """Colour of every body that owns a bounded shape, from the entries of ``model.scene.shapes``."""
    bodies = dict.fromkeys(shape.body for shape in shapes if shape.kind not in GROUND)
    return {body: PALETTE[order % len(PALETTE)] for order, body in enumerate(bodies)}


def scene_description(model: Any) -> list[dict[str, Any]]:
    """Lists the shapes of a model in drawing order.

    Args:
        model: Anything with ``scene.shapes`` (entries with ``kind``, ``body``, ``index``) and ``shapes`` (arrays of
            sizes by kind). The arrays must be concrete.

    Returns:
        One dictionary a shape: ``kind``, ``body``, ``colour`` (sRGB, 0 to 1), ``bounding_radius`` [m] about the
        centre of mass of the body (infinite for a plane) and the sizes of its kind [m], such as ``radius`` or
        ``half_extents``, as floats or lists of floats; also ``local_position`` [m] and ``local_orientation``
        (quaternion) of the shape in the body where a compound has them, and ``triangles`` (vertex indices, seen
        counter-clockwise from outside) of a polyhedron.

    Raises:
        ValueError: A shape is of a kind that cannot be drawn.
    """
    colours = body_colours(model.scene.shapes)
    description = []
    for shape in model.scene.shapes:
        if shape.kind not in SHAPES:
            raise ValueError(
                f"shape kind {shape.kind!r} of body {shape.body} cannot be drawn: "
                f"known kinds are {', '.join(sorted(SHAPES))}"
            )
        sizes = model.shapes[shape.kind]
        size = {name: np.asarray(values, dtype=float)[shape.index] for name, values in sizes.items()}
        offset = math.hypot(*size.get("local_position", (0.0,)))
        radius = offset + float(bounding_radius(shape.kind, size))
        size = {name: values.tolist() for name, values in size.items()}
        if shape.kind == "polyhedron":
            size["triangles"] = [fan for face in model.scene.faces[shape.index] for fan in _fan(face)]
        description.append(
            {
                "kind": shape.kind,
                "body": int(shape.body),
                "colour": GROUND_COLOUR if shape.kind in GROUND else colours[shape.body],
                "bounding_radius": radius,
                **size,
            }
        )
    return description


def _fan(face: tuple[int, ...]) -> list[list[int]]:
    """Triangles of a convex polygon."""
    return [[int(face[0]), int(a), int(b)] for a, b in itertools.pairwise(face[1:])]


def foreground(description: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Shapes that a view should frame: the bounded ones, less those far larger than the rest (a floor as a box)."""
    bounded = [shape for shape in description if math.isfinite(shape["bounding_radius"])]
    if not bounded:
        return []
    radii = sorted(shape["bounding_radius"] for shape in bounded)
    typical = radii[(len(radii) - 1) // 2]
    return [shape for shape in bounded if shape["bounding_radius"] <= 8.0 * typical]


def bounding_sphere(description: list[dict[str, Any]], position: np.ndarray) -> tuple[np.ndarray, float]:
    """Ball that holds the foreground of a scene over one or more frames.

    Args:
        description: From `scene_description`.
        position: Body positions [m], ``(..., body, 3)``; frames with non-finite entries are ignored.

    Returns:
        Centre ``(3,)`` and radius [m]. A scene of planes only gets the unit ball at the foot of its first plane. Of
        many frames the outermost 2 % are ignored, so one body that flies off does not shrink all others to a dot.
    """
    position = np.asarray(position, dtype=float)
    frames = position.reshape(-1, *position.shape[-2:])
    tracks = []
    for shape in foreground(description):
        track = frames[:, shape["body"]]
        track = track[np.isfinite(track).all(axis=-1)]
        if len(track):
            tracks.append((track, shape["bounding_radius"]))
    if not tracks:
        planes = [shape for shape in description if shape["kind"] == "plane"]
        foot = np.asarray(planes[0]["normal"]) * planes[0]["offset"] if planes else np.zeros(3)
        return foot, 1.0
    lowest = np.min([np.quantile(track, 0.02, axis=0, method="higher") - radius for track, radius in tracks], axis=0)
    highest = np.max([np.quantile(track, 0.98, axis=0, method="lower") + radius for track, radius in tracks], axis=0)
    centre = 0.5 * (lowest + highest)
    reach = [
        np.quantile(np.linalg.norm(track - centre, axis=-1), 0.98, method="lower") + radius for track, radius in tracks
    ]
    return centre, float(max(reach))


def grid_cell(bounding_radius: Any) -> Array:
    """Edge [m] of the ground's squares: the power of two nearest to twice the diameter of the smallest shape.

    Args:
        bounding_radius: Radii [m] of the shapes of a scene, ``(shape,)``; infinite ones (planes) do not count.
    """
    smallest = jnp.min(jnp.asarray(bounding_radius), initial=jnp.inf)
    smallest = jnp.where(jnp.isfinite(smallest), smallest, 0.25)
    return 2.0 ** jnp.round(jnp.log2(4.0 * smallest))
