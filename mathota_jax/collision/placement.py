"""Where the shapes of a scene are: their sizes and poses in the form that pair functions and bounds take."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jax import Array

from mathota_jax.geometry.bounds import bounding_radius
from mathota_jax.geometry.hull import padded_faces
from mathota_jax.scene import Scene
from mathota_jax.spatial.indexing import take, unstack
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, multiply, to_matrix
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Vec3, norm

UNROTATED_KINDS = ("plane", "sphere")
"""Kinds whose contacts do not depend on the orientation of the body (planes are given in the world frame)."""

LOCAL_POSE = ("local_position", "local_orientation")
"""Parameters that place a shape in its body; see `Model.shapes`."""


def shape_parameters(
    scene: Scene, shapes: dict[str, dict[str, Array]], kind: str, rows: Sequence[int]
) -> dict[str, Any]:
    """Sizes of the shapes in the given rows of a kind, components of shape (row, world).

    Vectors are a `Vec3`. Vertices are a `Vec3` of components (vertex, row, world); with them come "faces", an int32 NumPy
    array (row, face, corner) padded by repetition. Heights are (row of the grid, column, row, world). Rows that are all
    the same are given once (see `take`), faces too.
    """
    found: dict[str, Any] = {}
    for name, values in take({k: v for k, v in shapes[kind].items() if k not in LOCAL_POSE}, rows).items():
        if name == "vertices":
            found[name] = Vec3(*(jnp.swapaxes(component, 0, 1) for component in unstack(values, 2)))
            once = list(rows)[: values.shape[0]]
            found["faces"] = padded_faces([scene.faces[row] for row in once])
        elif name == "heights":
            found[name] = jnp.moveaxis(values, 0, 2)
        else:
            found[name] = Vec3(*unstack(values, 1)) if values.ndim == 3 else values
    return found


def shape_reach(
    scene: Scene, shapes: dict[str, dict[str, Array]], kind: str, rows: Sequence[int]
) -> tuple[Array, Array]:
    """(row or 1, world) how far shapes reach from the centres of mass of their bodies: in all, and what turning moves.

    A sphere about its centre of mass turns in itself.
    """
    radius = bounding_radius(kind, shape_parameters(scene, shapes, kind, rows))
    local = shapes[kind].get("local_position")
    offset = jnp.zeros((1, 1), radius.dtype) if local is None else norm(Vec3(*unstack(take(local, rows), 1)))
    whole = radius + offset
    return whole, offset if kind == "sphere" else whole


def shape_poses(
    shapes: dict[str, dict[str, Array]],
    kind: str,
    rows: Sequence[int],
    bodies: Sequence[int],
    position: Vec3,
    orientation: Quaternion,
) -> Pose:
    """Poses of the shapes in the given rows of a kind, fixed to the given bodies; components of shape (row, world).

    Args:
      shapes: kind -> parameter -> (shape, ..., world).
      kind, rows: which shapes.
      bodies: the body of each.
      position, orientation: of all bodies, components (body, world).
    """
    local = take({name: shapes[kind][name] for name in LOCAL_POSE if name in shapes[kind]}, rows)
    turned = kind not in UNROTATED_KINDS
    if not local:
        rotation = to_matrix(take(orientation, bodies)) if turned else None
        return Pose(take(position, bodies), rotation)
    center, orientation = take((position, orientation), bodies)
    rotation = to_matrix(orientation)
    if "local_position" in local:
        center = center + rotation.apply(Vec3(*unstack(local["local_position"], 1)))
    if turned and "local_orientation" in local:
        rotation = to_matrix(multiply(orientation, Quaternion(*unstack(local["local_orientation"], 1))))
    return compute_once(Pose(center, rotation if turned else None), position.x)
