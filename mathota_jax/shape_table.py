"""The shapes of all bodies by kind: compounds flattened, polyhedra padded, poses relative to the centres of mass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mathota_jax.collision.height_grid import window_size
from mathota_jax.declarations import UNTURNED, Body
from mathota_jax.geometry import SHAPES, Compound, Heightfield, Plane, Polyhedron, Sphere
from mathota_jax.geometry.compound import Part
from mathota_jax.geometry.hull import Faces
from mathota_jax.rotation import rotate
from mathota_jax.scene import ShapeEntry


class ShapeTable(NamedTuple):
    """Shapes in order of adding.

    Attributes:
      entries: kind, body and row of each shape.
      parameters: kind -> parameter -> array with a leading axis over the shapes of that kind.
      faces: of each polyhedron.
    """

    entries: tuple[ShapeEntry, ...]
    parameters: dict[str, dict[str, np.ndarray]]
    faces: tuple[Faces, ...]


def shape_table(bodies: Sequence[Body]) -> ShapeTable:
    """Collects the shapes of all bodies.

    Raises:
      ValueError: heightfields of different grids.
    """
    entries: list[ShapeEntry] = []
    rows: dict[str, list[dict[str, np.ndarray]]] = {}
    faces: list[Faces] = []
    for index, body in enumerate(bodies):
        for part in _parts(body):
            of_kind = rows.setdefault(part.shape.kind, [])
            entries.append(ShapeEntry(part.shape.kind, index, len(of_kind)))
            of_kind.append(_row(body, part))
            if isinstance(part.shape, Polyhedron):
                faces.append(part.shape.faces)
    _check_grids(bodies)
    return ShapeTable(tuple(entries), {kind: _stacked(of_kind) for kind, of_kind in rows.items()}, tuple(faces))


def _parts(body: Body) -> tuple[Part, ...]:
    if isinstance(body.shape, Compound):
        return body.shape.parts
    return (Part(body.shape, np.zeros(3), UNTURNED),)


def _row(body: Body, part: Part) -> dict[str, np.ndarray]:
    """Parameters of one shape, its place in the body folded in where that costs nothing later."""
    values, offset = part.shape.parameters(), part.position - body.center
    if isinstance(part.shape, Plane):
        # Planes are static: their pose is folded in here, and collisions see world coordinates only.
        normal = rotate(body.orientation, values["normal"])
        return {"normal": normal, "offset": values["offset"] + normal @ body.position}
    if isinstance(part.shape, Polyhedron):
        return {"vertices": values["vertices"] @ part.rotation.T + offset}
    turn = UNTURNED if isinstance(part.shape, Sphere) else part.orientation
    return {**values, "local_position": offset, "local_orientation": turn}


def _stacked(rows: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    if "vertices" in rows[0]:
        count = max(len(row["vertices"]) for row in rows)
        rows = [{"vertices": _padded(row["vertices"], count)} for row in rows]
    stacked = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    # A pose that no shape of the kind needs is not in the model.
    if not np.any(stacked.get("local_position", 0.0)):
        stacked.pop("local_position", None)
    if np.all(np.abs(stacked.get("local_orientation", UNTURNED)) == UNTURNED):
        stacked.pop("local_orientation", None)
    return stacked


def _padded(vertices: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([vertices, np.repeat(vertices[:1], count - len(vertices), axis=0)])


def heightfield_window(table: ShapeTable, pairs: Sequence[tuple[ShapeEntry, ShapeEntry]]) -> int:
    """Cells along each side of the window that suits every pair of a shape with a heightfield."""
    cell_sizes = table.parameters["heightfield"]["cell_size"]

    def size(entry: ShapeEntry, field: ShapeEntry) -> int:
        row = {name: value[entry.index] for name, value in table.parameters[entry.kind].items()}
        return window_size(float(SHAPES[entry.kind].reach_of(row)), float(cell_sizes[field.index]))

    return max(size(entry, field) for entry, field in pairs)


def _check_grids(bodies: Sequence[Body]) -> None:
    fields = [body for body in bodies if isinstance(body.shape, Heightfield)]
    for body in fields[1:]:
        first, other = (b.shape.heights.shape for b in (fields[0], body))  # type: ignore[union-attr]
        if first != other:
            raise ValueError(
                f"build: heightfields of one scene must have grids of the same shape, but '{fields[0].name}' has {first} "
                f"and '{body.name}' has {other}; resample one, or split the larger into bodies of the smaller shape"
            )
