"""Impulses of the last step found again: contacts are the same where pair and feature are (guide 7.3 and 12.4).

Where features are not steady, a contact whose feature is gone and a new one of the same pair are the same if no other is
nearer to either and they are close, seen from the smaller body, so that one that rolls or slides keeps its contacts.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.bodies import Inertia, unpack_blocks
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.scene import CompactGroup, PairGroup, Scene
from mathota_jax.solver.rows import Rows, add_impulses
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.spread import add_all_slices
from mathota_jax.spatial.vector import Vec3, dot

NO_FEATURE = -1
"""`State.contact_feature` of a slot that was empty."""


class Marks(NamedTuple):
    """What contacts are known again by, (slot, world) or (pair, point, world): features, and offsets from the centre.

    Offsets are as in `State.contact_offset`; None where features alone tell.
    """

    feature: Array
    offset: Vec3 | None


def matches_by_distance(scene: Scene) -> bool:
    """Whether any pair of a scene does so."""
    options = scene.options
    groups = (*scene.pair_groups, *scene.compact_groups)
    return options.warm_start and options.warm_start_match > 0 and not all(is_steady(group) for group in groups)


def is_steady(group: PairGroup | CompactGroup) -> bool:
    """Whether features tell the contacts of a group apart."""
    return PAIRS[group.kind_a, group.kind_b].steady


def matched_force(scene: Scene, old: Marks, new: Marks, active: Array, force: Vec3) -> list[Vec3]:
    """Forces of the last step in the slots where their contacts are now; 0 for new ones (guide 7.3).

    A vector for each group of pairs that have slots of their own; arguments (slot, world).
    """
    parts, slot = [], 0
    for group in scene.pair_groups:
        rows = range(slot, slot + group.slot_count)
        shape = (len(group.bodies_a), group.point_count, -1)
        taken = take((old, new, active, force), rows)
        before, now, present, held = jax.tree.map(lambda x, shape=shape: x.reshape(shape), taken)
        parts.append(matched_points(before, now, present, held, scene.options.warm_start_match, is_steady(group)))
        slot += group.slot_count
    return parts


def matched_points(old: Marks, new: Marks, active: Array, force: Vec3, reach: float, steady: bool) -> Vec3:
    """Forces (pair * point, world) of the old points that are the new ones; arguments (pair, point, world)."""
    same = old.feature[:, None, :, :] == new.feature[:, :, None, :]
    same = same & active[:, :, None, :]
    if not steady and old.offset is not None and new.offset is not None:
        fresh, gone = active & ~same.any(2), (old.feature != NO_FEATURE) & ~same.any(1)
        same = same | _nearest(old.offset, new.offset, fresh[:, :, None] & gone[:, None], reach)

    def move(component: Array) -> Array:
        old = component[:, None, :, :]
        moved = jnp.where(same, old, 0.0)
        total = moved[:, :, 0]
        for point in range(1, moved.shape[2]):
            total = total + moved[:, :, point]
        return total.reshape(-1, total.shape[-1])

    return force.map(move)


def _nearest(old: Vec3, new: Vec3, possible: Array, reach: float) -> Array:
    """Which new point (pair, new, old, world) is where an old one was: within `reach`, and nearest from either side."""
    between = old.map(lambda x: x[:, None]) - new.map(lambda x: x[:, :, None])
    # Stored: all comparisons must see the same distances.
    squared = dot(between, between)
    squared = compute_once(jnp.where(possible, squared, jnp.finfo(squared.dtype).max), squared)
    by_old = jnp.argmin(squared, axis=1)[:, None] == jnp.arange(squared.shape[1])[:, None, None]
    by_new = jnp.argmin(squared, axis=2)[:, :, None] == jnp.arange(squared.shape[2])[:, None]
    return by_old & by_new & (squared <= reach**2)


def join_forces(parts: list[Vec3]) -> Vec3:
    """One vector in slot order."""
    if len(parts) == 1:
        return parts[0]
    return Vec3(*(jnp.concatenate(components) for components in zip(*parts, strict=True)))


def plausible(
    rows: tuple[Rows, ...], inertia: Inertia, velocity: Array, start: tuple[Array, ...]
) -> tuple[tuple[Array, ...], Array]:
    """Impulses to start from, shortened in a world that would be better off without them, and what they do to velocities.

    The impulses of an impact are not those of the next step. Where bodies of unequal mass touch, a few sweeps do not undo
    them, and from step to step they would grow. The solver minimises ``phi = b x + x A x / 2``, 0 without impulses: where
    the start lies above that, it is scaled to the least value along its direction.

    Args:
      rows: all groups.
      inertia: of the moving bodies.
      velocity: (component, block, world) without any constraint impulse.
      start: for each group (turn, row, column, world).
    """
    change = add_impulses(rows, jnp.zeros_like(velocity), start)
    (before, turning), (linear, angular) = unpack_blocks(velocity), unpack_blocks(change)
    momentum = linear * (1.0 / inertia.inverse_mass)
    slope, curvature = dot(before, momentum), dot(linear, momentum)
    if turning is not None and angular is not None:
        spin = inertia.apply(angular)
        slope, curvature = slope + dot(turning, spin), curvature + dot(angular, spin)
    slope, curvature = add_all_slices(slope), add_all_slices(curvature)
    for group, impulse in zip(rows, start, strict=True):
        slope = slope + add_all_slices(group.bias * impulse)
    # Stored: every impulse needs their sum over all bodies.
    slope, curvature = compute_once((slope, curvature), velocity)
    worse = slope + 0.5 * curvature > 0
    scale = jnp.where(worse, jnp.clip(safe_divide(-slope, curvature), 0.0, 1.0), 1.0)
    # The start does not move the solution.
    return lax.stop_gradient((tuple(impulse * scale for impulse in start), change * scale))
