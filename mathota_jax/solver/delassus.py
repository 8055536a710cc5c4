"""``J M^-1 J^T`` of rows that are solved together (the Delassus operator), in the form that is the least to read.

Many rows on a mechanism of few ways to move have a matrix of low rank: it is kept as a product over these coordinates, and
the sweeps act on generalized impulses. Of few rows the matrix itself is smaller; the sweeps act on their rates.
(P. C. Delassus, "Memoire sur la theorie des liaisons finies unilaterales", 1917.)
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.solver.row_matrix import Dense, Picked
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.spread import FEW_SLICES, add_scaled, add_slices, diagonal, spread
from mathota_jax.struct import pytree

ROWS_AT_A_TIME = 16
"""Of the rows whose impulses are added up."""


@pytree
class Whole:
    """Any rows.

    Attributes:
      matrix: (row, row, world) what a unit impulse of the second does to the rate of the first.
    """

    matrix: Array

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.matrix)

    @property
    def size(self) -> int:
        """Components of what the sweeps act on."""
        return len(self.matrix)

    def times(self, impulses: Array, rows: np.ndarray | None = None) -> Array:
        """Changes of all rates (row, world) by impulses (row, world) of all rows, or of some."""
        return add_scaled(self.matrix if rows is None else take(self.matrix, rows, axis=1), impulses)

    def part(self, rows: np.ndarray, columns: np.ndarray) -> Array:
        """Some rows and columns (row, row, world)."""
        return take(take(self.matrix, rows), columns, axis=1)

    def diagonal(self, count: int) -> Array:
        """(row, world) of the first rows."""
        return diagonal(self.matrix[:count, :count])

    def blocks(self, first: int, count: int, size: int) -> Array:
        """(block, row, row, world) on the diagonal, from a first row on."""
        starts = [first + size * block for block in range(count)]
        return jnp.stack([self.matrix[start : start + size, start : start + size] for start in starts])

    def chosen(self, rows: np.ndarray) -> Whole:
        """That of some rows alone."""
        return Whole(self.part(rows, rows))

    def whole(self) -> Array:
        """(row, row, world)."""
        return self.matrix

    def without(self, soft: np.ndarray, left: np.ndarray, given_way: Array) -> Whole:
        """That of the rows `left` where others give way by `given_way` (soft, left, world) times their impulses."""
        across = self.part(left, soft)

        def eliminate(kept: Array, row: tuple[Array, Array]) -> tuple[Array, None]:
            column, answer = row
            return kept - column[:, None] * answer, None

        return Whole(lax.scan(eliminate, self.part(left, left), (jnp.swapaxes(across, 0, 1), given_way))[0])

    def turns(self, first: int, turns: int, points: int, rows: int) -> Picked:
        """As the sweeps see the rows that start at `first`, in the order turn, point, row."""
        chosen = self.matrix[:, first : first + turns * points * rows]
        by_turn = chosen.reshape(self.count, turns, points, rows, -1).transpose(1, 3, 0, 2, 4)
        starts = first + rows * points * np.arange(turns, dtype=np.int32)[:, None]
        return Picked(by_turn, jnp.asarray(starts))


@pytree
class Factored:
    """Rows whose matrix is the product of two of (row, coordinate, world).

    Attributes:
      rates: of the rows under unit generalized impulses.
      forces: generalized impulses that are unit impulses of the rows.
    """

    rates: Array
    forces: Array

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.rates)

    @property
    def size(self) -> int:
        """Components of what the sweeps act on."""
        return self.rates.shape[1]

    def times(self, impulses: Array, rows: np.ndarray | None = None) -> Array:
        """As of `Whole`."""
        forces = self.forces if rows is None else take(self.forces, rows)
        return add_scaled(self.rates, _sum_of_scaled(forces, impulses))

    def part(self, rows: np.ndarray, columns: np.ndarray) -> Array:
        """As of `Whole`."""
        return _products(take(self.rates, rows)[None], take(self.forces, columns)[None])[0]

    def diagonal(self, count: int) -> Array:
        """As of `Whole`."""
        terms = self.rates[:count] * self.forces[:count]
        return add_slices(terms, -2) if self.size <= FEW_SLICES else terms.sum(-2)

    def blocks(self, first: int, count: int, size: int) -> Array:
        """As of `Whole`."""
        rates, forces = (
            values[first : first + count * size].reshape(count, size, *values.shape[1:])
            for values in (self.rates, self.forces)
        )
        return _products(rates, forces)

    def chosen(self, rows: np.ndarray) -> Factored:
        """As of `Whole`."""
        return Factored(take(self.rates, rows), take(self.forces, rows))

    def whole(self) -> Array:
        """As of `Whole`."""
        return _products(self.rates[None], self.forces[None])[0]

    def without(self, soft: np.ndarray, left: np.ndarray, given_way: Array) -> Factored:
        """As of `Whole`."""

        def give_way(forces: Array, row: tuple[Array, Array]) -> tuple[Array, None]:
            force, answer = row
            return forces - answer[:, None] * force, None

        forces = lax.scan(give_way, take(self.forces, left), (take(self.forces, soft), given_way))[0]
        return Factored(take(self.rates, left), forces)

    def turns(self, first: int, turns: int, points: int, rows: int) -> Dense:
        """As of `Whole`."""

        def by_turn(values: Array) -> Array:
            chosen = values[first : first + turns * points * rows]
            return chosen.reshape(turns, points, rows, self.size, -1).transpose(0, 2, 3, 1, 4)

        return Dense((by_turn(self.rates),), (by_turn(self.forces),))


Delassus = Whole | Factored


def _sum_of_scaled(values: Array, factors: Array) -> Array:
    """(coordinate, world) sum of (row, coordinate, world) times factors (row, world), some rows at a time."""
    count = len(values)
    steps = -(-count // ROWS_AT_A_TIME)
    values, factors = (
        jnp.pad(x, [(0, steps * ROWS_AT_A_TIME - count), *[(0, 0)] * (x.ndim - 1)]).reshape(steps, -1, *x.shape[1:])
        for x in (values, factors)
    )

    def add(total: Array, of_rows: tuple[Array, Array]) -> tuple[Array, None]:
        mine, theirs = of_rows
        return total + add_slices(mine * spread(theirs[:, None], mine.shape), 0), None

    worlds = max(values.shape[-1], factors.shape[-1])
    return lax.scan(add, jnp.zeros((values.shape[2], worlds), values.dtype), (values, factors))[0]


def _products(left: Array, right: Array) -> Array:
    """(block, row, row, world) inner products of the rows of two of (block, row, coordinate, world).

    One coordinate after the other: a sum of products would be stored term by term.
    """

    def add(total: Array, of_coordinate: tuple[Array, Array]) -> tuple[Array, None]:
        mine, theirs = of_coordinate
        return total + mine[:, :, None] * theirs[:, None], None

    nothing = jnp.zeros((*left.shape[:2], right.shape[1], left.shape[-1]), left.dtype)
    return lax.scan(add, nothing, (jnp.moveaxis(left, 2, 0), jnp.moveaxis(right, 2, 0)))[0]
