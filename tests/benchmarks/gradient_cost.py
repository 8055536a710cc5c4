"""Cost and memory of reverse mode: a slab that slides, stacks of five and of ten boxes, a chain of five links.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.gradient_cost [--scenes slide,stack,ten,chain] [--only memory]

Writes ``results/gradient_cost.json`` and ``.md``: CPU time of value and gradient over that of the value, worlds side by
side, interleaved in one process; and temporary memory of the gradient of a long rollout, from the compiler, plain and with
`long_rollout`.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import pathlib
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import Box, Hinge, SceneBuilder, Sphere, rollout
from mathota_jax.gradients import long_rollout
from tests.benchmarks.settings import GRADIENT_BATCH, QUICK
from tests.benchmarks.timing import Contestant, interleave, paired_ratio
from tests.scenes import DOWN, box_stack, slab_on_plane, undamped

RESULTS = pathlib.Path(__file__).parent / "results"
STEPS, LONG = 20, 1000
DT = 1 / 240
RATIO_GATE, MEMORY_GATE = 3.0, 2048
RUNS = {"rollout": rollout, "long_rollout": long_rollout}


def chain(links: int) -> tuple[Any, Any]:
    """Rods of 0.2 m on hinges, level, beside a fixed point."""
    builder = SceneBuilder(gravity=DOWN)
    parent = builder.add_body(Sphere(0.01), static=True)
    for index in range(links):
        place = (0.1 + 0.2 * index, 0.0, 0.0)
        child = builder.add_body(Box((0.1, 0.01, 0.01)), mass=0.2, position=place, collides=False)
        builder.add_joint(Hinge(parent=parent, child=child, anchor=(0.2 * index, 0, 0), axis=(0, 0, 1)))
        parent = child
    return builder.build(undamped(dt=DT))


SCENES = {
    "slide": lambda: slab_on_plane(velocity=(2.0, 0.0, 0.0), options=undamped(dt=DT)),
    "stack": lambda: box_stack(5, options=undamped(dt=DT)),
    "ten": lambda: box_stack(10, options=undamped(dt=DT)),
    "chain": lambda: chain(5),
}


def loss(model: Any, state: Any, velocity: Any, run: Any, steps: int) -> Any:
    """Sum of the final places of all bodies, by the velocities at the start."""
    return jnp.sum(run(model, dataclasses.replace(state, velocity=velocity), steps)[0].position)


def measure_memory(name: str) -> dict[str, Any]:
    """Bytes a body and step."""
    model, state = SCENES[name]()
    bodies = len(model.scene.dynamic_bodies)
    return {label: memory(model, state, run) / (LONG * bodies) for label, run in RUNS.items()}


def measure_time(name: str) -> dict[str, Any]:
    """Ratio of CPU times, rate of the gradient and CPU seconds to compile."""
    model, state = SCENES[name]()
    velocity = jnp.repeat(state.velocity[None], GRADIENT_BATCH, axis=0)
    started = time.process_time()
    forward = jax.jit(jax.vmap(lambda v: loss(model, state, v, rollout, STEPS))).lower(velocity).compile()
    between = time.process_time()
    backward = jax.jit(jax.vmap(jax.value_and_grad(lambda v: loss(model, state, v, rollout, STEPS))))
    backward = backward.lower(velocity).compile()
    compiling = (between - started, time.process_time() - between)

    def block(compiled: Any) -> Any:
        def run() -> int:
            jax.block_until_ready(compiled(velocity))
            return GRADIENT_BATCH * STEPS

        return run

    contestants = {"value": Contestant(block(forward), {}), "gradient": Contestant(block(backward), {})}
    interleave(contestants, QUICK)
    return {
        "ratio": paired_ratio(contestants["value"], contestants["gradient"])["median"],
        "rate": float(np.median(contestants["gradient"].cpu_rates)),
        "compile": compiling,
    }


MEASURES = {"memory": measure_memory, "time": measure_time}


def memory(model: Any, state: Any, run: Any) -> float:
    """Temporary bytes of the gradient of one world over a long rollout; one world's share does not depend on the batch."""
    gradient = jax.jit(jax.grad(lambda v: loss(model, state, v, run, LONG)))
    return float(gradient.lower(state.velocity).compile().memory_analysis().temp_size_in_bytes)


def table(found: dict[str, Any]) -> str:
    """The report in Markdown."""
    lines = [
        "# Cost of reverse mode",
        "",
        f"Written by `python -m tests.benchmarks.gradient_cost`: float32, {GRADIENT_BATCH} worlds, steps of 1/240 s; value",
        f"and gradient of {STEPS} steps by the initial velocities over the value alone (CPU time, medians of {QUICK.rounds}",
        f"interleaved rounds; gate {RATIO_GATE:g}); temporary memory of the gradient of {LONG} steps a moving body and step",
        f"(gate {MEMORY_GATE} bytes) with `rollout` and with `long_rollout`.",
        "",
        "| Scene | gradient / value | gradient [steps/CPU-s] | rollout [bytes] | long_rollout [bytes] | compile [CPU-s] |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in found.items():
        cells = ["not measured"] * 5
        if "ratio" in row:
            forward, backward = row["compile"]
            cells[0], cells[1], cells[4] = (
                f"{row['ratio']:.2f}",
                f"{row['rate']:.3g}",
                f"{forward:.0f} + {backward:.0f}",
            )
        if "rollout" in row:
            cells[2:4] = (f"{row[label]:.0f}" for label in RUNS)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> None:
    """Measures the chosen scenes and writes both files; what earlier runs found of others is kept."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.gradient_cost", description=__doc__)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--only", choices=sorted(MEASURES), help="default: both")
    options = parser.parse_args(arguments)
    RESULTS.mkdir(exist_ok=True)
    stored = RESULTS / "gradient_cost.json"
    what = [options.only] if options.only else list(MEASURES)
    for name, measure in itertools.product(options.scenes.split(","), what):
        new = MEASURES[measure](name)
        found = json.loads(stored.read_text()) if stored.exists() else {}
        found[name] = {**found.get(name, {}), **new}
        ordered = {scene: found[scene] for scene in SCENES if scene in found}
        stored.write_text(json.dumps(ordered, indent=1) + "\n")
        (RESULTS / "gradient_cost.md").write_text(table(ordered))


if __name__ == "__main__":
    main()
