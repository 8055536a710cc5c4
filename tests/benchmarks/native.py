"""The hand-batched peer of `vmap(step)`: the engine's own function with the world axis kept last throughout."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from mathota_jax.step import step_worlds_last
from tests.benchmarks.batched import BatchedScene
from tests.benchmarks.timing import Block


def hand_batched(worlds: BatchedScene, steps: int) -> Block:
    """Same rollout as `worlds.block(steps)`, without any map and without moving an axis."""
    model = jax.tree.map(lambda leaf: leaf[..., None], worlds.parameters)
    states = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), worlds.states)
    action = jnp.zeros((0, 1))

    def step(model: Any, states: Any) -> Any:
        return step_worlds_last(model, states, action)

    return BatchedScene(model, states, step, lambda states: states.position, worlds.count).block(steps)
