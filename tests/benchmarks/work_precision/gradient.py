"""Derivative of the stopping distance by the launch speed: error against the closed form, and cost, in three engines.

A world-step here is a step of one world of which the derivative is known at the end: reverse mode in mathota_jax and
Brax, central differences (two runs) in MuJoCo. MJX has no reverse mode through its solver.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tests.benchmarks import scenes as closed_forms
from tests.benchmarks.settings import Settings
from tests.benchmarks.timing import Contestant, interleave
from tests.benchmarks.work_precision import engine, jax_engines, mujoco_engine
from tests.benchmarks.work_precision.jax_program import JaxProgram
from tests.benchmarks.work_precision.scenes import SCENES, start_of, steps_of

WORLDS = 256
DIFFERENCE = 0.05
"""Half the distance of the two launch speeds of a central difference [m/s]. The truth is quadratic in the speed, so that
only the noise of the contacts counts, which a large distance makes small."""
TIME_STEPS = (1 / 60, 1 / 240)


class Gradient(NamedTuple):
    """Name, unit and truth, as of a `Scene`, and the error at which costs are compared."""

    name: str
    unit: str
    truth: str
    aim: float


GRADIENT = Gradient(
    "slide gradient",
    "1",
    "d distance / d speed of the sliding cube, after it stopped, against v / (mu g)",
    0.01,
)


def _error(speed: np.ndarray, derivative: np.ndarray) -> float:
    truth = speed / (closed_forms.SLIDE_FRICTION * closed_forms.GRAVITY)
    error = np.max(np.abs(np.asarray(derivative, float) / truth - 1))
    return float(error) if np.isfinite(error) else float("inf")


def _reverse(program: JaxProgram, speed_of: Callable, with_speed: Callable, x_of: Callable, dt: float) -> tuple:
    """Error, block, compile time and memory of the derivative in a JAX engine."""
    scene = SCENES["slide"]
    steps = steps_of(scene, dt)
    parameters, speeds = program.parameters(dt), speed_of(program.states)

    def distance(speeds: Any, parameters: Any, states: Any) -> Any:
        start = with_speed(states, speeds)
        final = jax.lax.scan(lambda s, _: (program.step(parameters, s), None), start, None, length=steps)[0]
        return jnp.sum(x_of(final))

    begin = time.process_time()
    compiled = jax.jit(jax.grad(distance)).lower(speeds, parameters, program.states).compile()
    seconds = time.process_time() - begin
    error = _error(np.asarray(speeds, float), compiled(speeds, parameters, program.states))

    def block() -> int:
        jax.block_until_ready(compiled(speeds, parameters, program.states))
        return program.count * steps

    return error, block, seconds, compiled.memory_analysis().temp_size_in_bytes / program.count


def _ours(dt: float, setting: str) -> tuple:
    program = engine.program(SCENES["slide"], setting, WORLDS)

    def with_speed(states: Any, speeds: Any) -> Any:
        return dataclasses.replace(states, velocity=states.velocity.at[:, 1, 0].set(speeds))

    return _reverse(program, lambda s: s.velocity[:, 1, 0], with_speed, lambda s: s.position[:, 1, 0], dt)


def _brax(dt: float) -> tuple:
    program = jax_engines.program("Brax spring", SCENES["slide"])

    def with_speed(states: Any, speeds: Any) -> Any:
        moved = states.xd_i.replace(vel=states.xd_i.vel.at[:, 0, 0].set(speeds))
        return states.replace(xd_i=moved)

    return _reverse(program, lambda s: s.xd_i.vel[:, 0, 0], with_speed, lambda s: s.x_i.pos[:, 0, 0], dt)


def _differences(dt: float) -> tuple:
    program = mujoco_engine.MujocoProgram(SCENES["slide"], "default", dt)
    scene, data = SCENES["slide"], program.data
    speeds = start_of("slide", scene.worlds).velocity[:, 0, 0]
    steps = steps_of(scene, dt)

    def derivatives() -> list[float]:
        found = []
        for world, speed in enumerate(speeds):
            ends = []
            for sign in (-1, 1):
                program.throw(world, speed + sign * DIFFERENCE, steps)
                ends.append(float(data.qpos[0]))
            found.append((ends[1] - ends[0]) / (2 * DIFFERENCE))
        return found

    def block() -> int:
        derivatives()
        return scene.worlds * steps

    return _error(speeds, np.array(derivatives())), block, 0.0, program.bytes_per_world()


def measure(settings: Settings) -> dict:
    """Points like those of `sweep.measure`."""
    makers: dict[tuple[str, str], tuple[Callable[[float], tuple], int]] = {
        ("mathota_jax", "pgs"): (lambda dt: _ours(dt, "pgs"), WORLDS)
    }
    missing = {"MJX": "no reverse mode through its solver"}
    if settings.mode != "quick":
        makers["mathota_jax", "converged"] = (lambda dt: _ours(dt, "converged"), WORLDS)
    if reason := mujoco_engine.missing():
        missing["MuJoCo"] = reason
    else:
        makers["MuJoCo", "central differences"] = (_differences, 1)
    if reason := jax_engines.missing().get("Brax spring"):
        missing["Brax spring"] = reason
    else:
        makers["Brax spring", "default"] = (_brax, jax_engines.BATCHES["Brax spring"])
    points, contestants = [], {}
    for (name, setting), (make, batch) in makers.items():
        for dt in TIME_STEPS:
            error, block, seconds, memory = make(dt)
            points.append(
                {
                    "engine": name, "setting": setting, "dt": dt, "batch": batch,
                    "error": error if np.isfinite(error) else None, "compile_cpu_seconds": seconds,
                    "bytes_per_world": memory, "profile": None,
                }
            )  # fmt: skip
            contestants[f"{name}|{setting}|{dt}"] = Contestant(block, {})
    interleave(contestants, settings)
    for point, contestant in zip(points, contestants.values(), strict=True):
        report = contestant.report()
        point |= {"rate": report["cpu_rate"]["median"], "cpu_rates": report["rounds"]["cpu_rate"]}
    return {"points": points, "batches": [], "missing": missing}
