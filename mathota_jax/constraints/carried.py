"""Contacts that carry a load and approach next to nothing: they rest, whatever their restitution.

Two bodies that lie on one another fall alike, so that nothing but the solution tells that one presses on the other. Any
approach that is left of it would rebound as if both were weightless. Solved exactly, such rebounds grow from round-off until
gravity ends them: a stack at rest shakes for ever. By sweeps 27 balls of restitution 0.3 in a bin did at 0.16 m/s, in steps
of 1/60 s, which is what gravity gives in one; now the fastest keeps 5 mm/s, as without restitution.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.constraints.contact import ContactRows, normal_mass
from mathota_jax.solver.row_matrix import sum_over_points
from mathota_jax.solver.rows import Rows, with_first_bias
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import settle


def resting(contacts: Sequence[ContactRows], last: Sequence[Array], fall: Array) -> list[ContactRows]:
    """Contacts without the rebounds that what they carried in the last step ends within this one.

    Args:
      contacts: those of the step.
      last: impulses (turn, row, column, world) of the last step.
      fall: (1, world) velocity [m/s] that gravity gives in a step: a rebound that is faster leaves for longer.
    """
    found = []
    for contact, impulse in zip(contacts, last, strict=True):
        bias, load = contact.rows.bias[:, :1], contact.load
        assert load is not None
        # Of all points of a pair: one that carries nothing itself is held by the others.
        carried = safe_divide(_of_pair(contact.rows, impulse), normal_mass(contact.rows))
        ends = lax.stop_gradient((bias < 0) & (-bias <= jnp.minimum(fall, carried)))
        rests = settle(jnp.where(ends, 1.0, 0.0)) > 0.5
        lever, lasting = (jnp.where(rests, load.resting, other) for other in (contact.lever, load.lever))
        load = load._replace(alone=jnp.where(rests, 0.0, load.alone), lever=lasting)
        rows = with_first_bias(contact.rows, jnp.where(rests, load.bias, bias))
        found.append(contact._replace(rows=rows, lever=lever, load=load))
    return found


def _of_pair(rows: Rows, impulse: Array) -> Array:
    """(turn, 1, column, world) sum of the normal impulses of all points of the pair of each column."""
    points = rows.table.together
    return jnp.repeat(sum_over_points(impulse[:, 0], points), points, axis=1)[:, None]
