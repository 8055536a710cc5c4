"""How the impulses that a law gives change with the impulses before and with the errors.

What the sweeps behind a derivative apply at every turn, forward and, for reverse mode, transposed: a few numbers a row
instead of the Jacobians. Arrays of changes are (row, column, world) or, for a whole table, (turn, row, ...).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.solver.laws import Bounded, Cone, Law
from mathota_jax.solver.rows import Rows, add_impulses, map_turns, row_velocity
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import compute_once
from mathota_jax.struct import pytree


@pytree
class BoundedSlopes:
    """Of scalar rows, each by itself.

    Attributes:
      by_impulse, by_error: as the impulses.
    """

    by_impulse: Array
    by_error: Array

    @property
    def masses(self) -> Array:
        """Effective mass of each row, (..., row, column, world); 0 where there is none."""
        return -self.by_error

    def update(self, impulse: Array, error: Array) -> Array:
        """Change of the new impulses by those of the impulses before and of the errors."""
        return self.by_impulse * impulse + self.by_error * error

    def transposed(self, new: Array) -> tuple[Array, Array]:
        """The transpose of `update`."""
        return self.by_impulse * new, self.by_error * new

    def resolve(self, change: Array, delta: float) -> Array:
        """The impulses x of which ``(1 + delta) x`` is their `update` without errors, plus a change."""
        return change / (1.0 + delta - self.by_impulse)

    def resolve_back(self, change: Array, delta: float) -> Array:
        """The transpose of `resolve`."""
        return self.resolve(change, delta)


@pytree
class ConeSlopes:
    """Of a contact with friction, (column, world) without a row.

    Attributes:
      pressing: 1 where the normal impulse is above its bound, 0 where it is not.
      normal_mass, tangent_mass: those of the law.
      grip: share that is left of a tangential change across the direction of sliding; 1 where the contact sticks.
      direction: two components of the tangential impulse over its size; 0 where the contact sticks.
      friction: the coefficient.
    """

    pressing: Array
    normal_mass: Array
    tangent_mass: Array
    grip: Array
    direction: tuple[Array, Array]
    friction: Array

    @property
    def masses(self) -> Array:
        """As `BoundedSlopes.masses`, of a whole table."""
        tangent = self.pressing * self.tangent_mass
        return self._stack(self.pressing * self.normal_mass, [tangent, tangent], 1)

    def update(self, impulse: Array, error: Array) -> Array:
        """As `BoundedSlopes.update`."""
        row = impulse.ndim - 3
        (normal, *tangents), (error_n, *errors) = unstack(impulse, row), unstack(error, row)
        normal = self.push(normal, error_n)
        return self._stack(normal, self.hold(normal, tangents, errors), row)

    def push(self, impulse: Array, error: Array) -> Array:
        """`update` of the normal row."""
        return self.pressing * (impulse - self.normal_mass * error)

    def hold(self, normal: Array, old: Sequence[Array], errors: Sequence[Array]) -> list[Array]:
        """`update` of the tangents for a new impulse of the normal row."""
        free = [part - self.tangent_mass * error for part, error in zip(old, errors, strict=True)]
        return self._held(free, self.friction * normal)

    def transposed(self, new: Array) -> tuple[Array, Array]:
        """As `BoundedSlopes.transposed`."""
        row = new.ndim - 3
        normal, *tangents = unstack(new, row)
        normal = self.push_back(normal, tangents)
        free = self.hold_back(tangents)
        by_error = self._stack(-self.normal_mass * normal, [-self.tangent_mass * part for part in free], row)
        return self._stack(normal, free, row), by_error

    def resolve(self, change: Array, delta: float) -> Array:
        """As `BoundedSlopes.resolve`."""
        row = change.ndim - 3
        normal, *tangents = unstack(change, row)
        normal = normal / (1.0 + delta - self.pressing)
        pushed = self.friction * self.pressing * normal
        tangents = [part + own * pushed for part, own in zip(tangents, self.direction, strict=True)]
        return self._stack(normal, self._resolved(tangents, delta), row)

    def resolve_back(self, change: Array, delta: float) -> Array:
        """As `BoundedSlopes.resolve_back`."""
        row = change.ndim - 3
        normal, *tangents = unstack(change, row)
        tangents = self._resolved(tangents, delta)
        normal = normal + self.friction * self.pressing * self._along(tangents)
        return self._stack(normal / (1.0 + delta - self.pressing), tangents, row)

    def _resolved(self, tangents: Sequence[Array], delta: float) -> list[Array]:
        """Across the direction of sliding and along it."""
        across, along = 1.0 / (1.0 + delta - self.grip), 1.0 / (1.0 + delta)
        more = (along - across) * self._along(tangents)
        return [across * part + own * more for part, own in zip(tangents, self.direction, strict=True)]

    def push_back(self, normal: Array, tangents: Sequence[Array]) -> Array:
        """The transpose of `update` for the impulse of the normal row."""
        return self.pressing * (normal + self.friction * self._along(tangents))

    def hold_back(self, tangents: Sequence[Array]) -> list[Array]:
        """The same for those of the tangents."""
        return self._held(tangents, 0.0)

    def _along(self, tangents: Sequence[Array]) -> Array:
        return self.direction[0] * tangents[0] + self.direction[1] * tangents[1]

    def _held(self, free: Sequence[Array], limit: Array | float) -> list[Array]:
        """What friction makes of tangential changes: across the direction of sliding a share, along it that of the limit."""
        along = limit - self.grip * self._along(free)
        return [self.grip * part + own * along for part, own in zip(free, self.direction, strict=True)]

    @staticmethod
    def _stack(normal: Array, tangents: Sequence[Array], row: int) -> Array:
        return jnp.stack([normal, *tangents], axis=row)


Slopes = BoundedSlopes | ConeSlopes


def left_unanswered(
    rows: tuple[Rows, ...],
    slopes: tuple[Slopes, ...],
    nothing: Array,
    impulses: tuple[Array, ...],
    once: Callable[[Array], Array] = lambda velocity: velocity,
) -> tuple[Array, ...]:
    """``x - K x - H J M^-1 J^T x``: changes x of the impulses, less what the laws make of them and of their velocities.

    `nothing` is the velocity without them, `once` what is done with that with them, for `compute_once`; left alone where
    the product has to be transposed.
    """
    velocity = once(add_impulses(rows, nothing, impulses))
    return tuple(
        part - slope.update(part, rates(group, velocity))
        for part, group, slope in zip(impulses, rows, slopes, strict=True)
    )


def rates(group: Rows, velocity: Array) -> Array:
    """``J v`` of the turns in use, (turn, row, column, world)."""
    return map_turns(lambda part, _: row_velocity(part, velocity), group, ())


def slopes_of(law: Law, impulse: Array, error: Array) -> Slopes:
    """Those of a law of a whole table at its fixed point, stored."""
    if isinstance(law, Bounded):
        free = law.free(impulse, error)
        inside = jax.jvp(law.project, (free,), (jnp.ones_like(free),))[1]
        softened = inside * law.effective_mass
        return compute_once(BoundedSlopes(inside - softened * law.softness, -softened), impulse)
    return compute_once(_of_cone(law, impulse, error), impulse)


def _of_cone(law: Cone, impulse: Array, error: Array) -> ConeSlopes:
    old, *tangents = unstack(impulse, 1)
    error_n, *errors = unstack(error, 1)
    free = old - error_n * law.normal_mass
    normal, pressing = jax.jvp(lambda x: jnp.maximum(x, 0.0), (free,), (jnp.ones_like(free),))
    free_1, free_2 = (part - slip * law.tangent_mass for part, slip in zip(tangents, errors, strict=True))
    inverse = safe_divide(jnp.ones_like(law.tangent_mass), law.tangent_mass)  # as velocities, see `Cone`
    free_1, free_2, limit = free_1 * inverse, free_2 * inverse, law.friction * normal * inverse
    squared = free_1 * free_1 + free_2 * free_2
    sliding, size = squared >= limit * limit, safe_sqrt(squared)
    direction = tuple(jnp.where(sliding, safe_divide(part, size), 0.0) for part in (free_1, free_2))
    return ConeSlopes(
        pressing=pressing,
        normal_mass=law.normal_mass,
        tangent_mass=law.tangent_mass,
        grip=jnp.where(sliding, safe_divide(limit, size), 1.0),
        direction=direction,  # type: ignore[arg-type]
        friction=law.friction,
    )
