"""Order of the error in the time step, scene by scene (BENCHMARKS A2, A5, A7, A9, A11, A12, A13).

    OMP_NUM_THREADS=1 python -m tests.benchmarks.orders [--scenes "A9 slide"]

Writes ``results/orders.json`` and ``.md``: errors of the default settings against closed forms or an integrator of eighth
order, in both precisions, and the order p of the least squares line ``log error = log C + p log dt`` in float64.
"""

from __future__ import annotations

import argparse
import json
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import Plane, SceneBuilder, Sphere, energy, step
from tests.fit.scenes import bounce_height
from tests.physics.test_billiards import two_balls
from tests.physics.test_chain import TIPS, chain
from tests.physics.test_tumble import reference, tumbling_worlds
from tests.scenes import (
    DOWN,
    GRAVITY,
    advance,
    advance_worlds,
    angle_between,
    rotation_matrix,
    slab_on_plane,
    sphere_on_plane,
    undamped,
    with_dt,
)

RESULTS = pathlib.Path(__file__).parent / "results"
RATES = (60, 120, 240, 480, 960)
"""Steps a second."""
PRECISIONS = ("float64", "float32")
EXACT = 1e-8
"""Errors in float64 below which there is no order to be seen: closed forms are given to nine digits."""

Errors = Callable[[int], float]
"""Error at a number of steps a second."""


