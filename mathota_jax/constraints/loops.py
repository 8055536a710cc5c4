"""Closed loops of joints that stay open: the joints contradict each other, or the solver can not close them."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import vector
from mathota_jax.constraints.joint_layout import joint_row_count
from mathota_jax.constraints.joint_rows import JointRows
from mathota_jax.constraints.mechanism_layout import looped_slots
from mathota_jax.model import Model
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.vector import norm

OPEN = 0.1
"""Error beyond which a joint counts as open: an angle in rad, a gap as a share of the joint's way to its moving bodies."""

YIELDING = 30.0
"""How far a row that is as open as counts as open gives way, over the motion that its two bodies alone allow.

Chosen on one scene, a bridge of 160 links as long as its span, in nine runs: in 5 s it opens by 0.022 of a link with 10, by
0.017 with 30, by 0.028 with 100.
"""


def are_open(model: Model, joints: JointRows) -> Array | None:
    """Worlds (world,) in which a joint of a loop is open; None where there is no loop."""
    limits = _limits(model)
    return None if limits is None else (jnp.abs(lax.stop_gradient(joints.error)) > limits).any(0)


def correctable(model: Model, error: Array) -> Array:
    """Errors (slot, world) for the position correction, which in loops takes no joint as more than just open.

    Of joints that contradict each other large errors stay, and Newton's method on errors that stay does not converge:
    each step would throw the bodies further than the one before.
    """
    limits = _limits(model)
    return error if limits is None else jnp.clip(error, -limits, limits)


def yielding(model: Model, error: Array) -> Array | None:
    """How far (slot, world) rows give way in a correction of the positions, see `mechanism_loops`; None without loops.

    With the square of the error over what counts as open: near the solution Newton's method converges as ever, and a loop
    that can not close moves no further in a round than it may be open. Source: N. Yamashita and M. Fukushima, "On the rate
    of convergence of the Levenberg-Marquardt method", 2001.
    """
    limits = _limits(model)
    return None if limits is None else YIELDING * lax.stop_gradient(jnp.clip(error / limits, -1.0, 1.0)) ** 2


def _limits(model: Model) -> Array | None:
    """Errors (slot, world) beyond which joints of loops are open, infinite for all others; None where there is no loop."""
    scene = model.scene
    found = looped_slots(scene)
    if not found:
        return None
    joint_of_slot = np.zeros(joint_row_count(scene), int)
    looped, angular = np.zeros((2, len(joint_of_slot), 1), bool)
    for joint, slot, is_angle in found:
        joint_of_slot[slot], looped[slot], angular[slot] = joint, True, is_angle
    reach = jnp.zeros(())
    for side, anchors in (("parent", model.joint_anchor_parent), ("child", model.joint_anchor_child)):
        bodies = np.array([getattr(scene.joints[joint], side) for joint in joint_of_slot])
        arm = norm(vector(lax.stop_gradient(take(anchors, joint_of_slot))))
        moves = ~np.asarray(scene.static)[bodies]
        reach = reach + jnp.where(moves[:, None], arm + lax.stop_gradient(take(model.size, bodies)), 0.0)
    return jnp.where(looped, OPEN * jnp.where(angular, 1.0, reach), jnp.inf)
