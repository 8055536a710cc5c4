"""Springs, dampers and servos of mechanisms: where sweeps over the rows with bounds should start.

A stiff spring holds almost as a joint does. Swept one after the other, a few of them on one arm leave more of an error than
they gain from the impulses of the last step: the arm shivers, and its servos feed it with energy. But what they exert is
linear in the rates, but for bounds. So they are first taken to have none, all together, and are eliminated: other rows are
swept against a mechanism that gives way as the springs let it. Where no bound is met, that solves all rows, and the sweeps
over all of them that follow change nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.constraints.joints.rows import ELASTIC, SERVO, VISCOUS
from mathota_jax.solver import dense
from mathota_jax.solver.laws import Bounded
from mathota_jax.spatial.indexing import in_every_world, take
from mathota_jax.spatial.settle import settle
from mathota_jax.spatial.spread import add_scaled

LINEAR = (ELASTIC, SERVO, VISCOUS)
"""Laws whose impulse, but for bounds, is linear in the rate."""

STIFF = (ELASTIC, SERVO)
"""Those that may hold almost as a joint does: of others the sweeps make little."""


def are_stiff(laws: np.ndarray) -> bool:
    """Whether some of the rows may be; else sweeps do as well."""
    return bool(np.isin(laws, STIFF).any())


def are_better(solved: Array, left_by_new: Array, left_by_old: Array) -> Array:
    """Worlds to start from new impulses: where they solve all rows (1, else 0), or leave less to do than the old ones.

    They may not where servos meet their caps one after the other, or where a stop takes up what a stiff one would give.
    """
    return settle(jnp.where(left_by_new < left_by_old, 1.0, solved)) > 0.5


def passes(laws: np.ndarray) -> int:
    """How often to solve: a servo that meets its bound does not carry what the others were told that it would."""
    return 2 if SERVO in laws else 1


class Elimination(NamedTuple):
    """Rows of which those of springs, dampers and servos are eliminated.

    Attributes:
      soft, left: static places of these rows, and of all others.
      matrix: (row, row, world) what a unit impulse of the second of the others does to the rate of the first.
      errors: (row, world) of the others, without impulses of their own.
      alone: (row, world) impulses of the eliminated rows without the others.
      by_left: (row, row, world) what a unit impulse of one of the others (second) takes from them.
      free: (row, world) 0 for eliminated rows that stay at a bound, 1 for those that do not.
      law: of the rows that may be eliminated and those among the others that are scalar, in order.
    """

    soft: np.ndarray
    left: np.ndarray
    matrix: Array
    errors: Array
    alone: Array
    by_left: Array
    free: Array
    law: Bounded

    def impulses(self, old: Array, of_left: Array) -> tuple[Array, Array]:
        """All scalar rows (row, world), in order, from `old` ones and those of the rows that are left (row, world).

        Also where (world,) no bound is met that was not met before, so that these solve all rows.
        """
        pushes = self.alone - add_scaled(self.by_left, of_left) if len(self.left) else self.alone
        lower, upper = take((self.law.lower, self.law.upper), self.soft)
        met = settle(jnp.where((pushes < lower) | (pushes > upper), self.free, 0.0))
        pushes = jnp.where(self.free > 0.5, jnp.clip(pushes, lower, upper), take(old, self.soft))
        scalar = self.left[: len(old) - len(self.soft)]
        place = np.argsort(np.concatenate([self.soft, scalar]))
        return take(jnp.concatenate([pushes, of_left[: len(scalar)]]), place), 1.0 - met.max(0)


def eliminate(laws: np.ndarray, law: Bounded, matrix: Array, errors: Array, old: Array) -> Elimination:
    """Eliminates springs, dampers and servos, of which there are some.

    Args:
      laws: static names of the laws of the first rows, which are scalar.
      law: their coefficients (row, world).
      matrix: (row, row, world) of all rows.
      errors: (row, world) rates without impulses, of scalar rows with their biases.
      old: (row, world) impulses of the scalar rows so far; what is at its bound is taken to stay there.
    """
    worlds = max(leaf.shape[-1] for leaf in (matrix, errors, old, law.softness, law.effective_mass))
    law, matrix, errors, old = in_every_world((law, matrix, errors, old), worlds)
    linear = np.isin(laws, LINEAR)
    soft, left = np.flatnonzero(linear), np.concatenate([np.flatnonzero(~linear), np.arange(len(laws), len(matrix))])
    inside = (law.effective_mass > 0) & (old < law.upper) & (old > law.lower)
    free = take(settle(jnp.where(inside, 1.0, 0.0).astype(errors.dtype)), soft)
    rows = take(matrix, soft)
    errors = errors + add_scaled(take(matrix, soft, axis=1), take(old, soft) * (1.0 - free))
    unit = jnp.eye(len(soft), dtype=matrix.dtype)[..., None]
    system = take(rows, soft, axis=1) * free * free[:, None] + unit * (take(law.softness, soft) * free + 1.0 - free)
    given = jnp.concatenate([take(rows, left, axis=1), take(errors, soft)[:, None]], axis=1) * free[:, None]
    answers = dense.solve(system[None], given[None])[0]
    by_left, alone = answers[:, :-1], -answers[:, -1]
    if not len(left):
        return Elimination(soft, left, matrix[:0, :0], errors[:0], alone, by_left, free, law)
    across = take(take(matrix, left), soft, axis=1)

    def without(kept: Array, row: tuple[Array, Array]) -> tuple[Array, None]:
        column, answer = row
        return kept - column[:, None] * answer, None

    kept = lax.scan(without, take(take(matrix, left), left, axis=1), (jnp.swapaxes(across, 0, 1), by_left))[0]
    return Elimination(soft, left, kept, take(errors, left) + add_scaled(across, alone), alone, by_left, free, law)
