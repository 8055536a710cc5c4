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
    scene = model.scene
    found = looped_slots(scene)
    if not found:
        return None
    place, slots, angular = (np.array(column) for column in zip(*found, strict=True))
    reach = jnp.zeros(())
    for side, anchors in (("parent", model.joint_anchor_parent), ("child", model.joint_anchor_child)):
        bodies = np.array([getattr(scene.joints[joint], side) for joint in place])
        arm = norm(vector(lax.stop_gradient(take(anchors, place))))
        moves = ~np.asarray(scene.static)[bodies]
        reach = reach + jnp.where(moves[:, None], arm + lax.stop_gradient(take(model.size, bodies)), 0.0)
    limit = OPEN * jnp.where(angular[:, None], 1.0, reach)
    return (jnp.abs(lax.stop_gradient(take(joints.error, slots))) > limit).any(0)
