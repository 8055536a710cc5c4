"""How long the velocity change of a step has acted on the position of each body."""

from __future__ import annotations

import collections
import functools
from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.constraints import mechanism
from mathota_jax.constraints.contact import ContactRows
from mathota_jax.constraints.mechanism_layout import layout
from mathota_jax.scene import Scene
from mathota_jax.solver.row_matrix import Dense, RowMatrix, sum_over_points
from mathota_jax.solver.rows import Rows, add_changes
from mathota_jax.spatial.indexing import unstack
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import compute_once, store
from mathota_jax.spatial.spread import add_slices, spread
from mathota_jax.spatial.vector import Vec3, dot
from mathota_jax.struct import pytree

LOADED = 4.0
"""Impulse of a contact, over that of its rebound alone, from which it counts as carrying others. (The mass of a contact is
bounded for the points of a manifold pushing together; a point that pushes alone takes more of it.)"""


@functools.cache
def _several_pairs(scene: Scene) -> bool:
    """Whether some body may touch more than one other shape."""
    if scene.broadphase is not None:
        return True
    pairs = collections.Counter(
        body for group in scene.pair_groups for side in (group.bodies_a, group.bodies_b) for body in side
    )
    return any(pairs[body] > 1 for body in scene.dynamic_bodies)


def levers(
    scene: Scene,
    dt: Array,
    joint_rows: Sequence[Rows],
    contact_rows: Sequence[ContactRows],
    impulses: Sequence[Array],
    free: Array,
    solved: Array,
    with_joints: Array | None = None,
) -> tuple[Array, Array | None]:
    """Time that the velocity change by the constraints had to act on the position of each body.

    A joint holds for the whole step (on average dt/2), a contact as long as it lasts. A body takes the mean of its rows,
    weighted by their impulses. Where it may touch several others, it also moves by what each impulse does beyond that mean
    with its own lever, as far as the impulses do not cancel: a ball that flies into a corner leaves each wall at its own
    time, but the large opposite impulses on a light body below a heavy one do not throw it out. Rotation keeps to the mean.

    What contacts change of a mechanism, with what stops and motors do about it, lasts as long as the contacts: a foot would
    else stop when it meets the ground, and what it carries at half of the step. All of it takes the mean of its contacts.

    Args:
      scene: static scene.
      dt: time step.
      joint_rows, contact_rows: all groups.
      impulses: solved, those of the joints first, for each group (turn, row, column, world).
      free, solved: (component, block, world) velocities without and with them.
      with_joints: velocities where mechanisms hold and nothing else does; None without mechanisms.

    Returns:
      The mean lever (block, world), and the displacement (component, block, world) beyond it; None where nothing is.
    """
    half = 0.5 * dt
    if not contact_rows:
        return half * jnp.ones_like(solved[0]), None
    several = _several_pairs(scene)
    count = len(joint_rows)
    contact_rows = [_under_load(group, part) for group, part in zip(contact_rows, impulses[count:], strict=True)]
    total = jnp.zeros((6 if several else 2, *solved.shape[1:]), solved.dtype)
    for group, impulse in zip(contact_rows, impulses[count:], strict=True):
        if several:
            # Relative to half the step, contacts at rest add nothing at all.
            movement = _Movement(group.rows.matrix, group.lever, group.lever - half)
            total = add_changes(group.rows, movement, total, impulse)
        else:
            lever = group.lever[:, :, None]
            share = _weighted(jnp.ones_like(lever), lever)
            parts = (share,) * len(group.rows.jacobian)
            total = add_changes(group.rows, Dense((), parts), total, impulse[:, :1])
    of_contacts = total[:2]
    for group, impulse in zip(joint_rows, impulses[:count], strict=True):
        # The linear part of the Jacobian makes a weight [N s] of the impulse, 0 for a row that only turns.
        weights = [safe_sqrt(_square(side[:, :, :3])) for side in group.jacobian]
        parts = [_weighted(weight, half) for weight in weights]
        size = jnp.abs(impulse)
        if several:
            parts = [_with_movement(part, side, size, 0.0) for part, side in zip(parts, group.response, strict=True)]
        total = add_changes(group, Dense((), tuple(parts)), total, size)
    mean = jnp.where(total[0] > 0, safe_divide(total[1], total[0]), half)
    beyond = None
    if several:
        moved = _beyond(total[2:], mean - half, solved - free)
        beyond = jnp.concatenate([jnp.stack(moved), jnp.zeros_like(solved[3:])])
    if with_joints is None:
        return mean, beyond
    found = layout(scene)
    assert found is not None
    weight, moment = unstack(mechanism.sum_by_mechanism(found, of_contacts), 0)
    of_mechanism = jnp.where(weight > 0, safe_divide(moment, weight), half)
    more = (solved - with_joints) * (of_mechanism - half)
    beyond = jnp.where(found.is_link[:, None], more, 0.0 if beyond is None else beyond)
    return jnp.where(found.is_link[:, None], half, mean), beyond


