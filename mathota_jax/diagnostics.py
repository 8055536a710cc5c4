"""What a user asks of a state: contacts, forces, conserved quantities, joint coordinates."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from mathota_jax.batching import batch_last
from mathota_jax.bodies import moving, moving_inertia, unpack, vector
from mathota_jax.constraints.joint_layout import joint_row_count
from mathota_jax.constraints.joint_rows import joint_coordinates, moved_by, reactions
from mathota_jax.constraints.slots import bodies_of_slots, find_slots
from mathota_jax.model import Model
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.vector import Vec3, cross, dot
from mathota_jax.state import State
from mathota_jax.struct import pytree


@pytree
class Contacts:
    """All contact slots of a scene at a state.

    Attributes:
      position: (slot, 3) midway between the two surface points [m], world frame.
      normal: (slot, 3) unit vector from body A to body B, world frame.
      separation: (slot,) signed gap [m], negative when overlapping.
      active: (slot,) whether the slot holds a contact point; it may still be separated.
      feature: (slot,) id of the geometric feature, stable from step to step.
      body_a, body_b: (slot,) handles.
    """

    position: Array
    normal: Array
    separation: Array
    active: Array
    feature: Array
    body_a: Array
    body_b: Array


def contacts(model: Model, state: State) -> Contacts:
    """Contact points of every admissible pair at the present poses. Differentiable in poses and shapes.

    In a scene with a broadphase the slots behind those of the pairs that have their own hold the pairs that are close now,
    in an order of their own: not that of `contact_forces`, which belongs to the last step.
    """
    return _contacts(model, state)


@batch_last
def _contacts(model: Model, state: State) -> Contacts:
    scene = model.scene
    if not scene.slot_count:
        none = state.position[:0, 0]
        body_a, body_b = bodies_of_slots(scene, None)
        return Contacts(state.position[:0], state.position[:0], none, none > 0, none.astype(jnp.int32), body_a, body_b)
    found, close = find_slots(model, unpack(state), None)
    body_a, body_b = bodies_of_slots(scene, close)
    position, normal = (jnp.stack(list(v), axis=1) for v in (found.position, found.normal))
    return Contacts(position, normal, found.separation, found.active, found.feature, body_a, body_b)


def contact_forces(model: Model, state: State) -> Array:
    """Mean force [N] of the last step on body B of each contact slot, (slot, 3), world frame; A feels the opposite."""
    _check(model, state)
    return state.contact_force


def energy(model: Model, state: State) -> Array:
    """Kinetic energy plus potential energy in gravity [J], (); zero height at the world origin. Differentiable."""
    return _energy(model, state)


@batch_last
def _energy(model: Model, state: State) -> Array:
    scene = model.scene
    blocks = moving(scene, unpack(state))
    inertia = moving_inertia(scene, model, blocks.orientation)
    gravity = Vec3(*(model.gravity[axis][None] for axis in range(3)))
    mass = 1.0 / inertia.inverse_mass
    kinetic = mass * dot(blocks.velocity, blocks.velocity)
    kinetic = kinetic + dot(blocks.angular_velocity, inertia.apply(blocks.angular_velocity))
    return (0.5 * kinetic - mass * dot(gravity, blocks.position)).sum(0)


def momentum(model: Model, state: State) -> Array:
    """Linear momentum of the moving bodies [kg m/s], (3,), world frame. Differentiable."""
    return _momentum(model, state)


@batch_last
def _momentum(model: Model, state: State) -> Array:
    mass, velocity = take((model.mass, vector(state.velocity)), model.scene.dynamic_bodies)
    return jnp.stack([(mass * component).sum(0) for component in velocity])


def angular_momentum(model: Model, state: State) -> Array:
    """Angular momentum about the world origin [kg m^2/s], (3,), world frame. Differentiable."""
    return _angular_momentum(model, state)


@batch_last
def _angular_momentum(model: Model, state: State) -> Array:
    scene = model.scene
    blocks = moving(scene, unpack(state))
    inertia = moving_inertia(scene, model, blocks.orientation)
    orbital = cross(blocks.position, blocks.velocity) * (1.0 / inertia.inverse_mass)
    total = orbital + inertia.apply(blocks.angular_velocity)
    return jnp.stack([component.sum(0) for component in total])


def joint_position(model: Model, state: State) -> Array:
    """Coordinate of each joint, (joint,). Differentiable.

    Angle [rad] of a hinge and displacement [m] of a slider from the built pose, twist [rad] of a ball and socket, length
    [m] of a distance joint; 0 for a fixed joint.
    """
    return _joint_coordinates(model, state)[0]


def joint_velocity(model: Model, state: State) -> Array:
    """Rate of the coordinate of each joint, (joint,) [rad/s] or [m/s]. Differentiable."""
    return _joint_coordinates(model, state)[1]


@batch_last
def _joint_coordinates(model: Model, state: State) -> tuple[Array, Array]:
    if not model.scene.joints:
        return state.joint_force, state.joint_force
    return joint_coordinates(model, unpack(state))


def joint_forces(model: Model, state: State) -> tuple[Array, Array]:
    """Mean force and torque over the last step that each joint exerted on its child at the child's anchor.

    All that acts in the joint counts: what holds it, its stops, spring, damper, friction and its velocity and position
    motors. A torque motor does not: its torque is the action, an outer load like gravity. Accurate to second order at the
    middle of the step, half a step before `state`. The parent feels the opposite force at the same place. A distance joint
    exerts its force along the line: tension on the child points towards the parent's anchor. Differentiable.

    Returns:
      Force (joint, 3) [N] and torque (joint, 3) [N m], world frame; 0 before the first step.

    Raises:
      ValueError: the state belongs to another scene.
    """
    row_count = joint_row_count(model.scene)
    if state.joint_force.shape[-1:] != (row_count,):
        raise ValueError(
            f"joint_forces: the state has {state.joint_force.shape[-1]} joint rows, the model {row_count}: they belong to "
            "different scenes"
        )
    return _joint_forces(model, state)


@batch_last
def _joint_forces(model: Model, state: State) -> tuple[Array, Array]:
    if not model.scene.joints:
        return state.position[:0], state.position[:0]
    middle = moved_by(unpack(state), -0.5 * model.dt)
    force, torque = (jnp.stack(list(v), axis=1) for v in reactions(model, middle, state.joint_force))
    return force, torque


def _check(model: Model, state: State) -> None:
    if state.contact_force.shape[-2:] != (model.scene.slot_count, 3):
        raise ValueError(
            f"the state has {state.contact_force.shape[-2]} contact slots, the model {model.scene.slot_count}: "
            "they belong to different scenes"
        )
