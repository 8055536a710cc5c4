"""Cost, memory and truth of the gradient of a slide rollout with respect to launch speed and friction."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import step
from tests.benchmarks import ours, scenes
from tests.benchmarks.settings import GRADIENT_BATCH, GRADIENT_STEPS, TIME_STEP, Settings
from tests.benchmarks.timing import Contestant, interleave, paired_ratio

STOPPED_STEPS = 240
"""At 1/240 s every cube has come to rest: the derivative of the stopping distance."""


def measure(settings: Settings) -> dict:
    """Measures the gradient of the final position, worlds mapped, beside the forward rollout alone."""
    speeds = jnp.asarray(scenes.spread(scenes.SLIDE_SPEEDS, GRADIENT_BATCH), jnp.float32)
    frictions = jnp.full_like(speeds, scenes.SLIDE_FRICTION)
    model, state = ours.slide_world(TIME_STEP)
    forward = compile_forward(model, state, speeds, frictions, GRADIENT_STEPS)
    gradient = compile_gradient(model, state, speeds, frictions, GRADIENT_STEPS)

    shared = {"dt": TIME_STEP, "batch": GRADIENT_BATCH, "steps": GRADIENT_STEPS, "precision": "float32"}
    contestants = {
        "forward": Contestant(lambda: _run(forward, model, state, speeds, frictions), shared),
        "value and gradient": Contestant(lambda: _run(gradient, model, state, speeds, frictions), shared),
    }
    interleave(contestants, settings)
    return {
        "cost_ratio": paired_ratio(contestants["forward"], contestants["value and gradient"]),
        "sliding": sliding_errors(gradient(model, state, speeds, frictions), GRADIENT_STEPS),
        "stopped": stopped_errors(model, state, speeds, frictions),
        "memory": memory(settings, model, state, speeds, frictions),
        "contestants": {name: contestant.report() for name, contestant in contestants.items()},
    }


def final_position(model: Any, state: Any, speed: Any, friction: Any, steps: int) -> Any:
    """Distance that one cube has gone after some steps [m]."""
    model = dataclasses.replace(model, friction=jnp.full_like(model.friction, friction))
    state = dataclasses.replace(state, velocity=state.velocity.at[ours.BODY, 0].set(speed))
    state = jax.lax.scan(lambda s, _: (step(model, s), None), state, None, length=steps)[0]
    return state.position[ours.BODY, 0]


def compile_forward(model: Any, state: Any, speeds: Any, frictions: Any, steps: int) -> Any:
    """Compiled rollout of all worlds."""

    def forward(model: Any, state: Any, speeds: Any, frictions: Any) -> Any:
        return jax.vmap(lambda v, m: final_position(model, state, v, m, steps))(speeds, frictions)

    return jax.jit(forward).lower(model, state, speeds, frictions).compile()


def compile_gradient(model: Any, state: Any, speeds: Any, frictions: Any, steps: int) -> Any:
    """Compiled value and gradient of all worlds."""

    def gradient(model: Any, state: Any, speeds: Any, frictions: Any) -> Any:
        one = jax.value_and_grad(lambda v, m: final_position(model, state, v, m, steps), argnums=(0, 1))
        return jax.vmap(one)(speeds, frictions)

    return jax.jit(gradient).lower(model, state, speeds, frictions).compile()


def _run(compiled: Any, *arguments: Any) -> int:
    jax.block_until_ready(compiled(*arguments))
    return 1


def sliding_errors(result: Any, steps: int) -> dict:
    """Largest relative errors against x = v t - mu g t^2 / 2."""
    time = steps * TIME_STEP
    _, (by_speed, by_friction) = result
    return {
        "dx/dv": _largest(by_speed, time),
        "dx/dmu": _largest(by_friction, -0.5 * scenes.GRAVITY * time**2),
    }


def stopped_errors(model: Any, state: Any, speeds: Any, frictions: Any) -> dict:
    """Largest relative errors against d = v^2 / (2 mu g)."""
    _, (by_speed, by_friction) = compile_gradient(model, state, speeds, frictions, STOPPED_STEPS)(
        model, state, speeds, frictions
    )
    speed, friction = np.asarray(speeds, float), np.asarray(frictions, float)
    return {
        "dd/dv": _largest(by_speed, speed / (friction * scenes.GRAVITY)),
        "dd/dmu": _largest(by_friction, -(speed**2) / (2 * friction**2 * scenes.GRAVITY)),
    }


def _largest(value: Any, truth: Any) -> float:
    return float(np.max(np.abs(np.asarray(value, float) / truth - 1)))


def memory(settings: Settings, model: Any, state: Any, speeds: Any, frictions: Any) -> dict:
    """Temporary memory of the gradient against the number of steps, with the straight line through it."""
    steps = np.array(settings.memory_steps)
    bytes_used = np.array(
        [
            compile_gradient(model, state, speeds, frictions, int(count)).memory_analysis().temp_size_in_bytes
            for count in steps
        ]
    )
    slope, offset = np.polyfit(steps, bytes_used, 1)
    deviation = np.max(np.abs(slope * steps + offset - bytes_used)) / bytes_used.max()
    return {
        "steps": steps.tolist(),
        "bytes": bytes_used.tolist(),
        "bytes_per_world_step": float(slope / GRADIENT_BATCH),
        "deviation_from_line": float(deviation),
    }
