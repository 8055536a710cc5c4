"""Bounding volumes of the shapes of a scene, swept over a step (guide 5.1 and 10.4)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.broadphase import Admissible, Bounds, Planes
from mathota_jax.collision.placement import shape_parameters, shape_poses
from mathota_jax.geometry.bounds import aabb, bounding_radius
from mathota_jax.scene import Scene
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion
from mathota_jax.spatial.vector import Vec3, norm

MARGIN = 0.01
"""Relative growth of the bounds: contacts that are about to touch keep their place, and so their impulse."""

Shapes = dict[str, dict[str, Array]]


def admissible_pairs(scene: Scene) -> Admissible:
    """Which pairs of the shapes that take part in the broadphase may collide."""
    plan = scene.broadphase
    assert plan is not None
    bodies = tuple(scene.shapes[entry].body for entry in plan.shapes)
    return Admissible(bodies, tuple(scene.static[body] for body in bodies), plan.excluded, plan.filter)


def kind_ranges(scene: Scene) -> Iterator[tuple[str, range]]:
    """Kinds that take part in the broadphase, and their places in `Broadphase.shapes`."""
    assert scene.broadphase is not None
    kinds = [scene.shapes[entry].kind for entry in scene.broadphase.shapes]
    for kind, run in itertools.groupby(range(len(kinds)), key=kinds.__getitem__):
        places = list(run)
        yield kind, range(places[0], places[-1] + 1)


def placed_shapes(
    scene: Scene, shapes: Shapes, kind: str, places: range, position: Vec3, orientation: Quaternion
) -> tuple[dict[str, Any], Pose]:
    """Sizes and poses of a run of shapes of one kind; other arguments as for `find_contacts`."""
    assert scene.broadphase is not None
    entries = [scene.shapes[scene.broadphase.shapes[place]] for place in places]
    rows, bodies = [entry.index for entry in entries], [entry.body for entry in entries]
    return (
        shape_parameters(scene, shapes, kind, rows),
        shape_poses(shapes, kind, rows, bodies, position, orientation),
    )


def swept_bounds(
    scene: Scene,
    shapes: Shapes,
    position: Vec3,
    orientation: Quaternion,
    displacements: tuple[Vec3, ...],
    turn: Array | None,
) -> Bounds:
    """Bounds that contain the shapes where they are and wherever the displacements may take them.

    Args:
      scene: static structure.
      shapes: kind -> parameter -> (shape, ..., world).
      position, orientation: of all bodies, components (body, world).
      displacements: of all bodies [m], possible translations in the step.
      turn: (body, world) largest angle [rad] by which each body may turn in the step; None for no turn.
    """
    parts, planes = [], None
    for kind, places in kind_ranges(scene):
        parameters, pose = placed_shapes(scene, shapes, kind, places, position, orientation)
        if kind == "plane":
            planes = Planes(parameters["normal"], parameters["offset"])
        low, high = aabb(kind, parameters, pose)
        reach = bounding_radius(kind, parameters)
        center = pose.position
        assert scene.broadphase is not None
        bodies = [scene.shapes[scene.broadphase.shapes[place]].body for place in places]
        growth = reach * MARGIN
        offset = _offset(scene, position, bodies, center)
        if turn is not None:
            # A point of the shape moves along an arc about the centre of mass, which its chord and its sagitta bound.
            growth = growth + (reach + offset) * jnp.minimum(take(turn, bodies), 2.0)
        far = jnp.zeros(())
        start_low, start_high = low, high
        for displacement in displacements:
            shift = take(displacement, bodies)
            low = Vec3(*(jnp.minimum(a, b + s) for a, b, s in zip(low, start_low, shift, strict=True)))
            high = Vec3(*(jnp.maximum(a, b + s) for a, b, s in zip(high, start_high, shift, strict=True)))
            far = jnp.maximum(far, norm(shift))
        low, high = low.map(lambda x, g=growth: x - g), high.map(lambda x, g=growth: x + g)
        parts.append((len(places), Bounds(low, high, center, reach + growth + far)))
    return _joined(parts)._replace(planes=planes)


def _offset(scene: Scene, position: Vec3, bodies: list[int], center: Vec3) -> Array:
    """Distance of each shape's origin from the centre of mass of its body."""
    return norm(center - take(position, bodies))


def _joined(parts: list[tuple[int, Bounds]]) -> Bounds:
    worlds = max(jnp.shape(x)[-1] for _, b in parts for x in (*b.low, *b.high, *b.center, b.radius))

    def join(*values: Array) -> Array:
        full = [jnp.broadcast_to(v, (count, worlds)) for v, (count, _) in zip(values, parts, strict=True)]
        return full[0] if len(full) == 1 else jnp.concatenate(full)

    bounds = [b for _, b in parts]
    low, high, center = (
        Vec3(*(join(*(getattr(b, name)[axis] for b in bounds)) for axis in range(3)))
        for name in ("low", "high", "center")
    )
    return Bounds(low, high, center, join(*(b.radius for b in bounds)))
