"""Rows of a joint that do not feel one another.

One row after the other, what a stop or the second row of a hinge does undoes a share of what the first did: a rod that falls
on its stop keeps three quarters of the error after each sweep. Rows that hold may be combined at will, and a row with bounds
may have any of them added, since its impulse, and so its bounds, stay its own. So every row is freed of the rows that hold
before it: ``J_k - sum_j c_kj J_j`` with ``J_k M^-1 J_j^T = 0`` (Gram and Schmidt). One sweep then solves a joint that stands
alone, and what is left couples different joints.

The impulses of the original rows, from which a state gives reaction forces, follow by the transposed elimination.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.constraints.assembly import Side
from mathota_jax.constraints.effective_mass import step_length
from mathota_jax.constraints.joint_layout import joint_groups, solves_together
from mathota_jax.constraints.mechanism_layout import held_slots, layout, takes_small_steps
from mathota_jax.scene import Scene
from mathota_jax.solver.table import EMPTY, Table
from mathota_jax.spatial.indexing import in_every_world, take, unstack
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.spread import add_slices, for_each, spread
from mathota_jax.struct import pytree, static


def applies(scene: Scene) -> bool:
    """Whether rows are decoupled: not where the step solves mechanisms exactly, or where no row is swept by itself."""
    return not solves_together(scene) and (layout(scene) is None or takes_small_steps(scene))


@pytree
class Decoupling:
    """Of the rows of one table.

    Attributes:
      matrix: (row, row, joint, world) new rows from old ones.
      shares: for each row that holds, the shares (row, joint, world) of it that were taken from the others.
      mass: (turn * column, world) ``J M^-1 J^T`` of the new rows.
      layout: where the rows are.
    """

    matrix: Array
    shares: tuple[Array, ...]
    mass: Array
    layout: RowLayout = static()

    def rows(self, values: Array) -> Array:
        """New values (turn * column, world) of quantities that are linear in the rows."""
        by_joint = self.layout.by_joint(values)
        return self.layout.by_place(add_slices(self.matrix * for_each(len(by_joint), by_joint), 1))

    def sides(self, sides: Sequence[Side]) -> list[Side]:
        """New Jacobians or responses, components (turn * column, world)."""
        leaves, structure = jax.tree.flatten(list(sides))
        old = self.layout.stacked(leaves)
        # All components in one kernel.
        shape = (len(old), *self.matrix.shape)
        new = add_slices(spread(self.matrix[None], shape) * spread(old[:, None], shape), 2)
        return jax.tree.unflatten(
            structure, [self.layout.by_place(part) for part in unstack(compute_once(new, new), 0)]
        )

    def impulses(self, values: Array) -> Array:
        """Impulses (turn * column, world) of the new rows from those of the old ones."""
        by_joint = self._in_worlds(self.layout.by_joint(values))
        for row, share in zip(self.layout.pivots, self.shares, strict=True):
            by_joint = by_joint.at[row].add(add_slices(share * by_joint, 0))
        return self.layout.by_place(by_joint)

    def original_impulses(self, values: Array) -> Array:
        """The other way round."""
        by_joint = self._in_worlds(self.layout.by_joint(values))
        for row, share in reversed(list(zip(self.layout.pivots, self.shares, strict=True))):
            by_joint = by_joint.at[row].add(-add_slices(share * by_joint, 0))
        return self.layout.by_place(by_joint)

    def _in_worlds(self, values: Array) -> Array:
        """In as many worlds as the shares: impulses that all share differ once they are those of the new rows."""
        return in_every_world(values, max(values.shape[-1], self.matrix.shape[-1]))


@dataclasses.dataclass(frozen=True)
class RowLayout:
    """Which places of a table hold the rows of which joint.

    Attributes:
      slots: of the rows of each joint.
      holds: whether each of them holds.
      table: that has them.
    """

    slots: tuple[tuple[int, ...], ...]
    holds: tuple[tuple[bool, ...], ...]
    table: Table

    @functools.cached_property
    def shape(self) -> tuple[int, int]:
        """Number of rows of a joint, at most, and of joints."""
        return max(len(rows) for rows in self.slots), len(self.slots)

    @functools.cached_property
    def pivots(self) -> tuple[int, ...]:
        """Rows that hold in some joint."""
        return tuple(row for row in range(self.shape[0]) if self.holding[row].any())

    @functools.cached_property
    def holding(self) -> np.ndarray:
        """(row, joint) whether each exists and holds."""
        count = self.shape[0]
        return np.array([[*rows, *[False] * (count - len(rows))] for rows in self.holds]).T

    @functools.cached_property
    def places(self) -> np.ndarray:
        """(row, joint) place in the order of the table, one past the end for rows that a joint does not have."""
        place = {int(slot): k for k, slot in enumerate(self.table.order) if slot != EMPTY}
        count, none = self.shape[0], len(self.table.order)
        return np.array([[*(place[slot] for slot in rows), *[none] * (count - len(rows))] for rows in self.slots]).T

    def by_joint(self, values: Array) -> Array:
        """(row, joint, world) from (turn * column, world), 0 for rows that a joint does not have."""
        if (self.places == len(self.table.order)).any():
            values = jnp.concatenate([values, jnp.zeros_like(values[:1])])
        return take(values, self.places.reshape(-1)).reshape(*self.shape, values.shape[-1])

    def stacked(self, values: Sequence[Array]) -> Array:
        """(value, row, joint, world) from several."""
        parts = [self.by_joint(part) for part in values]
        worlds = max(part.shape[-1] for part in parts)
        return jnp.stack([jnp.broadcast_to(part, (*part.shape[:-1], worlds)) for part in parts])

    def by_place(self, values: Array) -> Array:
        """The other way round; any value for padding."""
        back = np.zeros(len(self.table.order) + 1, np.int32)
        back[self.places.reshape(-1)] = np.arange(self.places.size)
        return take(values.reshape(-1, values.shape[-1]), back[:-1])


@functools.cache
def row_layout(scene: Scene, table: Table) -> RowLayout:
    """The joints of a table."""
    inside = set(table.order.tolist())
    slots, holds = [], []
    for group in joint_groups(scene):
        for place in range(len(group.joints)):
            rows = tuple(group.slots(row).start + place for row in range(group.row_count))
            if rows and rows[0] in inside:
                held = {slot for part in held_slots(group, place) for slot in part}
                slots.append(rows)
                holds.append(tuple(slot in held for slot in rows))
    return RowLayout(tuple(slots), tuple(holds), table)


def decouple(scene: Scene, table: Table, jacobians: Sequence[Side], responses: Sequence[Side]) -> Decoupling:
    """How the rows of a table become independent.

    Args:
      scene: static scene.
      table: of joint rows.
      jacobians, responses: of each side, components (turn * column, world).
    """
    found = row_layout(scene, table)
    count, holding = found.shape[0], found.holding
    index = np.arange(count)[:, None]
    jacobian, response = (
        step_length(scene, found.stacked(jax.tree.leaves(list(sides)))) for sides in (jacobians, responses)
    )
    pairs = (len(jacobian), count, *jacobian.shape[1:])
    products = add_slices(spread(jacobian[:, :, None], pairs) * spread(response[:, None], pairs), 0)
    identity = jnp.broadcast_to(jnp.eye(count, dtype=products.dtype)[:, :, None, None], products.shape)
    # What is done to the products is done to the rows beside them.
    both = compute_once(jnp.concatenate([products, identity], axis=1), products)
    shares = []
    for row in found.pivots:
        own = jnp.where(holding[row][:, None], both[row, row], 1.0)
        taken = holding[row] & (index != row) & ((index > row) | ~holding)
        share = safe_divide(both[:, row], for_each(count, own))
        share = compute_once(jnp.where(taken[:, :, None], share, 0.0), own)
        both = compute_once(both - spread(share[:, None], both.shape) * for_each(count, both[row]), own)
        shares.append(share)
    mass = found.by_place(jnp.stack([both[row, row] for row in range(count)]))
    return Decoupling(both[:, count:], tuple(shares), mass, found)
