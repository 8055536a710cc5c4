"""`clip_cotangent`: an identity whose derivative in reverse mode is bounded."""

from __future__ import annotations

import functools
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

Tree = TypeVar("Tree")


def clip_cotangent(tree: Tree, largest_norm: float) -> Tree:
    """Returns `tree` unchanged; in reverse mode its cotangent is scaled down to a Euclidean norm of `largest_norm`.

    Applied to the state before each step it bounds what a chaotic motion passes back, world by world (R. Pascanu et al.,
    "On the difficulty of training recurrent neural networks", 2013, at every step instead of once). The direction of the
    cotangent is kept. A cotangent that is not finite stays so: a NaN is not hidden. Reverse mode only: a clipped
    derivative is not linear, so forward mode (`jax.jvp`, `jax.jacfwd`) raises a TypeError.

    Args:
      tree: pytree of one world, such as a `State`. Under `jax.vmap` each world is clipped by itself. The norm runs over
        all float leaves together, in the units they have; leaves of integers are passed on.
      largest_norm: positive, static.

    Raises:
      ValueError: `largest_norm` is not positive.
    """
    if not largest_norm > 0:
        raise ValueError(f"clip_cotangent: largest_norm must be positive, got {largest_norm!r}")
    leaves, structure = jax.tree.flatten(tree)
    real = [jnp.issubdtype(jnp.result_type(leaf), jnp.inexact) for leaf in leaves]
    clipped = iter(_clipped(float(largest_norm), [leaf for leaf, chosen in zip(leaves, real, strict=True) if chosen]))
    return jax.tree.unflatten(
        structure, [next(clipped) if chosen else leaf for leaf, chosen in zip(leaves, real, strict=True)]
    )


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _clipped(largest_norm: float, leaves: list[Array]) -> list[Array]:
    return leaves


def _forward(largest_norm: float, leaves: list[Array]) -> tuple[list[Array], None]:
    return leaves, None


def _backward(largest_norm: float, _: None, cotangents: list[Array]) -> tuple[list[Any]]:
    largest = functools.reduce(jnp.maximum, [jnp.max(jnp.abs(c), initial=0.0) for c in cotangents], jnp.zeros(()))
    # Divided by the largest entry first: the squares of an exploding gradient overflow.
    unit = jnp.where(largest > 0, largest, 1.0)
    squares = functools.reduce(jnp.add, [jnp.sum((c / unit) ** 2) for c in cotangents], jnp.zeros(()))
    # The norm is at least the largest entry, so that the quotient can not overflow.
    scale = jnp.minimum(1.0, largest_norm / unit / jnp.sqrt(jnp.maximum(squares, 1.0)))
    return ([c * scale.astype(c.dtype) for c in cotangents],)


_clipped.defvjp(_forward, _backward)
