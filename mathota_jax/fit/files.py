"""Trajectories in files: NPZ and CSV, in the layouts of the documentation of `load_npz` and `load_csv`."""

from __future__ import annotations

import csv
import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from mathota_jax.fit.trajectories import CHANNELS, Trajectories

COLUMNS = {
    "position": ("x", "y", "z"),
    "orientation": ("qw", "qx", "qy", "qz"),
    "velocity": ("vx", "vy", "vz"),
    "angular_velocity": ("wx", "wy", "wz"),
}
"""Columns of a CSV file for each channel."""

GRID_TOLERANCE = 0.01
"""How far a time may be from a whole number of frames, in frames."""

SPARSEST = 1000
"""Frames for each line of a CSV file; more come from two times that are nearly equal."""


def load(path: str | Path) -> Trajectories:
    """Reads trajectories from an NPZ or CSV file, by its ending.

    Raises:
        ValueError: another ending, or what `load_npz` and `load_csv` object to.
        FileNotFoundError: there is no such file.
    """
    readers = {".npz": load_npz, ".csv": load_csv}
    ending = Path(path).suffix.lower()
    if ending not in readers:
        raise ValueError(f"{path}: trajectories are read from {' and '.join(readers)} files, not from '{ending}'")
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    return readers[ending](path)


