"""CPU time of a step against the number of bodies: ``python -m tests.benchmarks.body_count [counts ...]``.

Three states of one scene of equal spheres above a plane, so that a count is compiled once: spread out (no pair is close),
a settling pile (each sphere touches a few), and all touching each other (more pairs than any capacity: flagged).
Writes ``results/body_count.json`` and ``.md``.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import Options, Plane, SceneBuilder, Sphere, step
from tests.benchmarks.process import ONE_CORE

RESULTS = pathlib.Path(__file__).parent / "results"
DT = 1 / 240

COUNTS = (8, 16, 32, 64, 128, 256, 512, 1024)
RADIUS = 0.1
SLOTS_TO = 64
"""Up to this many bodies a slot for every pair is measured too."""
WARM_UP_STEPS = 60
BLOCKS, BLOCK_STEPS = 7, 5


def scene(count: int, broadphase: str = "auto") -> tuple[Any, Any]:
    """`count` spheres of 1 kg and the plane y = 0."""
    builder = SceneBuilder()
    builder.add_body(Plane((0, 1, 0)), static=True)
    for _ in range(count):
        builder.add_body(Sphere(RADIUS), mass=1.0)
    return builder.build(Options(dt=DT, broadphase=broadphase))


def arrangements(count: int) -> dict[str, np.ndarray]:
    """Positions (count, 3) [m] of the spheres."""
    side = int(np.ceil(count ** (1 / 3)))
    lattice = np.stack(np.unravel_index(np.arange(count), (side, side, side)), axis=1)[:, [0, 2, 1]].astype(float)
    jitter = 0.02 * np.random.default_rng(0).normal(size=lattice.shape)
    lift = np.array([0.0, 1.1, 0.0])
    return {
        "spread out": RADIUS * (4.0 * (lattice + jitter) + lift + [0.0, 1000.0, 0.0]),
        "pile": RADIUS * (2.05 * lattice + jitter + lift),
        "all touching": RADIUS * (5.0 * jitter + [0.0, 2.0, 0.0]),
    }


def measure(count: int, broadphase: str = "auto") -> dict[str, Any]:
    """Compile time [s] and, for each arrangement, the median CPU time of a step [ms], the pairs held and the flags."""
    model, start = scene(count, broadphase)
    begin = time.process_time()
    compiled = jax.jit(step).lower(model, start).compile()
    found: dict[str, Any] = {"bodies": count, "compile": time.process_time() - begin, "slots": model.scene.slot_count}
    found["method"] = model.scene.broadphase.method if model.scene.broadphase else "own slots"
    for name, place in arrangements(count).items():
        state = dataclasses.replace(start, position=start.position.at[1:].set(jnp.asarray(place)))
        for _ in range(1 if name == "all touching" else WARM_UP_STEPS):
            settled, state = state, jax.block_until_ready(compiled(model, state))
        blocks = []
        for _ in range(BLOCKS):
            begin = time.process_time()
            for _ in range(BLOCK_STEPS):
                jax.block_until_ready(
                    compiled(model, settled)
                )  # the same step, so that a state stays what it is called
            blocks.append((time.process_time() - begin) / BLOCK_STEPS * 1e3)
        held = -1 if state.contact_pair is None else int((state.contact_pair >= 0).sum())
        found[name] = {"milliseconds": float(np.median(blocks)), "pairs": held, "flags": int(state.flags)}
    return found


def main(counts: tuple[int, ...]) -> None:
    """Measures every count, small ones also with a slot for every pair, and writes both files after each."""
    rows = []
    for count in counts:
        for broadphase in ("auto", "none") if count <= SLOTS_TO else ("auto",):
            if broadphase == "none" and scene(count)[0].scene.broadphase is None:
                continue
            rows.append(measure(count, broadphase))
            stored = {"settings": {"dt": DT, "worlds": 1, "precision": "float32"}, "rows": rows}
            (RESULTS / "body_count.json").write_text(json.dumps(stored, indent=1) + "\n")
            (RESULTS / "body_count.md").write_text(table(rows))


def table(rows: list[dict[str, Any]]) -> str:
    """The report in Markdown."""
    names = list(arrangements(1))
    lines = [
        "# Cost of a step against the number of bodies",
        "",
        "Written by `python -m tests.benchmarks.body_count`: equal spheres above a plane, one world, float32, dt 1/240 s,",
        f"XLA in one thread; median CPU time of a step over {BLOCKS} blocks. *Spread out*: no pair is close, all are",
        "rejected. *Pile*: each sphere touches a few. *All touching*: every sphere overlaps every other; where that is",
        "more pairs than are kept, the step says so (`Flag.CONTACT_OVERFLOW`) and solves those it kept. In brackets the",
        "close pairs that the step kept.",
        "",
        "| bodies | possible pairs | contacts from | slots | compile CPU-s |"
        + "".join(f" {name}, CPU-ms |" for name in names),
        "|---" * (5 + len(names)) + "|",
    ]
    for row in rows:
        count = row["bodies"]
        cells = [str(count), str(count * (count + 1) // 2), row["method"], str(row["slots"]), f"{row['compile']:.1f}"]
        for name in names:
            found = row[name]
            kept = "" if found["pairs"] < 0 else f" ({found['pairs']}{', overflow' if found['flags'] else ''})"
            cells.append(f"{found['milliseconds']:.2f}{kept}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    os.environ.update(ONE_CORE)  # read when XLA starts, with the first computation
    main(tuple(int(argument) for argument in sys.argv[1:]) or COUNTS)
