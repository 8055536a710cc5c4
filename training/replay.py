"""Replay of a trajectory as one HTML file that needs nothing else: no network, no server, no plug-in.

The viewer is the plain JavaScript in ``training/assets``; this module joins its files, the style sheet and the data.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from mathota_envs.camera import DEFAULT_FIELD_OF_VIEW, view_basis, viewing_direction
from mathota_envs.scene_description import bounding_sphere, grid_cell, scene_description

ASSETS = Path(__file__).parent / "assets"
SCRIPTS = (
    "vectors.js",
    "meshes.js",
    "recording.js",
    "orbit_camera.js",
    "scene_items.js",
    "webgl_renderer.js",
    "canvas_renderer.js",
    "player.js",
    "main.js",
)
"""Files of the viewer in the order in which they are joined: each uses only names of earlier ones."""


def write_replay(
    path: str | Path, model: Any, trajectory: Any, dt: float, contacts: Any = None, title: str = ""
) -> None:
    """Writes a replay to watch in any browser, also straight from the disk.

    Args:
        path: File to write; missing folders are made.
        model: Scene: ``scene.shapes``, ``shapes`` and ``gravity``, which decides what is up.
        trajectory: Object with ``position (T, body, 3)`` [m] and ``orientation (T, body, 4)`` (w, x, y, z). A body
            that is not finite is hidden in those frames.
        dt: Time between two frames [s].
        contacts: Contact slots by frame, as an object or a mapping, or None: ``position (T, slot, 3)`` [m] and
            ``normal (T, slot, 3)``; optionally ``active (T, slot)`` (default: all), ``force`` [N], either the
            magnitude along the normal ``(T, slot)`` or the vector ``(T, slot, 3)``, and ``separation (T, slot)`` [m].
            Active slots are shown that carry a force or are closer than 1 % of the smallest shape's bounding radius.
        title: Heading of the page.

    Raises:
        ValueError: An array has the wrong shape, dt is not positive or a shape cannot be drawn.
    """
    data = replay_data(model, trajectory, dt, contacts, title)
    # Inside a script element only "<" could end it early; JSON allows the escape in every string.
    embedded = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    scripts = "\n".join((ASSETS / name).read_text(encoding="utf-8") for name in SCRIPTS)
    parts = {
        "title": escape(title or "Replay"),
        "style": (ASSETS / "replay.css").read_text(encoding="utf-8"),
        "data": embedded,
        "script": f'"use strict";\n(() => {{\n{scripts}\n}})();',
    }
    page = (ASSETS / "replay.html").read_text(encoding="utf-8")
    # One pass from the template's own pieces, so that text inserted earlier (a title) is never searched for marks.
    pieces = page.split("@@")
    filled = [parts[piece] if order % 2 else piece for order, piece in enumerate(pieces)]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(filled), encoding="utf-8")


def replay_data(model: Any, trajectory: Any, dt: float, contacts: Any = None, title: str = "") -> dict[str, Any]:
    """Content of a replay as JSON values; arrays as base64 of little-endian float32 (counts: uint32), row-major.

    Arguments and errors are those of `write_replay`.
    """
    description = scene_description(model)
    position = np.asarray(trajectory.position, dtype=np.float32)
    if position.ndim != 3 or position.shape[-1] != 3 or position.shape[0] < 1:
        raise ValueError(f"trajectory.position must have shape (T, body, 3) with T >= 1, got {position.shape}")
    orientation = np.asarray(trajectory.orientation, dtype=np.float32)
    if orientation.shape != (*position.shape[:2], 4):
        raise ValueError(
            f"trajectory.orientation must have shape {(*position.shape[:2], 4)} to match trajectory.position, "
            f"got {orientation.shape}"
        )
    missing = [shape["body"] for shape in description if shape["body"] >= position.shape[1]]
    if missing:
        raise ValueError(f"trajectory has {position.shape[1]} bodies, but the model has a shape on body {missing[0]}")
    if not (np.ndim(dt) == 0 and math.isfinite(dt) and dt > 0):
        raise ValueError(f"dt must be a positive number of seconds, got {dt!r}")
    centre, radius = bounding_sphere(description, position)
    right, up, front = view_basis(model)
    distance = radius / math.sin(0.5 * DEFAULT_FIELD_OF_VIEW)
    touching = 0.01 * min((shape["bounding_radius"] for shape in description), default=math.inf)
    return {
        "title": title,
        "dt": float(dt),
        "frameCount": position.shape[0],
        "bodyCount": position.shape[1],
        "basis": [right.tolist(), up.tolist(), front.tolist()],
        "view": {
            "target": np.asarray(centre).tolist(),
            "radius": radius,
            "distance": distance,
            "direction": viewing_direction(model, centre, distance).tolist(),
            "fieldOfView": DEFAULT_FIELD_OF_VIEW,
        },
        "gridCell": float(grid_cell([shape["bounding_radius"] for shape in description])),
        "shapes": [_json_shape(shape) for shape in description],
        "position": _encoded(position),
        "orientation": _encoded(orientation),
        "contacts": None if contacts is None else _contact_data(contacts, position.shape[0], touching),
    }


def _json_shape(shape: dict[str, Any]) -> dict[str, Any]:
    names = {
        "bounding_radius": "boundingRadius",
        "half_extents": "halfExtents",
        "half_height": "halfHeight",
        "cell_size": "cellSize",
        "local_position": "localPosition",
        "local_orientation": "localOrientation",
    }
    named = {names.get(name, name): value for name, value in shape.items()}
    # JSON has no infinity; the viewer needs the radius of bounded shapes only.
    return {name: value for name, value in named.items() if value != math.inf}


def _contact_data(contacts: Any, frame_count: int, touching: float) -> dict[str, str]:
    """Shown contacts only, frame after frame: how many a frame has, and flat lists of points, normals and forces.

    An engine also lists pairs about to touch; those that are further apart than `touching` [m] are left out.
    """
    position = np.asarray(_field(contacts, "position"), dtype=np.float32)
    if position.ndim != 3 or position.shape[0] != frame_count or position.shape[2] != 3:
        raise ValueError(f"contacts.position must have shape ({frame_count}, slot, 3), got {position.shape}")
    slots = position.shape[:2]
    normal = np.asarray(_field(contacts, "normal"), dtype=np.float32)
    if normal.shape != (*slots, 3):
        raise ValueError(f"contacts.normal must have shape {(*slots, 3)}, got {normal.shape}")
    active = np.asarray(_field(contacts, "active", np.ones(slots)), dtype=bool)
    if active.shape != slots:
        raise ValueError(f"contacts.active must have shape {slots}, got {active.shape}")
    force = np.asarray(_field(contacts, "force", np.zeros(slots)), dtype=np.float32)
    if force.shape == slots:
        force = force[..., None] * normal
    if force.shape != (*slots, 3):
        raise ValueError(f"contacts.force must have shape {slots} or {(*slots, 3)}, got {force.shape}")
    separation = np.asarray(_field(contacts, "separation", np.zeros(slots)))
    if separation.shape != slots:
        raise ValueError(f"contacts.separation must have shape {slots}, got {separation.shape}")
    met = (separation <= touching) | (force != 0).any(-1)
    finite = np.isfinite(position).all(-1) & np.isfinite(normal).all(-1) & np.isfinite(force).all(-1)
    shown = active & met & finite
    return {
        "count": _encoded(shown.sum(axis=1), "<u4"),
        "position": _encoded(position[shown]),
        "normal": _encoded(normal[shown]),
        "force": _encoded(force[shown]),
    }


_REQUIRED = object()


def _field(contacts: Any, name: str, default: Any = _REQUIRED) -> Any:
    found = contacts.get(name) if isinstance(contacts, Mapping) else getattr(contacts, name, None)
    if found is not None:
        return found
    if default is _REQUIRED:
        raise ValueError(f"contacts has no {name!r}: give an object or a mapping with 'position' and 'normal'")
    return default


def _encoded(array: np.ndarray, dtype: str = "<f4") -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype=dtype).tobytes()).decode("ascii")