def load_npz(path: str | Path) -> Trajectories:
    """Reads an NPZ file (`numpy.savez`).

    Keys: `dt` () [s]; `bodies` (body,) names; `position` (trajectory, frame, body, 3); optionally `orientation` (..., 4),
    `velocity`, `angular_velocity` (..., 3) and `action` (trajectory, frame - 1, motor), as in `Trajectories`. The
    trajectory axis may be left out where there is one trajectory. Other keys are an error, so that a misspelt channel is
    not passed over.

    Raises:
        ValueError: the file is no NPZ archive, lacks a key or has one too many, or its arrays are not valid.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            content = {key: archive[key] for key in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        raise ValueError(f"{path}: not an NPZ file of plain arrays ({error})") from error
    needed, known = ("dt", "bodies", "position"), ("dt", "bodies", *CHANNELS, "action")
    for key in needed:
        if key not in content:
            raise ValueError(f"{path}: the key '{key}' is missing; needed: {', '.join(needed)}")
    for key in content:
        if key not in known:
            raise ValueError(f"{path}: unknown key '{key}'; known: {', '.join(known)}")
    bodies = tuple(str(name) for name in np.atleast_1d(content.pop("bodies")))
    dt = content.pop("dt")
    if content["position"].ndim == 3:
        content = {key: value[None] for key, value in content.items()}
    try:
        return Trajectories(bodies, dt, **content)  # type: ignore[arg-type]
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def save_npz(path: str | Path, trajectories: Trajectories) -> None:
    """Writes what `load_npz` reads."""
    content: dict[str, Any] = dict(trajectories.channels)
    if trajectories.action is not None:
        content["action"] = trajectories.action
    np.savez_compressed(path, dt=trajectories.dt, bodies=np.asarray(trajectories.bodies), **content)


def load_csv(path: str | Path) -> Trajectories:
    """Reads a CSV file with one line for each body and frame.

    Columns, in any order: `trajectory` (a whole number or name; may be left out for one trajectory), `time` [s], `body`
    (a name) and the channels ``x,y,z``, ``qw,qx,qy,qz``, ``vx,vy,vz``, ``wx,wy,wz``, of which those of a channel stand or
    fall together and the position is needed. Empty cells and missing lines are missing frames. The times of each trajectory
    lie on a grid of constant spacing that starts with its first line; the spacing is the smallest difference of times.

    Raises:
        ValueError: unknown or missing columns, a cell that is no number, times off the grid, a frame given twice, or
            arrays that are not valid; the message names the line.
    """
    channels, rows = _lines(path)
    times = [_number(path, line, "time", row["time"]) for line, row in rows]
    if not np.all(np.isfinite(times)):
        raise ValueError(f"{path}, line {rows[int(np.argmin(np.isfinite(times)))][0]}: the time is missing")
    names = [row.get("trajectory", "0").strip() for _, row in rows]
    bodies = tuple(dict.fromkeys(row["body"].strip() for _, row in rows))
    order = list(dict.fromkeys(names))
    begin = {name: min(t for t, n in zip(times, names, strict=True) if n == name) for name in order}
    dt = _spacing(path, times, names)
    frames = [(t - begin[name]) / dt for t, name in zip(times, names, strict=True)]
    for frame, (line, _) in zip(frames, rows, strict=True):
        if abs(frame - round(frame)) > GRID_TOLERANCE:
            raise ValueError(
                f"{path}, line {line}: the time is {frame * dt:g} s after the start of its trajectory, no whole number of "
                f"frames of {dt:g} s, which fit all times best; times must lie on a grid of constant spacing"
            )
    if max(frames) > SPARSEST * len(rows):
        raise ValueError(
            f"{path}: with frames of {dt:g} s, the smallest difference of times, there are {max(frames):.3g} frames for "
            f"{len(rows)} lines; times that are meant to be one must be equal"
        )
    shape = (len(order), round(max(frames)) + 1, len(bodies))
    arrays = {channel: np.full((*shape, CHANNELS[channel]), np.nan) for channel in channels}
    seen: dict[tuple[int, int, int], int] = {}
    for frame, name, (line, row) in zip(frames, names, rows, strict=True):
        place = (order.index(name), round(frame), bodies.index(row["body"].strip()))
        if place in seen:
            raise ValueError(f"{path}, line {line}: body '{row['body']}' has this frame in line {seen[place]} already")
        seen[place] = line
        for channel in channels:
            arrays[channel][place] = [_number(path, line, column, row[column]) for column in COLUMNS[channel]]
    try:
        return Trajectories(bodies, dt, **arrays)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _lines(path: str | Path) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Channels of a CSV file, and its lines: number and cells by column."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file in UTF-8 ({error})") from error
    reader = csv.DictReader(io.StringIO(text, newline=""))
    header = [name.strip() for name in reader.fieldnames or ()]
    channels = _channels(path, header)
    rows = []
    for cells in reader:
        if None in cells or None in cells.values():
            raise ValueError(f"{path}, line {reader.line_num}: expected {len(header)} cells")
        row = dict(zip(header, cells.values(), strict=True))
        if not row["body"].strip():
            raise ValueError(f"{path}, line {reader.line_num}: the name of the body is missing")
        rows.append((reader.line_num, row))
    if not rows:
        raise ValueError(f"{path}: there is no line below the header")
    return channels, rows


def _channels(path: str | Path, header: list[str]) -> list[str]:
    for column in ("time", "body"):
        if column not in header:
            raise ValueError(f"{path}: the column '{column}' is missing; found: {', '.join(header) or 'nothing'}")
    known = ("trajectory", "time", "body", *(column for columns in COLUMNS.values() for column in columns))
    for column in header:
        if column not in known or header.count(column) > 1:
            what = "unknown column" if column not in known else "repeated column"
            raise ValueError(f"{path}: {what} '{column}'; known: {', '.join(known)}")
    channels = []
    for channel, columns in COLUMNS.items():
        lacking = [column for column in columns if column not in header]
        if len(lacking) < len(columns) and lacking:
            raise ValueError(f"{path}: the column '{lacking[0]}' of the {channel} is missing")
        if not lacking:
            channels.append(channel)
    if "position" not in channels:
        raise ValueError(f"{path}: the columns x, y, z are missing")
    return channels


def _number(path: str | Path, line: int, column: str, cell: str) -> float:
    """A cell as a number; an empty one is NaN."""
    text = cell.strip()
    try:
        return float(text) if text else float("nan")
    except ValueError as error:
        raise ValueError(f"{path}, line {line}: '{text}' in column '{column}' is not a number") from error


def _spacing(path: str | Path, times: list[float], names: list[str]) -> float:
    """Time between two frames [s]: the smallest difference, made exact by all others, which are multiples of it."""
    differences = []
    for name in set(names):
        own = np.unique([t for t, n in zip(times, names, strict=True) if n == name])
        differences += list(np.diff(own))
    if not differences:
        raise ValueError(f"{path}: each trajectory needs at least 2 frames")
    counts = np.round(np.asarray(differences) / min(differences))
    return float(np.sum(differences) / np.sum(counts))