def _under_load(group: ContactRows, impulse: Array) -> ContactRows:
    """The contacts with the levers that rebounds have where they carry others."""
    if group.load is None:
        return group
    alone, found = LOADED * group.load.alone, impulse[:, :1]
    share = jnp.where((alone > 0) & (found > alone), safe_divide(alone, found), 1.0)
    # Which of the two it is has no derivative.
    share = store(lax.stop_gradient(share), found)
    return group._replace(lever=group.load.lever + (group.lever - group.load.lever) * share)


def _beyond(total: Array, mean: Array, change: Array) -> Vec3:
    """What impulses with levers of their own move bodies more than with the mean one; levers relative to half the step.

    The share that is taken rises smoothly from 0 where the velocity changes cancel to 1 where they are at right angles,
    which is where each impulse is that of its own impact; at a smaller angle they are parts of the same.
    """
    squares, *moved = unstack(total, 0)
    velocity = Vec3(*unstack(change[:3], 0))
    kept = jnp.minimum(safe_divide(dot(velocity, velocity), squares), 1.0)
    return (Vec3(*moved) - velocity * mean) * (kept * kept * (3.0 - 2.0 * kept))


def _with_movement(share: Array, response: Array, impulse: Array, lever: Array | float) -> Array:
    """Appends what makes, times the same impulse, its squared change of the velocity, and the change times the lever."""
    linear = response[:, :, :3]
    squared = _square(linear) * impulse[:, :, None]
    return jnp.concatenate([share, squared, linear * lever], axis=2)


def _square(linear: Array) -> Array:
    return add_slices(linear * linear, 2)[:, :, None]


@pytree
class _Movement:
    """What the impulses of contacts add to the sums behind the levers of their bodies, in the order of `_with_movement`.

    Attributes:
      matrix: of the contacts.
      lever: (turn, 1, column, world) of each contact.
      beyond: the same beyond half the step.
    """

    matrix: RowMatrix
    lever: Array
    beyond: Array

    def changes(self, impulse: Array, together: int) -> list[Array]:
        weight, found = impulse[:1], []
        lever, beyond = (store(x, x) for x in (self.lever, self.beyond))
        displaced = impulse * spread(beyond, impulse.shape)
        weights = sum_over_points(jnp.concatenate([weight, weight * lever]), together)
        for side, factor in self.matrix.linear_responses():
            squared = add_slices(add_slices(side * side, 1) * (impulse * impulse), 0)[None]
            moved = add_slices(side * spread(displaced[:, None], side.shape), 0)
            # Of two sides with one direction computed once for both.
            sums = compute_once([sum_over_points(x, together) for x in (squared, moved)], squared)
            factors = spread(factor[None], sums[1].shape) if isinstance(factor, Array) else factor
            found.append(jnp.concatenate([weights, sums[0] * (factor * factor), sums[1] * factors]))
        return found


def _weighted(weight: Array, lever: Array) -> Array:
    """(turn, row, 2, column, world): what a unit of impulse adds to the sum of the weights, and of weight times lever."""
    return jnp.concatenate([weight, weight * lever], axis=2)
