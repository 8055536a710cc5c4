"""Whether the values of a model, where a user has replaced some, are such as its scene can have: a flag where not."""

from __future__ import annotations

import functools

import jax.numpy as jnp
from jax import Array

from mathota_jax.collision.placement import shape_parameters
from mathota_jax.geometry.bounds import bounding_radius
from mathota_jax.model import Model
from mathota_jax.spatial.indexing import take

LENGTHS = ("radius", "half_extents", "half_height")
"""Parameters of shapes that are positive."""
RESISTANCES = ("damping", "friction", "stiffness", "armature")
"""Of joints: finite and not negative."""
UNEQUAL = 1e-4
"""Share by which moments of inertia that were built equal may differ, and sizes may pass what was built for them."""


def values_in_range(model: Model) -> Array:
    """(world,) whether leaves of a worlds-last model are such as bodies, joints and motors have.

    Not masses, moments of inertia, places and frames: motion with those is not finite.
    """
    fine = [jnp.isfinite(leaf) for parameters in model.shapes.values() for leaf in parameters.values()]
    fine += [parameters[name] > 0 for parameters in model.shapes.values() for name in LENGTHS if name in parameters]
    if model.scene.friction:
        fine.append((model.friction >= 0) & jnp.isfinite(model.friction))
    if model.scene.restitution:
        fine.append((model.restitution >= 0) & (model.restitution <= 1))
    if model.scene.slot_count:
        fine += [jnp.isfinite(model.size), model.size > 0]
    fine += _fits_the_program(model)
    if model.scene.joints:
        for name in RESISTANCES:
            resistance = getattr(model, f"joint_{name}")
            fine.append((resistance >= 0) & jnp.isfinite(resistance))
        fine += [model.joint_limits[:, 0] <= model.joint_limits[:, 1], model.joint_swing >= 0]
    if model.scene.motors:
        bounds = (model.motor_limit, model.motor_cap, model.motor_stiffness, model.motor_damping)
        fine += [bound >= 0 for bound in bounds]
    each = [jnp.all(values.reshape(-1, values.shape[-1]), axis=0) for values in fine]
    return functools.reduce(jnp.logical_and, each, jnp.ones(1, bool))


def _fits_the_program(model: Model) -> list[Array]:
    """Values that a scene was built without, and which its program does not know."""
    scene, fine = model.scene, []
    if scene.dynamic_bodies and scene.all_spherical:
        moments = take(model.inertia, scene.dynamic_bodies)
        fine.append(~(moments.max(1) - moments.min(1) > UNEQUAL * moments.max(1)))
    for group in scene.pair_groups:
        if group.window is not None:
            reach = bounding_radius(group.kind_a, shape_parameters(scene, model.shapes, group.kind_a, group.shapes_a))
            cell = take(model.shapes["heightfield"]["cell_size"], group.shapes_b)
            fine.append(~(2.0 * reach > (1.0 + UNEQUAL) * (group.window - 1) * cell))
    return fine
