"""Reduced coordinates to bodies: states that satisfy the joints of a tree exactly."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax import Hinge, Slider, State
from mathota_jax.spatial.quaternion import Quaternion, multiply, to_matrix
from mathota_jax.spatial.vector import Vec3, cross


class _Motion(NamedTuple):
    """Where a body went from its build pose, and its velocity; components are scalars.

    A point `x` of the build pose is now at ``rotation x + translation``; `velocity` is that of the point of the body
    at the world origin.
    """

    rotation: Quaternion
    translation: Vec3
    angular_velocity: Vec3
    velocity: Vec3

    def point(self, point: Vec3) -> Vec3:
        return to_matrix(self.rotation).apply(point) + self.translation


def place(rest_state: State, joints: Sequence[Hinge | Slider], position: Array, velocity: Array) -> State:
    """Moves the bodies of a tree of joints to given joint coordinates. Pure and differentiable.

    Product of exponentials: each joint turns or shifts all that hangs on it, in the build pose's frame.

    Args:
        rest_state: state as built, in which every joint coordinate is 0.
        joints: the joints of the tree, parents before children; bodies without a joint stay.
        position: ``(joint,)`` angles [rad] and displacements [m].
        velocity: ``(joint,)`` their rates.

    Returns:
        The state with the jointed bodies placed; joint coordinates and rates are exactly those given.

    Raises:
        ValueError: a joint is of another kind, or names a body where its handle is needed.
    """
    for number, joint in enumerate(joints):
        if not isinstance(joint, Hinge | Slider):
            raise ValueError(f"place: joints[{number}] must be a Hinge or a Slider, got {joint!r}")
        if isinstance(joint.parent, str) or isinstance(joint.child, str):
            raise ValueError(
                f"place: joints[{number}] names its bodies, {joint.parent!r} and {joint.child!r}; declare it with their "
                "handles, as add_body returned them"
            )
    zero = jnp.zeros_like(position[0])
    origin = Vec3(zero, zero, zero)
    fixed = _Motion(Quaternion(zero + 1, zero, zero, zero), origin, origin, origin)
    motions: dict[int, _Motion] = {}
    state = rest_state
    for index, joint in enumerate(joints):
        parent = motions.get(joint.parent, fixed)
        motion = _moved(parent, joint, position[index], velocity[index])
        motions[joint.child] = motion
        state = _with_body(state, rest_state, joint.child, motion)
    return state


def _moved(parent: _Motion, joint: Hinge | Slider, position: Array, velocity: Array) -> _Motion:
    direction = np.asarray(joint.axis, float)
    axis, anchor = Vec3(*map(float, direction / np.linalg.norm(direction))), Vec3(*map(float, joint.anchor))
    axis_w = to_matrix(parent.rotation).apply(axis)
    if isinstance(joint, Slider):
        return parent._replace(
            translation=parent.translation + axis_w * position, velocity=parent.velocity + axis_w * velocity
        )
    half = 0.5 * position
    turn = Quaternion(jnp.cos(half), *(axis * jnp.sin(half)))
    anchor_w = parent.point(anchor)
    rotation = multiply(parent.rotation, turn)
    return _Motion(
        rotation,
        anchor_w - to_matrix(rotation).apply(anchor),
        parent.angular_velocity + axis_w * velocity,
        parent.velocity + cross(anchor_w, axis_w * velocity),
    )


def _with_body(state: State, rest_state: State, body: int, motion: _Motion) -> State:
    position = motion.point(Vec3(*rest_state.position[body]))
    orientation = multiply(motion.rotation, Quaternion(*rest_state.orientation[body]))
    velocity = motion.velocity + cross(motion.angular_velocity, position)
    return dataclasses.replace(
        state,
        position=state.position.at[body].set(jnp.stack(position)),
        orientation=state.orientation.at[body].set(jnp.stack(orientation)),
        velocity=state.velocity.at[body].set(jnp.stack(velocity)),
        angular_velocity=state.angular_velocity.at[body].set(jnp.stack(motion.angular_velocity)),
    )
