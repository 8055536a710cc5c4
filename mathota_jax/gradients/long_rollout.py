"""`long_rollout`: many steps with little memory in reverse mode, and with a gradient that does not explode."""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Integral
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.gradients.clipping import clip_cotangent
from mathota_jax.leaf_shapes import check_actions, check_leaves
from mathota_jax.model import Model
from mathota_jax.state import State
from mathota_jax.step import step

Step = Callable[[Model, State, Array], State]


def long_rollout(
    model: Model,
    state: State,
    actions: Array | int,
    *,
    observe: Callable[[State], Any] | None = None,
    segment: int | None = None,
    window: int | None = None,
    largest_norm: float | None = None,
    stepper: Step = step,
) -> tuple[State, Any]:
    """`rollout` for reverse mode through many steps; values are those of `rollout`.

    `rollout` keeps every state for reverse mode. This one keeps the states at the ends of segments and computes the others
    again, one segment at a time (A. Griewank, A. Walther, "Algorithm 799: revolve", 2000, with two levels): memory for
    ``steps / segment + segment`` states, at the price of one more forward pass. With the default segment that is
    ``2 sqrt(steps)``.

    Args:
      model: parameters and static scene.
      state: initial state of one world.
      actions: (step, motor) actions, or the number of steps without effort.
      observe: what to record of the state after each step, a pytree; None for nothing. It is kept for all steps, so record
        what the loss reads, not whole states.
      segment: steps between two kept states; None for the square root of the number of steps.
      window: derivatives flow back over at most this many steps: states after steps `window`, 2 `window`, ... are
        constants to the later ones (truncated backpropagation through time; R. J. Williams, J. Peng, 1990). The
        derivatives by model and actions lack what acts over the boundaries; None for exact derivatives.
      largest_norm: bound of the norm of the cotangent of the state at every step, for each world (`clip_cotangent`, which
        rules out forward mode); None for none.
      stepper: what advances the state, such as `smoothed_step` with a reach.

    Returns:
      The final state, and what `observe` returned with a leading axis, entry k being that after step k + 1.

    Raises:
      ValueError: a negative or traced number of steps, actions of the wrong shape, or `segment` or `window` less than 1.
    """
    check_leaves("long_rollout", model, state)
    actions = check_actions("long_rollout", model, state, actions)
    for name, value in (("segment", segment), ("window", window)):
        if value is None:
            continue
        if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
            raise ValueError(f"long_rollout: {name} must be a whole number of at least 1 step, got {value!r}")
    count = actions.shape[0]
    segment = min(segment or max(1, math.isqrt(count)), max(count, 1))

    def one(model: Model, state: State, index_and_action: tuple[Array, Array]) -> tuple[State, Any]:
        index, action = index_and_action
        if window is not None:
            cut = (index % window == 0) & (index > 0)
            state = jax.tree.map(lambda leaf: jnp.where(cut, lax.stop_gradient(leaf), leaf), state)
        if largest_norm is not None:
            state = clip_cotangent(state, largest_norm)
        state = stepper(model, state, action)
        return state, None if observe is None else observe(state)

    @jax.checkpoint
    def steps(model: Model, state: State, part: tuple[Array, Array]) -> tuple[State, Any]:
        return lax.scan(lambda state, x: one(model, state, x), state, part)

    whole = count // segment * segment
    indexed = (jnp.arange(count), actions)
    parts = jax.tree.map(lambda x: x[:whole].reshape(count // segment, segment, *x.shape[1:]), indexed)
    state, seen = lax.scan(lambda state, part: steps(model, state, part), state, parts)
    seen = jax.tree.map(lambda x: x.reshape(whole, *x.shape[2:]), seen)
    if whole < count:
        state, rest = steps(model, state, jax.tree.map(lambda x: x[whole:], indexed))
        seen = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), seen, rest)
    return state, seen
