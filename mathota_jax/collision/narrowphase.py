"""Contacts of a scene: one vectorised test for each group of admissible pairs."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.manifold import Manifold
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.collision.placement import shape_parameters, shape_poses
from mathota_jax.scene import PairGroup, Scene
from mathota_jax.spatial.quaternion import Quaternion
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.spread import spread
from mathota_jax.spatial.vector import Vec3

SPECULATIVE = 0.5
"""With `Options.continuous`, contacts count up to this share of the inner radius of the smaller moving body ahead.

Bodies that move by less relative to each other can not pass through each other; what the faster ones meet is found along
their motion (`dynamics.events`), where a contact far ahead would stop them at things that they fly past.
"""


class ContactSet(NamedTuple):
    """All contact slots of a scene, components of shape (slot, world); slots are numbered group, pair, point.

    `converged` is None if no pair of the scene needs an iterative search. `apart` is whether the bodies do not meet in the
    step, whatever deflects them; None where nobody asked.
    """

    position: Vec3
    normal: Vec3
    separation: Array
    feature: Array
    active: Array
    converged: Array | None
    apart: Array | None = None


def find_contacts(
    scene: Scene, shapes: dict[str, dict[str, Array]], position: Vec3, orientation: Quaternion
) -> ContactSet:
    """Runs the narrow phase for the pairs that have slots of their own (guide 11.1, phases 2 and 3).

    Args:
      scene: static structure.
      shapes: kind -> parameter -> (shape, ..., world).
      position, orientation: of all bodies, components (body, world).
    """
    return join_contacts([group_contacts(scene, group, shapes, position, orientation) for group in scene.pair_groups])


def stored(contacts: ContactSet, like: Array) -> ContactSet:
    """The contacts, what rows are made of being computed once; `like` as for `compute_once`."""
    values = {"position": contacts.position, "normal": contacts.normal, "separation": contacts.separation}
    return contacts._replace(**compute_once(values, like))


def join_contacts(groups: list[ContactSet]) -> ContactSet:
    """The slots of all groups, one group after the other."""
    if len(groups) == 1:
        return groups[0]
    worlds = max(group.separation.shape[1] for group in groups)
    if any(group.converged is not None for group in groups):
        groups = [g if g.converged is not None else g._replace(converged=jnp.ones_like(g.active)) for g in groups]
    return ContactSet(*(_concatenate(list(fields), worlds) for fields in zip(*groups, strict=True)))  # type: ignore[arg-type]


def _concatenate(values: list[Any], worlds: int) -> Any:
    if values[0] is None:
        return None
    if isinstance(values[0], Vec3):
        return Vec3(*(_concatenate(list(components), worlds) for components in zip(*values, strict=True)))
    return jnp.concatenate([jnp.broadcast_to(value, (value.shape[0], worlds)) for value in values])


def group_contacts(
    scene: Scene, group: PairGroup, shapes: dict[str, dict[str, Array]], position: Vec3, orientation: Quaternion
) -> ContactSet:
    """`find_contacts` for one group."""
    parameters_b = shape_parameters(scene, shapes, group.kind_b, group.shapes_b)
    if group.window is not None:
        parameters_b["window"] = group.window
    manifold = PAIRS[group.kind_a, group.kind_b].function(
        shape_parameters(scene, shapes, group.kind_a, group.shapes_a),
        shape_poses(shapes, group.kind_a, group.shapes_a, group.bodies_a, position, orientation),
        parameters_b,
        shape_poses(shapes, group.kind_b, group.shapes_b, group.bodies_b, position, orientation),
    )
    return flatten(manifold, len(group.bodies_a))


def flatten(manifold: Manifold, pair_count: int) -> ContactSet:
    """Slots in the order pair, point."""
    points = manifold.points
    worlds = max(point.separation.shape[1] for point in points)
    shape = (pair_count, worlds)

    def per_point(values: list[Array]) -> Array:
        full = [jnp.broadcast_to(value, shape) for value in values]
        if len(full) == 1:
            return full[0]
        return jnp.stack(full, axis=1).reshape(pair_count * len(full), worlds)

    def per_pair(value: Array) -> Array:
        # A normal that all worlds share (that of a plane) keeps its single world.
        full = spread(value[:, None], (pair_count, len(points), value.shape[-1]))
        return full.reshape(pair_count * len(points), value.shape[-1])

    def per_axis(vectors: list[Vec3]) -> Vec3:
        return Vec3(*(per_point([vector[axis] for vector in vectors]) for axis in range(3)))

    own = [point.normal for point in points if point.normal is not None]
    return ContactSet(
        per_axis([point.position for point in points]),
        per_axis(own) if own else manifold.normal.map(per_pair),
        per_point([point.separation for point in points]),
        per_point([point.feature for point in points]),
        per_point([point.active for point in points]),
        None if manifold.converged is None else per_pair(manifold.converged),
    )
