"""The report of the hard scenes: ``python -m tests.benchmarks.hard_report [part of a name] [tier]``.

Runs the cases whose name contains the first argument (all without one), keeps their figures in results/hard_scenes.json
beside those of earlier runs, and writes results/hard_scenes.md from everything that is kept. Float64: JAX_ENABLE_X64=1.
One world; the cost is CPU time of the process after compilation, a mean over the whole run; compile time includes tracing.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tests.benchmarks.hard_cases import CASES, TIERS, Case, as_run, simulate

RESULTS = Path(__file__).parent / "results"
HEADER = """# Hard scenes

One world, default options but for the damping, which is 0 except for chains (0.1 / s). A figure in bold misses its gate;
a dash was not timed. Written by `python -m tests.benchmarks.hard_report`; the scenes are in
`tests/benchmarks/hard_scenes.py`, settings, gates and measurements in `hard_cases.py`, and what is to carry a scene is
tested in `tests/physics/test_hard_scenes.py`. Peers: published figures (SimBenchmark, Solver2D, ContactBench) and own
measurements with PyBullet and MuJoCo, for the same measurement.

Scenes that are held or not are tests alone: cached impulses (B9) `tests/physics/test_warm_start.py`, tunnelling (B12)
`test_fast_bodies.py`, far away, tiny and huge (B13) `tests/stability/test_scale.py`, bad worlds and time
steps (B15) `test_bad_worlds.py`, random worlds `test_fuzz.py`.
"""


def measured(case: Case, tier: str, programs: dict[Any, Any]) -> dict[str, Any]:
    """Figures of one run in the present precision; `programs` keeps those of equal scenes, with the compile time."""
    model, state = case.built(tier)
    steps, pushed = round(case.seconds / case.dt), case.push.body
    loads = jnp.asarray(case.push.loads(steps), state.position.dtype)
    key = (jax.tree.structure((model, state)), steps, pushed)
    if key not in programs:
        start = time.process_time()
        compiled = jax.jit(simulate, static_argnums=3).lower(model, state, loads, pushed).compile()
        programs[key] = compiled, time.process_time() - start
    compiled, compile_time = programs[key]
    ready = time.process_time()
    final, motion = jax.block_until_ready(compiled(model, state, loads))
    end = time.process_time()
    values = case.measure(as_run(case, model, state, motion))
    return {
        "values": {name: value if np.isfinite(value) else "NaN" for name, value in values.items()},
        "flags": int(final.flags),
        "compile": compile_time,
        "cost": (end - ready) / steps,
    }


def table(kept: dict[str, Any]) -> str:
    """The report in Markdown."""
    parts = [HEADER]
    for case in CASES:
        rows = [
            (tier, precision, kept[key])
            for tier in case.tiers
            for precision in ("float32", "float64")
            if (key := f"{case.name} | {tier} | {precision}") in kept
        ]
        if not rows:
            continue
        names = list(rows[0][2]["values"])
        gated = [f"{name} (gate {case.gates[name]:.3g})" if name in case.gates else name for name in names]
        parts.append(f"\n## {case.name}\n\n{case.seconds:g} s in steps of {case.dt:.3g} s.")
        parts.append(f" Peers: {case.peers}.\n" if case.peers else "\n")
        parts.append("\n| tier | precision | " + " | ".join(gated) + " | CPU-ms a step | compile [CPU-s] |\n")
        parts.append("|---" * (len(names) + 4) + "|\n")
        for tier, precision, found in rows:
            cells = [_cell(found["values"][name], case.gates.get(name)) for name in names]
            flagged = f"{tier} (flags {found['flags']})" if found["flags"] else tier
            cost = "- | -" if found["cost"] is None else f"{1e3 * found['cost']:.3g} | {found['compile']:.0f}"
            parts.append(f"| {flagged} | {precision} | " + " | ".join(cells) + f" | {cost} |\n")
    return "".join(parts)


def _cell(value: float | str, gate: float | None) -> str:
    text = value if isinstance(value, str) else f"{value:.3g}"
    missed = gate is not None and not (not isinstance(value, str) and value <= gate)
    return f"**{text}**" if missed else text


def main() -> None:
    """Runs what the arguments choose."""
    parser = argparse.ArgumentParser(prog="hard_report", description=__doc__)
    parser.add_argument("part", nargs="?", default="", help="of the name of a case; all cases without one")
    parser.add_argument("tier", nargs="?", default="", choices=("", *TIERS), help="all of each case without one")
    arguments = parser.parse_args()
    part, only = arguments.part, arguments.tier
    path = RESULTS / "hard_scenes.json"
    programs: dict[Any, Any] = {}
    for case in CASES:
        for tier in case.tiers:
            if part not in case.name or (only and tier != only):
                continue
            precision = "float64" if jax.config.jax_enable_x64 else "float32"
            key = f"{case.name} | {tier} | {precision}"
            found = measured(case, tier, programs)
            print(key, found, flush=True)
            kept = json.loads(path.read_text()) if path.exists() else {}
            path.write_text(json.dumps({**kept, key: found}, indent=1, sort_keys=True) + "\n")
    (RESULTS / "hard_scenes.md").write_text(table(json.loads(path.read_text())))


if __name__ == "__main__":
    main()
