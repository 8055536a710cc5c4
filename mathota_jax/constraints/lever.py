"""How long the velocity change of a step has acted on the position of each body."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array

from mathota_jax.constraints.contact import ContactRows
from mathota_jax.solver import pgs
from mathota_jax.solver.pgs import Rows
from mathota_jax.spatial.safe import safe_divide, safe_sqrt


def levers(
    dt: Array,
    joint_rows: Sequence[Rows],
    contact_rows: Sequence[ContactRows],
    impulses: Sequence[Array],
    velocity: Array,
) -> Array:
    """Time (block, world) that the velocity change by the constraints had to act on the position of each body.

    A joint holds for the whole step (on average dt/2), a contact as long as it lasts. A body takes the mean of its rows,
    weighted by their impulses: with a lever for each row, the large opposite impulses on a light body below a heavy one
    would not cancel, and throw it out.

    Args:
      dt: time step.
      joint_rows, contact_rows: all groups.
      impulses: solved, those of the joints first, for each group (turn, row, column, world).
      velocity: (component, block, world), for its shape.
    """
    half = 0.5 * dt
    if not contact_rows:
        return half * jnp.ones_like(velocity[0])
    count = len(joint_rows)
    total = jnp.zeros((2, *velocity.shape[1:]), velocity.dtype)
    for group, impulse in zip(joint_rows, impulses[:count], strict=True):
        # The linear part of the Jacobian makes a weight [N s] of the impulse, 0 for a row that only turns.
        weights = (safe_sqrt((side[:, :, :3] ** 2).sum(2, keepdims=True)) for side in group.jacobian)
        total = pgs.add_scaled(group, tuple(_weighted(weight, half) for weight in weights), total, jnp.abs(impulse))
    for group, impulse in zip(contact_rows, impulses[count:], strict=True):
        lever = group.lever[:, :, None]
        share = _weighted(jnp.ones_like(lever), lever)
        total = pgs.add_scaled(group.rows, (share,) * len(group.rows.jacobian), total, impulse[:, :1])
    return jnp.where(total[0] > 0, safe_divide(total[1], total[0]), half)


def _weighted(weight: Array, lever: Array) -> Array:
    """(turn, row, 2, column, world): what a unit of impulse adds to the sum of the weights, and of weight times lever."""
    return jnp.concatenate([weight, weight * lever], axis=2)
