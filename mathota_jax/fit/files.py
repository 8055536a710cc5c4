"""Trajectories in files: NPZ and CSV, in the layouts of the documentation of `load_npz` and `load_csv`."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Iterable
from decimal import Decimal
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
"""How far a time may be from a whole number of frames, in frames, beside what the decimals it is written with leave open."""

UNAMBIGUOUS = 0.3
"""Unit of the last decimal, in frames, up to which times may be rounded: to coarser ones several spacings would fit."""

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
        archive = np.load(path, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise ValueError("one array alone, as numpy.save writes it; use numpy.savez")
        with archive:
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
    bodies = np.atleast_1d(content.pop("bodies"))
    if bodies.dtype.kind not in "US":
        raise ValueError(f"{path}: bodies must be names, got {bodies.tolist()}")
    bodies = tuple(np.char.decode(bodies, "utf-8").tolist() if bodies.dtype.kind == "S" else bodies.tolist())
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
    lie on a grid of constant spacing that starts with its first line; the smallest difference of times is one frame. They
    may be rounded to the decimals they are written with as long as the frames can be counted, as milliseconds can up to
    300 frames a second; the spacing is the one that fits all of them best.

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
    dt, frames, off = _grid(path, times, names)
    if max(frames) > SPARSEST * len(rows):
        raise ValueError(
            f"{path}: with frames of {dt:g} s, the smallest difference of times, there are "
            f"{float(max(frames)):.3g} frames for {len(rows)} lines; times that are meant to be one must be equal"
        )
    # Each of two rounded times may be half a unit of the last place off the grid.
    rounding = _last_place(row["time"] for _, row in rows) / dt
    allowed = GRID_TOLERANCE + (rounding if rounding <= UNAMBIGUOUS else 0.0)
    for way, time, (line, _) in zip(off, times, rows, strict=True):
        if abs(way) > allowed:
            raise ValueError(
                f"{path}, line {line}: the time is {time:g} s, {abs(way):.2g} frames off the grid of frames of {dt:g} s "
                f"that fits all times best, more than {allowed:.2g}; times must lie on a grid of constant spacing"
            )
    shape = (len(order), max(frames) + 1, len(bodies))
    arrays = {channel: np.full((*shape, CHANNELS[channel]), np.nan) for channel in channels}
    seen: dict[tuple[int, int, int], int] = {}
    for frame, name, (line, row) in zip(frames, names, rows, strict=True):
        place = (order.index(name), frame, bodies.index(row["body"].strip()))
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


def _last_place(cells: Iterable[str]) -> float:
    """The unit of the last decimal with which numbers are written, of the most precise one: 0.001 of "0.5" and "0.533"."""
    return 10.0 ** min(int(Decimal(cell.strip()).as_tuple().exponent) for cell in cells)


def _grid(path: str | Path, times: list[float], names: list[str]) -> tuple[float, list[int], np.ndarray]:
    """The grid of constant spacing that fits all times best by least squares.

    Args:
        path: for messages.
        times: (line,) [s].
        names: (line,) of the trajectories, each with a grid of its own beginning.

    Returns:
        Time between two frames [s]; frame of each line; how far its time is from that frame, in frames.
    """
    trajectory = np.unique(names, return_inverse=True)[1]
    points, place = np.unique(np.stack([trajectory, times], 1), axis=0, return_inverse=True)
    place = place.ravel()
    time, steps, within = points[:, 1], np.diff(points[:, 1]), np.diff(points[:, 0]) == 0
    if not within.any():
        raise ValueError(f"{path}: each trajectory needs at least 2 frames")
    spans = np.ones(len(steps), int)
    known = within & (steps < 1.5 * steps[within].min())
    while True:
        dt, frame, off, duration = _spacing(time, spans, known)
        unknown = within & ~known
        if not unknown.any():
            return dt, frame[place].tolist(), off[place]
        # A gap is counted once the spacing is known from frames over as long a time.
        new = unknown & (steps <= max(duration, steps[unknown].min()))
        spans[new] = np.round(steps[new] / dt)
        known |= new


def _spacing(time: np.ndarray, spans: np.ndarray, known: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Least squares of one spacing and the beginnings of all chains of times.

    Args:
        time: (n,) [s], rising within a chain.
        spans: (n - 1,) frames between one time and the next.
        known: (n - 1,) whether they are known; where not, a chain ends.

    Returns:
        Spacing [s]; (n,) frame in the chain; (n,) how far each time is from that, in frames; duration of the longest [s].
    """
    chain = np.concatenate([[0], np.cumsum(~known)])
    first = np.flatnonzero(np.diff(chain, prepend=-1))
    frame = np.concatenate([[0], np.cumsum(spans)])
    frame = frame - frame[first][chain]
    since = time - time[first][chain]
    t, k = (values - (np.bincount(chain, values) / np.bincount(chain))[chain] for values in (since, frame))
    dt = float(t @ k / (k @ k))
    return dt, frame, t / dt - k, float(since.max())
