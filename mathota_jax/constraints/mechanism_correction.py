"""How far and by which weights a correction of the poses may turn the links of mechanisms, and what energy it may give."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import Bodies, Inertia
from mathota_jax.constraints.mechanism_layout import Layout
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.vector import Vec3, dot

TURN_WEIGHT = 12.0
"""Inertia of a correction of the pose over the largest moment of the body: that of a rod over the square of its length.

An error is removed along its gradient, which is right for small turns only: of the ways to remove it, one that shifts bodies
leaves less behind than one that turns them. Measured for twenty links at 1/60 s: 5e-5 of the swing energy gained, with the
inertia itself 6e-2.
"""

LARGEST_TURN = 0.5
"""Angle [rad] by which a round turns a body at most: further on the Jacobian says nothing."""

ROUND_OFF = 16
"""Multiples of the machine epsilon, relative to a body's place, of a lift that is none."""


def correction_weights(inertia: Inertia) -> Inertia:
    """Inertia with which bodies respond to a correction of their poses, see `TURN_WEIGHT`."""
    moments = inertia.moments
    weight = TURN_WEIGHT * jnp.maximum(jnp.maximum(moments.x, moments.y), moments.z)
    return inertia._replace(moments=Vec3(weight, weight, weight))


def bounded(displacement: Array) -> Array:
    """Displacement (component, block, world) of which the turns are no larger than `LARGEST_TURN`."""
    squared = (displacement[3:] ** 2).sum(0)
    far = squared > LARGEST_TURN**2
    scale = jnp.where(far, LARGEST_TURN / jnp.sqrt(jnp.where(far, squared, 1.0)), 1.0)
    return jnp.concatenate([displacement[:3], displacement[3:] * scale])


def without_gain(found: Layout, inertia: Inertia, gravity: Vec3, before: Bodies, after: Bodies) -> Bodies:
    """The moving bodies after their loops were closed, with what closing lifted them taken from their kinetic energy.

    A loop that is nearly stretched falls by shapes that its joints allow to first order, and is pulled straight again as
    its joints close: without this, what it gains in falling it gains in every step. Velocities along which the joints hold
    are only made smaller. A loop that hangs on nothing is not lifted.
    """
    tree_of_link = np.repeat(np.arange(len(found.trees)), [len(links) for links in found.trees])
    looped = np.zeros((len(found.trees), 1), bool)
    looped[[tree_of_link[closing.child if closing.parent < 0 else closing.parent] for closing in found.closings]] = True
    inertia, old, new = take((inertia, before, after), found.blocks)
    lift = -dot(new.position - old.position, gravity)
    size = jnp.sqrt(dot(new.position, new.position) * dot(gravity, gravity))
    lift = lift - ROUND_OFF * jnp.finfo(lift.dtype).eps * lax.stop_gradient(size)
    momentum = inertia.apply(new.angular_velocity)
    kinetic = 0.5 * (dot(new.velocity, new.velocity) / inertia.inverse_mass + dot(new.angular_velocity, momentum))
    gained, kinetic = (
        jnp.zeros((len(found.trees), x.shape[-1]), x.dtype).at[tree_of_link].add(x)
        for x in (lift / inertia.inverse_mass, kinetic)
    )
    share = safe_divide(jnp.where(looped, jnp.maximum(gained, 0.0), 0.0), kinetic)
    scale = safe_sqrt(jnp.maximum(1.0 - share, 0.0))
    tree_of_block = np.full(found.block_count, len(found.trees))
    tree_of_block[list(found.blocks)] = tree_of_link
    scale = take(jnp.concatenate([scale, jnp.ones_like(scale[:1])]), tree_of_block)
    return after._replace(velocity=after.velocity * scale, angular_velocity=after.angular_velocity * scale)
