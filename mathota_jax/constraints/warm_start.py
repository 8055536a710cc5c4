"""Impulses of the last step found again: contacts are the same where pair and feature are (guide 7.3 and 12.4)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.bodies import Inertia, unpack_blocks
from mathota_jax.collision.narrowphase import ContactSet
from mathota_jax.scene import Scene
from mathota_jax.solver.rows import Rows, add_impulses
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.spread import add_all_slices
from mathota_jax.spatial.vector import Vec3, dot


def matched_force(scene: Scene, contacts: ContactSet, force: Vec3, feature: Array) -> list[Vec3]:
    """Forces of the last step in the slots where their features are now; 0 for new features (guide 7.3).

    A vector for each group of pairs that have slots of their own.
    """
    parts, slot = [], 0
    for group in scene.pair_groups:
        count = group.point_count
        rows = range(slot, slot + group.slot_count)
        old_feature, new_feature, old_force, active = take((feature, contacts.feature, force, contacts.active), rows)
        shape = (len(group.bodies_a), count, -1)
        old_force = old_force.map(lambda x, shape=shape: x.reshape(shape))
        parts.append(
            matched_points(old_feature.reshape(shape), new_feature.reshape(shape), active.reshape(shape), old_force)
        )
        slot += group.slot_count
    return parts


def matched_points(old_feature: Array, new_feature: Array, active: Array, force: Vec3) -> Vec3:
    """Forces (pair * point, world) where the old feature of a point is the new one; arguments (pair, point, world)."""
    same = old_feature[:, None, :, :] == new_feature[:, :, None, :]
    same = same & active[:, :, None, :]

    def move(component: Array) -> Array:
        old = component[:, None, :, :]
        moved = jnp.where(same, old, 0.0)
        total = moved[:, :, 0]
        for point in range(1, moved.shape[2]):
            total = total + moved[:, :, point]
        return total.reshape(-1, total.shape[-1])

    return force.map(move)


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
