"""Springs, dampers and servos of mechanisms: where sweeps over the rows with bounds should start.

A stiff spring holds almost as a joint does. Swept one after the other, a few of them on one arm leave more of an error than
they gain from the impulses of the last step: the arm shivers, and its servos feed it with energy. But what they exert is
linear in the rates, but for bounds. So they are first taken to have none, all together, and are eliminated: other rows are
swept against a mechanism that gives way as the springs let it. Where no bound is met, that solves all rows, and the sweeps
over all of them that follow change nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.constraints.joints.rows import ELASTIC, SERVO, VISCOUS
from mathota_jax.solver import dense
from mathota_jax.solver.delassus import Delassus
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


def closer_start(
    laws: np.ndarray,
    law: Bounded,
    delassus: Delassus,
    errors: Array,
    impulses: Array,
    sweep: Callable[[Elimination, Array], Array],
    left_to_do: Callable[[Array], Array],
) -> Array:
    """Impulses (row, world) from which to sweep over all rows, of arguments without derivative.

    They solve all rows, but where servos meet their caps one after the other, or where a stop takes up what a stiff spring
    would give: there the better of these and the old ones are taken.

    Args:
      laws: static names of the laws of the first rows, which are scalar; some are stiff.
      law: their coefficients (row, world).
      delassus: of all rows.
      errors: (row, world) rates without impulses, of scalar rows with their biases.
      impulses: (row, world) of the last step; what was at its bound is taken to stay there at first.
      sweep: gives the impulses of the rows that an elimination leaves, from some to start from.
      left_to_do: energy (world,) of what one more update of each row alone would change.
    """
    worlds = max(leaf.shape[-1] for leaf in jax.tree.leaves((delassus, errors, impulses, law)))
    law, delassus, errors, impulses = in_every_world((law, delassus, errors, impulses), worlds)

    def solve_all(before: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        found = _eliminate(laws, law, delassus, errors, before[0])
        others = take(impulses, found.left)
        return found.impulses(before[0], sweep(found, others) if len(found.left) else others), None

    # A servo that meets its bound does not carry what the others were told that it would.
    passes = 2 if SERVO in laws else 1
    new, solved = lax.scan(solve_all, (impulses, jnp.zeros_like(impulses[0])), None, length=passes)[0]
    left, left_before = left_to_do(new), left_to_do(impulses)
    return jnp.where(settle(jnp.where(left < left_before, 1.0, solved)) > 0.5, new, impulses)


class Elimination(NamedTuple):
    """Rows of which those of springs, dampers and servos are eliminated.

    Attributes:
      soft, left: static places of these rows, and of all others.
      delassus: of the others.
      errors: (row, world) of the others, without impulses of their own.
      alone: (row, world) impulses of the eliminated rows without the others.
      by_left: (row, row, world) what a unit impulse of one of the others (second) takes from them.
      free: (row, world) 0 for eliminated rows that stay at a bound, 1 for those that do not.
      bounds: (row, world) lower and upper ones of the eliminated rows.
    """

    soft: np.ndarray
    left: np.ndarray
    delassus: Delassus
    errors: Array
    alone: Array
    by_left: Array
    free: Array
    bounds: tuple[Array, Array]

    def impulses(self, old: Array, of_left: Array) -> tuple[Array, Array]:
        """All rows (row, world), from `old` ones and those of the rows that are left (row, world).

        Also where (world,) no bound is met that was not met before, so that these solve all rows.
        """
        pushes = self.alone - add_scaled(self.by_left, of_left) if len(self.left) else self.alone
        lower, upper = self.bounds
        met = settle(jnp.where((pushes < lower) | (pushes > upper), self.free, 0.0))
        pushes = jnp.where(self.free > 0.5, jnp.clip(pushes, lower, upper), take(old, self.soft))
        place = np.argsort(np.concatenate([self.soft, self.left]))
        return take(jnp.concatenate([pushes, of_left]), place), 1.0 - met.max(0)


def _eliminate(laws: np.ndarray, law: Bounded, delassus: Delassus, errors: Array, old: Array) -> Elimination:
    """Eliminates springs, dampers and servos; arguments as for `closer_start`, what is at its bound in `old` stays there."""
    linear = np.isin(laws, LINEAR)
    soft = np.flatnonzero(linear)
    left = np.concatenate([np.flatnonzero(~linear), np.arange(len(laws), delassus.count)])
    law, pushes = take((law, old), soft)
    bounds = law.lower, law.upper
    inside = (law.effective_mass > 0) & (pushes < law.upper) & (pushes > law.lower)
    free = settle(jnp.where(inside, 1.0, 0.0).astype(errors.dtype))
    errors = errors + delassus.times(pushes * (1.0 - free), soft)
    unit = jnp.eye(len(soft), dtype=errors.dtype)[..., None]
    system = delassus.part(soft, soft) * free * free[:, None] + unit * (law.softness * free + 1.0 - free)
    of_left = [delassus.part(soft, left)] if len(left) else []
    given = jnp.concatenate([*of_left, take(errors, soft)[:, None]], axis=1) * free[:, None]
    answers = dense.solve(system[None], given[None])[0]
    by_left, alone = answers[:, :-1], -answers[:, -1]
    if not len(left):
        return Elimination(soft, left, delassus, errors[:0], alone, by_left, free, bounds)
    kept = delassus.without(soft, left, by_left)
    return Elimination(soft, left, kept, take(errors + delassus.times(alone, soft), left), alone, by_left, free, bounds)
