"""How the points of a manifold, which are solved together, respond to each other's impulses."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array


def point_responses(jacobians: Sequence[Sequence[Array]], responses: Sequence[Sequence[Array]], together: int) -> Array:
    """``J_i M^-1 J_j^T`` (turn, manifold, point i, point j, world) of one row at i to one at j.

    Args:
      jacobians: for each side, components (turn, column, world) of the row.
      responses: the same of ``M^-1 J^T``.
      together: points in a manifold, neighbouring columns.
    """
    terms = [
        a.reshape(a.shape[0], -1, together, 1, a.shape[-1]) * b.reshape(b.shape[0], -1, 1, together, b.shape[-1])
        for jacobian, response in zip(jacobians, responses, strict=True)
        for a, b in zip(jacobian, response, strict=True)
    ]
    return functools.reduce(jnp.add, terms)
