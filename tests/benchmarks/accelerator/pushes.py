"""Random forces on every body in every step, the same in every engine: what bodies at rest cost says little."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from tests.benchmarks.work_precision.jax_program import JaxProgram
from tests.benchmarks.work_precision.scenes import Scene

ENTRIES = 16
"""Steps after which the forces repeat."""
ACCELERATION = 5.0
"""Standard deviation of each component of force over mass [m/s^2]."""


def forces(scene: Scene, worlds: int) -> Array:
    """Forces (step, world, moving body, component) [N]."""
    masses = np.array([body.mass for body in scene.world.moving])
    shape = (ENTRIES, worlds, len(masses), 3)
    return ACCELERATION * jax.random.normal(jax.random.key(0), shape) * masses[:, None]


def pushed_ours(program: JaxProgram, table: Array) -> JaxProgram:
    """A program of mathota_jax whose bodies are pushed by the entries of `table` in turn."""

    def push(states: Any, force: Array) -> Any:
        static = states.position.shape[1] - force.shape[1]
        return dataclasses.replace(states, applied_force=states.applied_force.at[:, static:].set(force))

    return _pushed(program, table, push)


def pushed_mjx(program: JaxProgram, table: Array) -> JaxProgram:
    """The same of MJX."""

    def push(data: Any, force: Array) -> Any:
        static = data.xfrc_applied.shape[1] - force.shape[1]
        return data.replace(xfrc_applied=data.xfrc_applied.at[:, static:, :3].set(force))

    return _pushed(program, table, push)


def _pushed(program: JaxProgram, table: Array, push: Any) -> JaxProgram:
    def step(parameters: Any, turn_and_states: Any) -> Any:
        (own, table), (turn, states) = parameters, turn_and_states
        return turn + 1, program.step(own, push(states, table[turn % ENTRIES]))

    return JaxProgram(
        lambda dt: (program.parameters(dt), table),
        (jnp.int32(0), program.states),
        step,
        lambda turn_and_states, worlds: program.motion(turn_and_states[1], worlds),
        program.count,
    )
