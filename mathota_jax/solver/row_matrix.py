"""The matrices of rows, in two forms: their products with ``J`` and with ``M^-1 J^T``.

Arrays have the axes (turn, row, component, column, world), or the same without the turn. A solver knows the products only;
what a contact point stores is a third of its Jacobian and response, and the sweeps are bound by memory.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.bodies import InverseInertia, unpack_inverse
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.settle import compute_once, store
from mathota_jax.spatial.spread import add_slices, spread
from mathota_jax.spatial.vector import Vec3
from mathota_jax.struct import pytree, static

Entries = list[list[list[Array]]]
"""Components (turn, column, world) of the parts of a matrix, by part and row."""


@pytree
class Dense:
    """Any rows.

    Attributes:
      jacobian: for each side, all entries.
      response: for each side, ``M^-1 J^T``, same shape.
    """

    jacobian: tuple[Array, ...]
    response: tuple[Array, ...]

    @property
    def like(self) -> Array:
        """Some array (..., row, column, world), for `store`."""
        return self.response[0][..., 0, :, :]

    def rates(self, velocities: Sequence[Array]) -> Array:
        """``J v``: (..., row, column, world) from the velocities (..., component, constraint, world) of each side."""
        return functools.reduce(
            jnp.add, [_along(side, velocity) for side, velocity in zip(self.jacobian, velocities, strict=True)]
        )

    def changes(self, impulse: Array, together: int) -> list[Array]:
        """``M^-1 J^T p`` (component, constraint, world) of each side, summed over the rows and columns of a constraint."""
        return [_sum(side, impulse, together) for side in self.response]

    def changes_once(self, impulse: Array, together: int) -> list[Array]:
        """`changes` of a single turn, stored."""
        return [store(_sum(side, impulse, together), side[0, :, ::together]) for side in self.response]

    def linear_responses(self) -> list[tuple[Array, Array | float]]:
        """For each side the first three components of the response, and a factor (..., constraint, world) on them."""
        return [(side[..., :3, :, :], 1.0) for side in self.response]

    def first_row(self) -> Dense:
        """That of the first row of each constraint alone."""
        return Dense(*(tuple(_first(side) for side in sides) for sides in (self.jacobian, self.response)))

    def other_rows(self) -> Dense:
        """That of the others."""
        return Dense(*(tuple(_others(side) for side in sides) for sides in (self.jacobian, self.response)))

    def dense(self) -> Dense:
        return self

    def entries(self) -> tuple[Entries, Entries]:
        """Entries of two matrices whose product is ``J M^-1 J^T``; turns, no single one."""
        jacobian, response = ([_entries(side) for side in sides] for sides in (self.jacobian, self.response))
        return jacobian, response


@pytree
class Points:
    """Rows along directions at points of two bodies, or of one.

    Attributes:
      packed: (..., row, component, column, world) the directions in which side B moves against side A, of the only side
        with its sign; then for each side its sign times (arm x direction), unless nothing couples to rotation. In one
        array, since loops have kernels for each.
      packed_inertia: for each side, the entries of its inverse inertia (turn, entry, constraint, world), likewise.
    """

    packed: Array
    packed_inertia: tuple[Array, ...]

    @property
    def directions(self) -> Array:
        """(..., row, 3, column, world)."""
        return self._parts[0]

    @property
    def angular(self) -> tuple[Array, ...]:
        """For each side (..., row, 3, column, world); none where nothing couples to rotation."""
        return tuple(self._parts[1:])

    @property
    def _parts(self) -> list[Array]:
        return _vectors(self.packed, -3)

    @property
    def inertia(self) -> tuple[InverseInertia, ...]:
        """For each side, components (..., constraint, world)."""
        return tuple(unpack_inverse(unstack(side, -3)) for side in self.packed_inertia)

    @property
    def like(self) -> Array:
        """Some array (..., row, column, world), for `store`."""
        return self.packed[..., 0, :, :]

    @property
    def _signs(self) -> tuple[float, ...]:
        return (-1.0, 1.0)[-len(self.packed_inertia) :]

    def rates(self, velocities: Sequence[Array]) -> Array:
        """As `Dense.rates`."""
        linear = velocities[-1][..., :3, :, :]
        if len(velocities) == 2:
            linear = linear - velocities[0][..., :3, :, :]
        total = _along(self.directions, linear)
        for side, velocity in zip(self.angular, velocities, strict=bool(self.angular)):
            total = total + _along(side, velocity[..., 3:, :, :])
        return total

    def changes(self, impulse: Array, together: int) -> list[Array]:
        """As `Dense.changes`."""
        # Stored, since every component of a change needs all of them, in different ways.
        like = self.packed[0, :, ::together]
        force, *torques = _vectors(store(_sum(self.packed, impulse, together), like), 0)
        linear = [force * (sign * side.inverse_mass) for sign, side in zip(self._signs, self.inertia, strict=True)]
        if not torques:
            return linear
        angular = [side.solve(Vec3(*unstack(torque, 0))) for side, torque in zip(self.inertia, torques, strict=True)]
        return [jnp.concatenate([moved, jnp.stack(turned)]) for moved, turned in zip(linear, angular, strict=True)]

    def changes_once(self, impulse: Array, together: int) -> list[Array]:
        """As `Dense.changes_once`."""
        found = self.changes(impulse, together)
        return [store(part, self.packed[0, : len(part), ::together]) for part in found]

    def linear(self) -> tuple[Array, ...]:
        """The first three components of the Jacobian of each side."""
        return tuple(self.directions * sign for sign in self._signs)

    def linear_responses(self) -> list[tuple[Array, Array | float]]:
        """As `Dense.linear_responses`."""
        return [
            (self.directions, sign * side.inverse_mass) for sign, side in zip(self._signs, self.inertia, strict=True)
        ]

    def stored(self) -> Points:
        """The same, computed once."""
        return Points(compute_once(self.packed, self.like), self.packed_inertia)

    def first_row(self) -> Points:
        """As `Dense.first_row`."""
        return Points(_first(self.packed), self.packed_inertia)

    def other_rows(self) -> Points:
        """As `Dense.other_rows`."""
        return Points(_others(self.packed), self.packed_inertia)

    def dense(self) -> Dense:
        """The same rows with all entries. Stored: each product, and each cotangent, would compute them again."""
        sides = self.linear()
        if self.angular:
            sides = tuple(jnp.concatenate(parts, axis=-3) for parts in zip(sides, self.angular, strict=True))
        jacobian = compute_once(sides, self.like)
        response = tuple(self._respond(side, inertia) for side, inertia in zip(jacobian, self.inertia, strict=True))
        return Dense(jacobian, compute_once(response, self.like))

    def entries(self) -> tuple[Entries, Entries]:
        """As `Dense.entries`: the sides share what only moves them, so that it is there once, with the sum of masses."""
        turns, rows, _, columns, worlds = self.packed.shape
        of_rows = [list(row) for row in _entries(self.packed)]
        mass = functools.reduce(jnp.add, [side.inverse_mass for side in self.inertia])
        mass = self._of_columns(mass)[:, 0, 0]
        jacobian = [[row[k : k + 3] for row in of_rows] for k in range(0, len(of_rows[0]), 3)]
        response = [[[component * mass for component in row] for row in jacobian[0]]]
        for side, inertia in zip(self.angular, self.inertia, strict=bool(self.angular)):
            of_columns = jax.tree.map(lambda x: self._of_columns(x)[:, :, 0], inertia)
            turned = of_columns.solve(Vec3(*unstack(side, 2)))
            parts = [
                unstack(jnp.broadcast_to(x, (turns, rows, columns, worlds)), 1)
                for x in compute_once(turned, self.packed)
            ]
            response.append([list(row) for row in zip(*parts, strict=True)])
        return jacobian, response

    def _respond(self, jacobian: Array, inertia: InverseInertia) -> Array:
        components = unstack(jacobian, -3)
        like = components[0].shape
        of_columns = jax.tree.map(lambda x: spread(self._of_columns(x)[..., 0, :, :], like), inertia)
        linear = [component * of_columns.inverse_mass for component in components[:3]]
        angular = of_columns.solve(Vec3(*components[3:])) if components[3:] else ()
        return jnp.stack([*linear, *angular], axis=-3)

    def _of_columns(self, values: Array) -> Array:
        """(..., 1, 1, column, world) from (..., constraint, world)."""
        together = self.packed.shape[-2] // values.shape[-2]
        return jnp.repeat(values, together, axis=-2)[..., None, None, :, :]


@pytree
class Picked:
    """Rows whose Jacobian picks one component each of the only block, for the sweeps alone.

    Attributes:
      response: ``M^-1 J^T`` (..., row, component, column, world).
      first: (..., 1) int32 component of the first column of a turn; the others follow column by column, row by row.
      left_out: number of rows before the first and after the last of these.
    """

    response: Array
    first: Array
    left_out: tuple[int, int] = static(default=(0, 0))

    @property
    def like(self) -> Array:
        """Some array (..., row, column, world), for `store`."""
        return self.response[..., 0, :, :]

    def rates(self, velocities: Sequence[Array]) -> Array:
        """As `Dense.rates`, of one turn."""
        rows, _, columns, _ = self.response.shape
        before, after = self.left_out
        every = before + rows + after
        (velocity,) = velocities
        own = jax.lax.dynamic_slice_in_dim(velocity[:, 0], self.first[0], every * columns)
        return jnp.swapaxes(own.reshape(columns, every, -1)[:, before : before + rows], 0, 1)

    def changes(self, impulse: Array, together: int) -> list[Array]:
        """As `Dense.changes`."""
        return [_sum(self.response, impulse, together)]

    def changes_once(self, impulse: Array, together: int) -> list[Array]:
        """As `Dense.changes_once`."""
        return [store(_sum(self.response, impulse, together), self.response[0, :, ::together])]

    def first_row(self) -> Picked:
        """As `Dense.first_row`."""
        return Picked(_first(self.response), self.first, (0, self.response.shape[-4] - 1))

    def other_rows(self) -> Picked:
        """As `Dense.other_rows`."""
        return Picked(_others(self.response), self.first, (1, 0))

    def dense(self) -> Dense:
        """The same rows with all entries; turns, no single one."""
        _, rows, count, columns, _ = self.response.shape
        own = self.first[..., None] + np.arange(rows)[:, None] + rows * np.arange(columns)
        picks = own[:, :, None, :, None] == np.arange(count)[:, None, None]
        return Dense((jnp.where(picks, 1.0, 0.0).astype(self.response.dtype),), (self.response,))


@pytree
class FirstRow:
    """The first row of each constraint of other rows, taken out where it is used: a copy for all turns takes longer."""

    whole: RowMatrix

    @property
    def like(self) -> Array:
        """Some array (..., row, column, world), for `store`."""
        return self.whole.first_row().like

    def rates(self, velocities: Sequence[Array]) -> Array:
        """As `Dense.rates`."""
        return self.whole.first_row().rates(velocities)

    def changes(self, impulse: Array, together: int) -> list[Array]:
        """As `Dense.changes`."""
        return self.whole.first_row().changes(impulse, together)

    def linear_responses(self) -> list[tuple[Array, Array | float]]:
        """As `Dense.linear_responses`."""
        return self.whole.first_row().linear_responses()

    def first_row(self) -> FirstRow:
        return self

    def dense(self) -> Dense:
        """The same rows with all entries."""
        return self.whole.first_row().dense()


RowMatrix = Dense | Points | FirstRow


def _vectors(packed: Array, axis: int) -> list[Array]:
    """Triples of components."""
    axis %= packed.ndim
    return list(jax.lax.split(packed, (3,) * (packed.shape[axis] // 3), axis=axis))


def _entries(array: Array) -> list[list[Array]]:
    """Entries (turn, column, world) of an array by row and component; of a slice of a slice XLA would make a kernel."""
    turns, rows, components, *rest = array.shape
    entries = unstack(array.reshape(turns, rows * components, *rest), 1)
    return [entries[components * row : components * (row + 1)] for row in range(rows)]


def _first(rows: Array) -> Array:
    return rows[..., :1, :, :, :]


def _others(rows: Array) -> Array:
    return rows[..., 1:, :, :, :]


def _along(rows: Array, velocity: Array) -> Array:
    """(..., row, column, world) from (..., row, component, column, world) and (..., component, constraint, world)."""
    found = _by_constraint(rows, velocity.shape[-2])
    total = add_slices(found * spread(velocity[..., None, :, :, None, :], found.shape), -4)
    return total.reshape(*rows.shape[:-3], rows.shape[-2], total.shape[-1])


def _sum(rows: Array, impulse: Array, together: int) -> Array:
    """(component, constraint, world) sum of (row, component, column, world) times the impulses (row, column, world)."""
    constraints = rows.shape[-2] // together
    found, pushed = _by_constraint(rows, constraints), _by_constraint(impulse, constraints)
    return add_slices(add_slices(found * spread(pushed[..., None, :, :, :], found.shape), -5), -2)


def _by_constraint(values: Array, constraints: int) -> Array:
    """(..., constraint, column of it, world) from (..., column, world).

    Products are taken in this shape: where a kernel has to find the constraint of a column, it is not vectorised.
    """
    return values.reshape(*values.shape[:-2], constraints, -1, values.shape[-1])


def sum_over_points(values: Array, together: int) -> Array:
    """(component, constraint, world) from (component, column, world)."""
    return add_slices(_by_constraint(values, values.shape[-2] // together), -2)
