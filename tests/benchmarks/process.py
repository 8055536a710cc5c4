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


def launch(name: str, settings: Settings, arguments: dict[str, Any] | None = None) -> dict:
    """Runs `tests.benchmarks.<name>.measure(settings, **arguments)` in a fresh process.

    Raises:
      MeasurementError: it failed, or took longer than `settings.timeout_seconds`.
    """
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "false"}
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
