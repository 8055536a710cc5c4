"""Error and cost of the solver tiers on the hard cases: ``python -m tests.benchmarks.solver_tiers [file]``.

Cubes of mass ratio R (benchmark B1) and stacks of N cubes (B3), one world, at 60 Hz for 2 s. Cost is CPU time of the process
after compilation; compile time includes tracing. `moved` is the largest displacement of any body: the truth is 0.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from mathota_jax import Box, Flag, Options, Plane, SceneBuilder
from tests.scenes import DOWN, advance, box_stack

TIERS: dict[str, dict] = {
    "pgs": {},
    "pgs, 100 sweeps": {"velocity_iterations": 100},
    "converged": {"solver": "converged"},
}
DT, SECONDS = 1 / 60, 2.0
RATIOS = {"float32": (1e0, 1e2, 1e3, 1e4, 1e5), "float64": (1e0, 1e2, 1e4, 1e6, 1e8)}
STACKS = (10, 20, 40)


def two_cubes(ratio: float, options: Options) -> tuple:
    """A cube of mass `ratio` on one of 1 kg, sides 0.2 m."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=0.9)
    for level, mass in enumerate((1.0, ratio)):
        builder.add_body(Box((0.1, 0.1, 0.1)), mass=mass, position=(0.0, 0.1 + 0.2 * level, 0.0), friction=0.9)
    return builder.build(options)


def line(scene: str, tier: str, precision: str, make: Callable[[Options], tuple]) -> str:
    """One row of the table."""
    steps = round(SECONDS / DT)
    with jax.enable_x64(precision == "float64"):
        model, state = make(Options(dt=DT, linear_damping=0.0, angular_damping=0.0, **TIERS[tier]))
        start = time.process_time()
        jax.block_until_ready(advance(model, state, 0))
        compile_time = time.process_time() - start
        start = time.process_time()
        final = jax.block_until_ready(advance(model, state, steps))
        cost = (time.process_time() - start) / steps
        moved = np.abs(np.asarray(final.position - state.position, dtype=float)).max()
        flag = "flagged" if int(final.flags) & Flag.SOLVER_NOT_CONVERGED else ""
    return f"| {scene} | {precision} | {tier} | {moved:.2g} | {1e3 * cost:.2f} | {compile_time:.1f} | {flag} |"


def table() -> list[str]:
    """All rows; compile times of the later mass ratios are those of a cached program."""
    lines = [
        "| scene | precision | tier | moved [m] | CPU-ms a step | compile [CPU-s] | |",
        "|---|---|---|---|---|---|---|",
    ]
    for precision, ratios in RATIOS.items():
        for tier in TIERS:
            for ratio in ratios:
                lines.append(line(f"cubes 1 : {ratio:g}", tier, precision, lambda o, r=ratio: two_cubes(r, o)))
                print(lines[-1], flush=True)
    for count in STACKS:
        for tier in TIERS:
            lines.append(
                line(f"stack of {count}", tier, "float32", lambda o, n=count: box_stack(n, 0.5, o, friction=0.6))
            )
            print(lines[-1], flush=True)
    return lines


if __name__ == "__main__":
    text = "\n".join(["# Solver tiers", "", *table(), ""])
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "results" / "solver_tiers.md"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
