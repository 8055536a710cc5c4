"""Every figure that tests compare with a limit, as a report.

    python -m tests.benchmarks.gate_report [--tests tests/gradients] [--name gradient_gates]

Runs the tests, slow ones too, and writes ``results/NAME.md``: what each gate measured beside its limit. Gates that are not
met are those of `tests/shortfalls.py`.
"""

from __future__ import annotations

import argparse
import pathlib
import shlex
from typing import NamedTuple

import pytest

RESULTS = pathlib.Path(__file__).parent / "results"


class Gate(NamedTuple):
    """One comparison."""

    test: str
    name: str
    measured: float
    limit: float


class Recorder:
    """Plugin of pytest that keeps the gates of all tests."""

    def __init__(self) -> None:
        self.gates: list[Gate] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Called after each phase of each test."""
        if report.when != "call":
            return
        found = [value for key, value in report.user_properties if key == "gate"]
        self.gates += [Gate(report.nodeid, *gate) for gate in found]


def table(recorder: Recorder, tests: str) -> str:
    """The report in Markdown."""
    command = f"python -m tests.benchmarks.gate_report --tests {shlex.quote(tests)}"
    lines = [
        "# Gates",
        "",
        f"Written by `{command}`. Errors as the tests measure them,",
        "largest of all worlds, beside what they may be. A test ends at the first gate that it misses; why, says",
        "`tests/shortfalls.py`.",
    ]
    last = ""
    for gate in recorder.gates:
        path, test = gate.test.split("::", 1)
        if path != last:
            lines += ["", f"## {path}", "", "| test | figure | measured | gate | |", "|---|---|---|---|---|"]
            last = path
        met = "" if gate.measured <= gate.limit else "**not met**"
        name, test = gate.name.replace("|", "/"), test.removeprefix("test_")
        lines.append(f"| {test} | {name} | {gate.measured:.2g} | {gate.limit:.2g} | {met} |")
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> None:
    """Runs the tests and writes the report."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.gate_report", description=__doc__)
    parser.add_argument("--tests", default="tests/gradients", help="what pytest is asked to run")
    parser.add_argument("--name", default="gradient_gates", help="of the file")
    options = parser.parse_args(arguments)
    recorder = Recorder()
    pytest.main([*options.tests.split(), "-q", "-n", "0", "-m", "slow or not slow"], plugins=[recorder])
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{options.name}.md").write_text(table(recorder, options.tests))


if __name__ == "__main__":
    main()