def bouncing() -> Errors:
    """49 elastic balls that drop 4.9 m, for 20 s."""
    builder = SceneBuilder(gravity=DOWN)
    surface = {"restitution": 1.0, "friction": 0.0}
    builder.add_body(Plane((0, 1, 0)), static=True, **surface)
    for row in range(7):
        for column in range(7):
            builder.add_body(Sphere(0.1), mass=10.0, position=(2.0 * row, 5.0, 2.0 * column), **surface)
    model, state = builder.build(undamped())
    whole = 49 * 10 * GRAVITY * 5

    @jax.jit
    def deviation(model: Any, state: Any, count: Any) -> Any:
        def body(_: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            state, total = carry
            state = step(model, state)
            return state, total + (energy(model, state) / whole - 1) ** 2

        return jnp.sqrt(jax.lax.fori_loop(0, count, body, (state, jnp.zeros_like(model.dt)))[1] / count)

    return lambda rate: float(deviation(with_dt(model, 1 / rate), state, 20 * rate))


def hanging() -> Errors:
    """Ten links let go level: their tip after 0.5 s."""
    model, state = chain(10)

    def error(rate: int) -> float:
        final = advance(with_dt(model, 1 / rate), state, rate // 2)
        tip = np.asarray(final.position, float)[10] + rotation_matrix(final.orientation[10])[:, 0] * 0.05
        return float(np.linalg.norm(tip[:2] - TIPS[10][0]))

    return error


def tumbling() -> Errors:
    """A box about its middle axis, spun at (1, 10, 0) rad/s: its orientation after 10 s."""
    models, states = tumbling_worlds()
    truth = reference("b")[:4]

    def error(rate: int) -> float:
        final = advance_worlds(with_dt(models, 1 / rate), states, 10 * rate)
        return float(angle_between(final.orientation[1, 0], truth))

    return error


def sliding() -> Errors:
    """A slab at 2 m/s, friction 0.4: the way to its rest."""
    model, state = slab_on_plane(friction=0.4, velocity=(2.0, 0.0, 0.0))
    truth = 2.0**2 / (2 * 0.4 * GRAVITY)
    return lambda rate: _relative(advance(with_dt(model, 1 / rate), state, rate).position[1, 0], truth)


def rolling() -> Errors:
    """A sphere thrown without spin at 5 m/s, friction 0.2: the way in 2 s, sliding and then rolling."""
    model, state = sphere_on_plane(friction=0.2, velocity=(5.0, 0.0, 0.0))
    truth = 5.0 * 2.0 / 1.4 + 0.5 * (0.4 / 1.4) ** 2 * 5.0**2 / (0.2 * GRAVITY)
    return lambda rate: _relative(advance(with_dt(model, 1 / rate), state, 2 * rate).position[1, 0], truth)


def dropping() -> Errors:
    """A sphere dropped by 1 m, restitution 0.8: its height after 1.5 s and two bounces."""
    model, state = sphere_on_plane(height=1.0, restitution=0.8)
    truth = float(bounce_height([1.5], 0.8)[0])
    return lambda rate: _relative(advance(with_dt(model, 1 / rate), state, 3 * rate // 2).position[1, 1] - 0.1, truth)


def colliding() -> Errors:
    """Two balls that meet obliquely, steps split at the impact: the farther of both from its place after 1 s."""
    model, state = two_balls()
    truth = np.array([[0.720910347, -0.738482756, 0.0], [1.639544827, 0.569241378, 0.0]])
    return lambda rate: float(
        np.linalg.norm(advance(with_dt(model, 1 / rate), state, rate).position - truth, axis=-1).max()
    )


def _relative(value: Any, truth: float) -> float:
    return abs(float(value) / truth - 1)


SCENES: dict[str, tuple[Callable[[], Errors], str]] = {
    "A2 bounce": (bouncing, "energy, root mean square over the start"),
    "A5 chain": (hanging, "tip [m]"),
    "A7 tumble": (tumbling, "angle [rad]"),
    "A9 slide": (sliding, "relative"),
    "A11 slide to roll": (rolling, "relative"),
    "A12 two bounces": (dropping, "relative"),
    "A13 oblique": (colliding, "[m]"),
}


def measure(name: str) -> dict[str, list[float]]:
    """Errors by precision, in the order of `RATES`."""
    found = {}
    for precision in PRECISIONS:
        with jax.enable_x64(precision == "float64"):
            error = SCENES[name][0]()
            found[precision] = [error(rate) for rate in RATES]
    return found


def order(errors: list[float]) -> str:
    """That of the power law through errors at `RATES`."""
    if max(errors) < EXACT:
        return "exact"
    return f"{-np.polyfit(np.log(RATES), np.log(np.maximum(errors, 1e-16)), 1)[0]:.2f}"


def table(found: dict[str, dict[str, list[float]]]) -> str:
    """The report in Markdown."""
    lines = [
        "# Order of the error in the time step",
        "",
        "Written by `python -m tests.benchmarks.orders`: defaults without damping; order p of error = C dt^p fitted to",
        f"the errors in float64, exact where all are below {EXACT:g}. In float32 round-off grows with the number of steps.",
        "",
        f"| Scene | | error | {' | '.join(f'1/{rate} s' for rate in RATES)} | order |",
        f"|---|---|---|{'---|' * len(RATES)}---|",
    ]
    for name, errors in found.items():
        for precision in PRECISIONS:
            figures = " | ".join(f"{error:.1e}" for error in errors[precision])
            fitted = order(errors[precision]) if precision == "float64" else ""
            lines.append(f"| {name} | {precision} | {SCENES[name][1]} | {figures} | {fitted} |")
    lines += ["", *(f"- {name}: {_summary(make)}" for name, (make, _) in SCENES.items())]
    return "\n".join(lines) + "\n"


def _summary(function: Callable[..., Any]) -> str:
    return (function.__doc__ or "").strip()


def main(arguments: list[str] | None = None) -> None:
    """Measures the chosen scenes and writes both files; what earlier runs found of others is kept."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.orders", description=__doc__)
    parser.add_argument("--scenes", default=",".join(SCENES))
    options = parser.parse_args(arguments)
    RESULTS.mkdir(exist_ok=True)
    stored = RESULTS / "orders.json"
    found = json.loads(stored.read_text()) if stored.exists() else {}
    for name in options.scenes.split(","):
        found[name] = measure(name)
        found = {scene: found[scene] for scene in SCENES if scene in found}
        stored.write_text(json.dumps(found, indent=1) + "\n")
        (RESULTS / "orders.md").write_text(table(found))


if __name__ == "__main__":
    main()
