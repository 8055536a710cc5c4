"""Measurements in processes of their own: a fresh compiler, and a limit on the time of a run that hangs."""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
import subprocess
import sys
import tempfile
from typing import Any

from tests.benchmarks.settings import Settings

ROOT = pathlib.Path(__file__).resolve().parents[2]


class MeasurementError(RuntimeError):
    """A measurement failed or ran past its limit."""


ONE_CORE = {"PJRT_NPROC": "1"}
"""XLA in one thread, as the other engines run: programs compiled for two are half as fast again per CPU-second."""


def launch(name: str, settings: Settings, arguments: dict[str, Any] | None = None, one_core: bool = True) -> dict:
    """Runs `tests.benchmarks.<name>.measure(settings, **arguments)` in a fresh process.

    Args:
      name, settings, arguments: what to measure.
      one_core: compile for one thread; otherwise for as many as there are cores, as JAX does by itself.

    Raises:
      MeasurementError: it failed, or took longer than `settings.timeout_seconds`.
    """
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "false"}
    environment = {key: value for key, value in environment.items() if key not in ONE_CORE}
    environment |= ONE_CORE if one_core else {}
    environment["JAX_TRACEBACK_FILTERING"] = "off"  # otherwise the last line of an error is not the error
    request = json.dumps({"name": name, "settings": dataclasses.asdict(settings), "arguments": arguments or {}})
    with tempfile.TemporaryDirectory() as folder:
        output = pathlib.Path(folder) / "result.json"
        command = [sys.executable, "-m", "tests.benchmarks.worker", request, str(output)]
        try:
            done = subprocess.run(
                command,
                cwd=ROOT,
                env=environment,
                timeout=settings.timeout_seconds,
                stderr=subprocess.PIPE,
                text=True,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise MeasurementError(f"{name}: no result within {settings.timeout_seconds:g} s") from None
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
            raise MeasurementError(f"{name}: {lines[-1]}")
        return json.loads(output.read_text())
