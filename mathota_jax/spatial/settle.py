"""One computation for one decision.

XLA copies cheap shared expressions into every kernel that uses them and contracts multiply-add pairs differently in
each copy. A comparison that depends on such an expression can then come out *both ways* inside one step: one output
sees branch A, the next one branch B. The cure: reduce a discrete choice to one number, pass that number through an
operation that XLA never copies (a division) and cannot fold away, and select every output from the result.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax


def settle(decision: Array) -> Array:
    """Returns the finite number `decision` unchanged, computed exactly once. Elementwise, floating point, any shape.

    The divisor is 1 for every finite input, but XLA does not know that. The derivative is zero: a decision is discrete.
    """
    decision = lax.stop_gradient(decision)
    opaque_one = decision * 0 + 1  # not foldable: a float times 0 need not be 0
    return decision / opaque_one


def settle_code(decision: Array) -> Array:
    """`settle` for a choice that is a small non-negative or negative integer stored as a float; returns int32."""
    return settle(decision).astype(jnp.int32)


def opaque_one(settled: Array, dtype: Any) -> Array:
    """The number 1, of the shape of the finite array `settled`, which XLA cannot know to be 1."""
    return settled.astype(dtype) * 0 + 1


def compute_once(values: Any, one: Array) -> Any:
    """Keeps XLA from recomputing each array of the pytree `values` in every kernel that uses it.

    Values and derivatives are unchanged. Worth a division where an array is costly and has many consumers. An array with
    one world is left alone: storing it would cost a kernel, computing it again costs nothing beside the others.

    Args:
        values: Pytree of floating-point arrays that broadcast with `one`.
        one: Result of `opaque_one`.
    """
    one = lax.stop_gradient(one)
    return jax.tree.map(lambda value: value if jnp.shape(value)[-1:] in ((), (1,)) else value / one, values)
