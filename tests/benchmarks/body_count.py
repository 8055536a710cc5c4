"""CPU time of a step against the number of bodies: ``python -m tests.benchmarks.body_count [counts ...]``.

Three states of one scene of equal spheres above a plane, so that a count is compiled once: spread out (no pair is close),
a settling pile (each sphere touches a few), and all touching each other (more pairs than any capacity: flagged).
"""

from __future__ import annotations

import dataclasses
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import Options, Plane, SceneBuilder, Sphere, step

COUNTS = (8, 16, 32, 64, 128, 256, 512, 1024)
RADIUS = 0.1
WARM_UP_STEPS = 60
BLOCKS, BLOCK_STEPS = 7, 5


def scene(count: int, broadphase: str = "auto") -> tuple[Any, Any]:
    """`count` spheres of 1 kg and the plane y = 0."""
    builder = SceneBuilder()
    builder.add_body(Plane((0, 1, 0)), static=True)
    for _ in range(count):
        builder.add_body(Sphere(RADIUS), mass=1.0)
    return builder.build(Options(dt=1 / 240, broadphase=broadphase))


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
    """Prints a row for each count, and for small ones the row with a slot for every pair beside it."""
    names = list(arrangements(1))
    print("| bodies | contacts from | slots | compile s |", *(f"{name} ms (pairs) |" for name in names))
    print("|---" * (4 + len(names)) + "|")
    for count in counts:
        for broadphase in ("auto", "none") if count <= 64 else ("auto",):
            if broadphase == "none" and scene(count)[0].scene.broadphase is None:
                continue
            row = measure(count, broadphase)
            cells = (
                f"{row[name]['milliseconds']:.2f} ({row[name]['pairs']}{', overflow' if row[name]['flags'] else ''}) |"
                for name in names
            )
            print(f"| {count} | {row['method']} | {row['slots']} | {row['compile']:.1f} |", *cells, flush=True)


if __name__ == "__main__":
    main(tuple(int(argument) for argument in sys.argv[1:]) or COUNTS)
