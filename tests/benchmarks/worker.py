"""Entry of a measuring process; see `process.launch`."""

from __future__ import annotations

import importlib
import json
import pathlib
import sys

from tests.benchmarks.settings import Settings


def main(request: str, output: str) -> None:
    """Runs the measurement that `request` (JSON) names and writes its result to `output`."""
    asked = json.loads(request)
    settings = Settings(**{name: tuple(v) if isinstance(v, list) else v for name, v in asked["settings"].items()})
    measurement = importlib.import_module(f"tests.benchmarks.{asked['name']}")
    result = measurement.measure(settings, **asked["arguments"])
    pathlib.Path(output).write_text(json.dumps(result))


if __name__ == "__main__":
    main(*sys.argv[1:])
