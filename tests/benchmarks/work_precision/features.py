"""What each feature of a scene costs (BENCHMARKS M1): operations, CPU time, memory and compile time of a step."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import jax
import jax.numpy as jnp

from mathota_jax import Box, Hinge, Options, Plane, SceneBuilder, Sphere, step
from mathota_jax.step import step_worlds_last
from tests.benchmarks.ours import batched_step, repeat
from tests.benchmarks.settings import TIME_STEP, Settings
from tests.benchmarks.timing import Contestant, interleave
from tests.benchmarks.work_precision.jax_program import JaxProgram

WORLDS = 1024
STEPS = 60
UNDAMPED = {"linear_damping": 0.0, "angular_damping": 0.0, "dt": TIME_STEP}


def _scene(
    shape: Any, contact: bool, friction: float, restitution: float, hinge: bool, **options: Any
) -> tuple[Any, Any]:
    builder = SceneBuilder()
    surface = {"friction": friction, "restitution": restitution}
    if contact:
        builder.add_body(Plane((0, 1, 0)), static=True, **surface)
    builder.add_body(shape, mass=1.0, position=(0, 0.1, 0), velocity=(1.0, 0, 0), **surface)
    if hinge:
        arm = builder.add_body(Box((0.1, 0.02, 0.02)), mass=0.1, position=(0.2, 0.1, 0), collides=False)
        builder.add_joint(Hinge(parent=arm - 1, child=arm, anchor=(0.1, 0.1, 0), axis=(0, 0, 1)))
    return builder.build(Options(**{**UNDAMPED, **options}))


SPHERE, BOX = Sphere(0.1), Box((0.1, 0.1, 0.1))
LADDER = {
    "S0 free sphere": (SPHERE, False, 0.0, 0.0, False),
    "S1 sphere on a plane": (SPHERE, True, 0.0, 0.0, False),
    "S2 with friction": (SPHERE, True, 0.5, 0.0, False),
    "S3 with restitution": (SPHERE, True, 0.5, 0.5, False),
    "free box": (BOX, False, 0.0, 0.0, False),
    "box on a plane, no friction": (BOX, True, 0.0, 0.0, False),
    "S4 box on a plane, friction": (BOX, True, 0.5, 0.0, False),
    "box with restitution": (BOX, True, 0.5, 0.5, False),
    "S5 box with a hinged arm": (BOX, True, 0.5, 0.0, True),
}
EXTRAS = {
    "S4 with damping": {"linear_damping": 0.01, "angular_damping": 0.05},
    "S4 without warm start": {"warm_start": False},
    "S4 without position correction": {"position_iterations": 0},
    "S4 with continuous collision": {"continuous": True},
    "S4 with sleep": {"sleep": True},
}


def measure(settings: Settings) -> dict:
    """Rows of the table, one for each scene, timed in turns."""
    scenes = {name: _scene(*given) for name, given in LADDER.items()}
    if settings.mode != "quick":
        plain = LADDER["S4 box on a plane, friction"]
        scenes.update({name: _scene(*plain, **options) for name, options in EXTRAS.items()})
    rows, contestants = {}, {}
    for name, (model, state) in scenes.items():
        rows[name], contestants[name] = _row(model, state)
    interleave(contestants, settings)
    for name, contestant in contestants.items():
        report = contestant.report()
        rows[name] |= {"rate": report["cpu_rate"]["median"], "cpu_rates": report["rounds"]["cpu_rate"]}
    return {"worlds": WORLDS, "dt": TIME_STEP, "rows": rows}


def _row(model: Any, state: Any) -> tuple[dict, Contestant]:
    equations = count_equations(jax.make_jaxpr(step_worlds_last)(*worlds_last(model, state), jnp.zeros((0, 1))).jaxpr)
    begin = time.process_time()
    compiled = jax.jit(lambda m, s: step(m, s)).lower(model, state).compile()
    seconds = time.process_time() - begin
    analysis = compiled.cost_analysis() or {}
    worlds = JaxProgram(
        lambda dt: dataclasses.replace(model, dt=model.dt), repeat(state, WORLDS), batched_step, lambda *_: None, WORLDS
    )
    row = {
        "equations": equations,
        "flops": analysis.get("flops"),
        "compile_cpu_seconds": seconds,
        "bytes_per_world": worlds.bytes_per_world,
    }
    return row, Contestant(worlds.block_of(STEPS, TIME_STEP), {})


def worlds_last(*trees: Any) -> Any:
    """One world as the engine's functions take it: a trailing axis of 1 on every leaf."""
    return jax.tree.map(lambda leaf: leaf[..., None], trees)


def count_equations(jaxpr: Any) -> int:
    """Equations of a jaxpr with those of the programs inside it."""
    total = 0
    for equation in jaxpr.eqns:
        total += 1
        for value in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda leaf: hasattr(leaf, "jaxpr")):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                total += count_equations(inner)
    return total
