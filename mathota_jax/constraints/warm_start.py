"""Impulses of the last step found again: contacts are the same where pair and feature are (guide 7.3 and 12.4)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.narrowphase import ContactSet
from mathota_jax.scene import Scene
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.vector import Vec3


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
