"""Pairs of bodies each of which is somewhere on its way."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.narrowphase import ContactSet, group_contacts
from mathota_jax.collision.placement import shape_reach
from mathota_jax.model import Model
from mathota_jax.scene import PairGroup
from mathota_jax.spatial.quaternion import Quaternion
from mathota_jax.spatial.vector import Vec3

Placed = tuple[Vec3, Quaternion]


def contacts_between(model: Model, group: PairGroup, a: Placed, b: Placed) -> ContactSet:
    """Contacts of a group (slot, world) where its bodies A and B are placed as given, components (pair or 1, world)."""
    count = len(group.bodies_a)
    worlds = max(component.shape[-1] for place in (a, b) for part in place for component in part)

    def join(first: Array, second: Array) -> Array:
        return jnp.concatenate([jnp.broadcast_to(x, (count, worlds)) for x in (first, second)])

    position, orientation = Vec3(*map(join, a[0], b[0])), Quaternion(*map(join, a[1], b[1]))
    apart = group._replace(bodies_a=tuple(range(count)), bodies_b=tuple(range(count, 2 * count)))
    return group_contacts(model.scene, apart, model.shapes, position, orientation)


def reaches(model: Model, group: PairGroup) -> tuple[Array, Array]:
    """(pair or 1, world) how far the shapes A and B reach from the centres of mass, as far as turning moves them."""
    sides = ((group.kind_a, group.shapes_a), (group.kind_b, group.shapes_b))
    of_a, of_b = (shape_reach(model.scene, model.shapes, kind, rows)[1] for kind, rows in sides)
    return of_a, of_b


def turning(turn: Array, reach: Array) -> Array:
    """Product with the reach; infinite shapes do not turn."""
    return jnp.where(turn > 0, turn * reach, 0.0)
