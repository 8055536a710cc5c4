"""What can be differentiated of a function of arrays of any type."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
from jax import Array

OfLeaves = Callable[[Sequence[Array]], Sequence[Array]]


def is_real(value: Any) -> bool:
    """Whether an array, or what has its type, is of floating-point numbers."""
    return jnp.issubdtype(value.dtype, jnp.inexact)


def restricted(function: OfLeaves, leaves: Sequence[Array], mask: Sequence[bool]) -> Callable[..., list[Array]]:
    """The real results of a function of leaves, as a function of those leaves in the mask."""

    def of_selected(*linear: Array) -> list[Array]:
        replacements = iter(linear)
        args = [next(replacements) if selected else leaf for leaf, selected in zip(leaves, mask, strict=True)]
        return [result for result in function(args) if is_real(result)]

    return of_selected
