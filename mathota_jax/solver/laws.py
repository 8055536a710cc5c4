"""What an impulse may be: the projections of the projected Gauss-Seidel method, one block of rows at a time.

A law maps the accumulated impulse of a block and the constraint error that it sees to the new accumulated impulse. Its
fixed points are the solutions of the block, whatever the effective masses, which are given without derivatives. Arrays
are (row, column, world) or, for a whole table, (turn, row, ...).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array

from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import store
from mathota_jax.struct import pytree


@pytree
class Bounded:
    """Scalar rows ``lower <= impulse <= upper`` with optional softness (guide 9.2).

    Attributes:
      effective_mass: 1 / (J M^-1 J^T + softness), one row.
      softness: compliance [1/effective mass]: the row strives for ``J v + bias + softness * impulse = 0``.
      lower, upper: bounds of the accumulated impulse.
    """

    effective_mass: Array
    softness: Array
    lower: Array
    upper: Array

    def starting(self, impulse: Array) -> Bounded:
        """The same law, whatever the sweeps start from."""
        return self

    def relaxed(self, factor: Array) -> Bounded:
        """The same law, whatever the factor: joints that overshoot were measured to feed a swinging arm with energy."""
        return self

    def update(self, impulse: Array, error: Array) -> Array:
        """New accumulated impulse, clamped as a whole (not its increment: guide 8.4 errs there)."""
        return self.project(self.free(impulse, error))

    def free(self, impulse: Array, error: Array) -> Array:
        """New accumulated impulse if there were no bounds."""
        return impulse - (error + self.softness * impulse) * self.effective_mass

    def change(self, impulse: Array, error: Array) -> Array:
        """`update` less the old impulse, to the last digit of a small change of a large impulse."""
        free = -(error + self.softness * impulse) * self.effective_mass
        return jnp.clip(free, self.lower - impulse, self.upper - impulse)

    def project(self, impulse: Array) -> Array:
        """The nearest impulse that the law allows."""
        return jnp.clip(impulse, self.lower, self.upper)


@pytree
class Push(Bounded):
    """Contact without friction."""

    def relaxed(self, factor: Array) -> Push:
        """The same law with longer steps, which do not move its fixed point; `factor` (column, world)."""
        return dataclasses.replace(self, effective_mass=self.effective_mass * factor)


@pytree
class Cone:
    """Contact with isotropic Coulomb friction: rows normal, first tangent, second tangent.

    The tangential step uses one scalar mass for both tangents, so that a sliding contact's fixed point opposes the
    sliding velocity exactly: friction is a disc, not a box.

    Attributes:
      normal_mass: effective mass of the normal row.
      tangent_mass: common effective mass of the tangent rows.
      friction: Coulomb coefficient.
      meets: 1 for points by which those masses are measured, 0 for those that get there in this step only if pushed.
      first_grip: factor on the tangential steps of contacts that start without an impulse; None for 1.
    """

    normal_mass: Array
    tangent_mass: Array
    friction: Array
    meets: Array
    first_grip: Array | None = None

    def starting(self, impulse: Array) -> Cone:
        """The same law for sweeps from given impulses (turn, row, column, world)."""
        if self.first_grip is None:
            return self
        longer = jnp.where(impulse[:, 0] > 0, 1.0, self.first_grip)
        return dataclasses.replace(self, tangent_mass=self.tangent_mass * longer, first_grip=None)

    def relaxed(self, factor: Array) -> Cone:
        """The same law with longer steps of the normal row, which do not move its fixed point; `factor` (column, world).

        The tangents keep theirs: friction that overshoots while its limit changes was measured to keep bodies creeping.
        """
        return dataclasses.replace(self, normal_mass=self.normal_mass * factor)

    def update(self, impulse: Array, error: Array) -> Array:
        """Normal row first, then the tangents with its new impulse, but with errors from before."""
        row = impulse.ndim - 3  # axis of the rows: 0 for one turn, 1 for a whole table
        old_n, *old = unstack(impulse, row)
        error_n, *errors = unstack(error, row)
        normal = self.push(old_n, error_n)
        return jnp.stack([normal, *self.hold(normal, old, errors)], axis=row)

    def change(self, impulse: Array, error: Array) -> Array:
        """`update` less the old impulse, to the last digit of a small change of a large impulse."""
        row = impulse.ndim - 3
        old_n, old_1, old_2 = unstack(impulse, row)
        error_n, error_1, error_2 = unstack(error, row)
        normal = jnp.maximum(-error_n * self.normal_mass, -old_n)
        change_1, change_2 = -error_1 * self.tangent_mass, -error_2 * self.tangent_mass
        free_1, free_2 = old_1 + change_1, old_2 + change_2
        less = self._share(old_n + normal, free_1, free_2) - 1.0
        return jnp.stack([normal, change_1 + free_1 * less, change_2 + free_2 * less], axis=row)

    def project(self, impulse: Array) -> Array:
        """The impulse with the normal row not below 0 and the tangents within friction."""
        return self.update(impulse, jnp.zeros_like(impulse))

    def push(self, impulse: Array, error: Array) -> Array:
        """New impulse of the normal row."""
        return jnp.maximum(impulse - error * self.normal_mass, 0.0)

    def hold(self, normal: Array, old: Sequence[Array], errors: Sequence[Array]) -> list[Array]:
        """New impulses of the tangents for one of the normal row."""
        free_1, free_2 = (part - error * self.tangent_mass for part, error in zip(old, errors, strict=True))
        scale = store(self._share(normal, free_1, free_2), normal)  # both tangents read it
        return [free_1 * scale, free_2 * scale]

    def _share(self, normal: Array, free_1: Array, free_2: Array) -> Array:
        """What friction leaves of tangential impulses: 1 where it holds."""
        # Compared as velocities: the square of the impulse of a body of 0.1 mm underflows.
        inverse = safe_divide(jnp.ones_like(self.tangent_mass), self.tangent_mass)
        speed_1, speed_2, limit = free_1 * inverse, free_2 * inverse, self.friction * normal * inverse
        squared = speed_1 * speed_1 + speed_2 * speed_2
        # At the apex of the cone nothing sticks: a derivative must not see friction where nothing presses.
        sliding = squared >= limit * limit
        return jnp.where(sliding, safe_divide(limit, safe_sqrt(squared)), 1.0)


Law = Bounded | Cone
