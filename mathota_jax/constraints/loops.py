"""Closed loops of joints that stay open: the joints contradict each other, or the solver can not close them."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import vector
from mathota_jax.constraints.joint_rows import JointRows
from mathota_jax.constraints.mechanism_layout import looped_slots
from mathota_jax.model import Model
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.vector import norm

OPEN = 0.1
"""Error beyond which a joint counts as open: an angle in rad, a gap as a share of the joint's way to its moving bodies."""


def are_open(model: Model, joints: JointRows) -> Array | None:
    """Worlds (world,) in which a joint of a loop is open; None where there is no loop."""
    found = _limits(model)
    if found is None:
        return None
    slots, limit = found
    return (jnp.abs(lax.stop_gradient(take(joints.error, slots))) > limit).any(0)


def correctable(model: Model, error: Array) -> Array:
    """Errors (slot, world) for the position correction, which in loops takes no joint as more than just open.

    Of joints that contradict each other large errors stay, and Newton's method on errors that stay does not converge:
    each step would throw the bodies further than the one before.
    """
    found = _limits(model)
    if found is None:
        return error
    slots, limit = found
    bounded = jnp.clip(take(error, slots), -limit, limit)
    if len(slots) == error.shape[0]:
        return bounded
    return jnp.broadcast_to(error, (error.shape[0], bounded.shape[-1])).at[slots].set(bounded)


def _limits(model: Model) -> tuple[np.ndarray, Array] | None:
    """Slots of rows that hold joints of closed loops, in ascending order, and their errors beyond which these are open."""
    scene = model.scene
    found = sorted(looped_slots(scene), key=lambda row: row[1])
    if not found:
        return None
    place, slots, angular = (np.array(column) for column in zip(*found, strict=True))
    reach = jnp.zeros(())
    for side, anchors in (("parent", model.joint_anchor_parent), ("child", model.joint_anchor_child)):
        bodies = np.array([getattr(scene.joints[joint], side) for joint in place])
        arm = norm(vector(lax.stop_gradient(take(anchors, place))))
        moves = ~np.asarray(scene.static)[bodies]
        reach = reach + jnp.where(moves[:, None], arm + lax.stop_gradient(take(model.size, bodies)), 0.0)
    return slots, OPEN * jnp.where(angular[:, None], 1.0, reach)
