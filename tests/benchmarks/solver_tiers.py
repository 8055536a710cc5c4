"""Error and cost of the solver tiers on the hard cases: ``python -m tests.benchmarks.solver_tiers [file]``.

One world in float32 at 60 Hz, see `hard_scenes`. Cost is CPU time of the process after compilation, a mean over the whole
run; compile time includes tracing, and scenes that differ in numbers alone share it. The table is written line by line.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mathota_jax import Flag, Options, step
from tests.benchmarks.hard_scenes import CASES, DT, Case

TIERS: dict[str, dict[str, Any]] = {
    "pgs": {},
    "pgs, 30 sweeps": {"velocity_iterations": 30},
    "soft_step": {"solver": "soft_step"},
    "soft_step, 16 substeps": {"solver": "soft_step", "substeps": 16},
    "converged": {"solver": "converged"},
}
HEADER = """# Solver tiers

One world in float32, steps of 1/60 s, damping 0.1 / s for chains and none elsewhere. Written by
`python -m tests.benchmarks.solver_tiers`.

| scene | tier | result | CPU-ms a step | compile [CPU-s] |
|---|---|---|---|---|
"""


def line(case: Case, tier: str, compiled: dict[Any, Any]) -> str:
    """One row of the table; `compiled` keeps the programs."""
    damping = 0.1 if "chain" in case.name else 0.0
    model, state = case.build(Options(dt=DT, linear_damping=damping, angular_damping=damping, **TIERS[tier]))

    def run(model: Any, state: Any) -> Any:
        def body(current: Any, _: None) -> Any:
            new = step(model, current)
            return new, (new.position, new.orientation, new.velocity)

        return jax.lax.scan(body, state, None, length=case.steps)

    start = time.process_time()
    key = (jax.tree.structure(model), case.steps)
    compile_time = ""
    if key not in compiled:
        compiled[key] = jax.jit(run).lower(model, state).compile()
        compile_time = f"{time.process_time() - start:.0f}"
    start = time.process_time()
    final, record = jax.block_until_ready(compiled[key](model, state))
    cost = 1e3 * (time.process_time() - start) / case.steps
    names = ("position", "orientation", "velocity")
    arrays = {name: np.asarray(values, dtype=float)[:, 1:] for name, values in zip(names, record, strict=True)}
    result = case.judge(np.asarray(state.position, dtype=float)[1:], arrays)
    if int(final.flags) & Flag.SOLVER_NOT_CONVERGED:
        result += ", flagged"
    return f"| {case.name} | {tier} | {result} | {cost:.2f} | {compile_time} |"


def main() -> None:
    """Runs all cases whose name contains the second argument."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "results" / "solver_tiers.md"
    path.parent.mkdir(exist_ok=True)
    path.write_text(HEADER)
    compiled: dict[Any, Any] = {}
    for case in CASES:
        if len(sys.argv) > 2 and sys.argv[2] not in case.name:
            continue
        for tier in case.tiers:
            text = line(case, tier, compiled)
            print(text, flush=True)
            with path.open("a") as file:
                file.write(text + "\n")


if __name__ == "__main__":
    main()
