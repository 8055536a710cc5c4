"""Scalar rows with bounds on a small dense matrix: sweeps, and the derivative at their solution.

At the solution a row is either free, and its law is linear, or at a bound, and follows it. With free rows f and others c,
``A_ff dp_f = -(d error + dA p + A_fc dp_c)_f``: one symmetric system, whatever the number of sweeps was, and nothing of the
sweeps is stored. Free rows that say the same, such as friction that holds and a stop that is pressed, make it singular:
the first of them is taken to answer.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.solver.laws import Bounded
from mathota_jax.spatial.indexing import in_every_world
from mathota_jax.spatial.settle import compute_once, settle
from mathota_jax.spatial.spread import add_scaled, diagonal

REDUNDANT = 64
"""Multiples of the machine epsilon: what the rows before leave of the motion along a row that says the same, of its own."""


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def solve(sweeps: int, matrix: Array, law: Bounded, error: Array, old: Array, start: Array) -> Array:
    """Impulses (row, world) after projected Gauss-Seidel sweeps.

    Args:
      sweeps: over all rows.
      matrix: (row, row, world) what a unit impulse of the second does to the rate of the first; symmetric.
      law: of the rows (row, world).
      error: (row, world) with the impulses `old`.
      old: (row, world).
      start: (row, world) where the sweeps start; without derivative.
    """
    worlds = max(x.shape[-1] for x in (matrix, error, old, start, *jax.tree.leaves(law)))
    law, error, old, start = in_every_world((law, error, old, start), worlds)

    def turn(carry: tuple[Array, Array], row: tuple) -> tuple[tuple[Array, Array], None]:
        impulse, error = carry
        place, column, law = row
        new = law.update(impulse[place], error[place])
        return (impulse.at[place].set(new), error + column * (new - impulse[place])), None

    def sweep(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        return lax.scan(turn, carry, (jnp.arange(len(matrix)), jnp.swapaxes(matrix, 0, 1), law))

    error = error + add_scaled(matrix, start - old)
    return lax.scan(sweep, (start, error), None, length=sweeps)[0][0]


@solve.defjvp
def _solve_jvp(sweeps: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    matrix, law, error, old, start = primals
    d_matrix, d_law, d_error, d_old, _ = tangents
    new = solve(sweeps, matrix, law, error, old, start)
    change = new - old
    wanted = law.free(new, error + add_scaled(matrix, change))
    works = law.effective_mass > 0
    free = settle(jnp.where(works & (wanted > law.lower) & (wanted < law.upper), 1.0, 0.0).astype(new.dtype))
    at_bound = jnp.where(works, jnp.where(wanted >= law.upper, d_law.upper, d_law.lower), 0.0) * (1.0 - free)
    inverse = compute_once(_inverse_of_free(matrix, law.softness, free), new)
    rate = d_error + add_scaled(d_matrix, change) + add_scaled(matrix, at_bound - d_old) + d_law.softness * new
    return new, at_bound - add_scaled(inverse, rate)


def _inverse_of_free(matrix: Array, softness: Array, free: Array) -> Array:
    """Inverse (row, row, world) of the free rows of a matrix with their softness, 0 for all others.

    By sweeps of J. H. Goodnight, "A tutorial on the SWEEP operator", 1979, which leave out what is redundant.
    """
    numbers = jnp.arange(len(matrix))
    matrix = matrix + jnp.where((numbers[:, None] == numbers)[..., None], softness, 0.0)
    least = REDUNDANT * jnp.finfo(matrix.dtype).eps * diagonal(matrix)

    def sweep(carry: tuple[Array, Array], row: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], None]:
        matrix, used = carry
        place, free, least = row
        column = matrix[place]
        pivot = column[place]
        works = settle(jnp.where((free > 0.5) & (pivot > least), 1.0, 0.0).astype(pivot.dtype)) > 0.5
        scaled = column / jnp.where(works, pivot, 1.0)
        at = numbers == place
        swept = matrix - column[:, None] * scaled
        swept = jnp.where((at[:, None] | at)[..., None], jnp.where(at[:, None, None], scaled, scaled[:, None]), swept)
        swept = swept.at[place, place].set(-1.0 / jnp.where(works, pivot, 1.0))
        return (jnp.where(works, swept, matrix), used.at[place].set(jnp.where(works, 1.0, 0.0))), None

    start = in_every_world((matrix, jnp.zeros_like(free)), max(matrix.shape[-1], free.shape[-1]))
    (swept, used), _ = lax.scan(sweep, start, (numbers, free, least))
    return -swept * used * used[:, None]
