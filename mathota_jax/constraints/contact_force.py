"""Forces on contact slots, which outlive a step, and the impulses of its rows."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.constraints.assembly import collect, pack_scalars, select
from mathota_jax.constraints.contact import ContactRows
from mathota_jax.solver.row_matrix import Points
from mathota_jax.solver.rows import Rows, map_turns
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.spread import add_slices, spread
from mathota_jax.spatial.vector import Vec3, dot


def warm_start_impulse(contact: ContactRows, force: Vec3, dt: Array) -> Array:
    """Impulses (turn, row, column, world) from the forces [N] of the last step, components in slot order.

    The force is kept as a world vector, so that friction survives a change of the tangents, and per unit of time, so that
    it survives a change of the time step.
    """
    table = contact.rows.table
    chosen = select(table, force)
    if contact.directions:
        impulses = [dot(chosen, direction) * dt for direction in contact.directions]
        impulses[0] = jnp.maximum(impulses[0], 0.0)
        return pack_scalars(table, impulses, contact.rows.bias.shape[-1])

    def impulse(part: Rows, of_turns: tuple[Vec3, Array | None]) -> Array:
        force, sign = of_turns
        along = Vec3(*unstack(_directions(part), 2))
        found = dot(force.map(lambda x: x[:, None]), along) * (dt if sign is None else dt * sign[:, None])
        return jnp.where(np.arange(found.shape[1])[:, None, None] > 0, found, jnp.maximum(found, 0.0))

    by_turn = chosen.map(lambda x: x.reshape(table.turn_count, table.column_count, -1))
    return map_turns(impulse, contact.rows, (by_turn, contact.sign))


def slot_force(contacts: list[ContactRows], impulses: list[Array], slot_count: int, dt: Array) -> Array:
    """(slot, 3, world) mean force on body B over the step."""
    own, parts, own_count = [], [], slot_count
    for contact, impulse in zip(contacts, impulses, strict=True):
        table = contact.rows.table
        if contact.directions:
            own.append((table, _force_of_columns(contact, impulse) / dt))
        else:
            parts.append(_force_of_turns(contact, impulse, dt))
            own_count -= len(parts[-1])
    if own:
        tables, values = zip(*own, strict=True)
        components = [collect(tables, [value[axis] for value in values], own_count) for axis in range(3)]
        parts.insert(0, jnp.stack(components, axis=1))
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


def _force_of_columns(contact: ContactRows, impulse: Array) -> Vec3:
    """Impulses as vectors, components (turn, column, world)."""
    turns, _, columns, worlds = impulse.shape
    rows = unstack(impulse, 1)
    components = []
    for axis in range(3):
        total = jnp.zeros((turns, columns, worlds), impulse.dtype)
        for part, direction in zip(rows, contact.directions, strict=True):
            full = jnp.broadcast_to(direction[axis], (turns * columns, worlds)).reshape(turns, columns, worlds)
            total = total + full * part
        components.append(total)
    return Vec3(*components)


def _force_of_turns(contact: ContactRows, impulse: Array, dt: Array) -> Array:
    """(turn * column, 3, world) of contacts that keep their directions in the matrix of their rows."""

    def force(part: Rows, of_turns: tuple[Array, Array | None]) -> Array:
        impulse, sign = of_turns
        along = _directions(part)
        total = add_slices(along * spread(impulse[:, :, None], along.shape), 1)
        total = total / dt if sign is None else total * (sign / dt)[:, None]
        return jnp.swapaxes(total, 1, 2)

    found = map_turns(force, contact.rows, (impulse, contact.sign))
    return found.reshape(-1, *found.shape[2:])


def _directions(rows: Rows) -> Array:
    """(turn, row, 3, column, world), with the sign of the only side."""
    assert isinstance(rows.matrix, Points)
    return rows.matrix.directions
