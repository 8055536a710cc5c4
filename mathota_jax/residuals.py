"""How far a state is from what rigid bodies do: the four residuals of its contacts, overlaps, gaps of its joints."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from mathota_jax.batching import batch_last
from mathota_jax.bodies import Bodies, unpack
from mathota_jax.collision.narrowphase import ContactSet
from mathota_jax.constraints.joint_layout import joint_groups
from mathota_jax.constraints.joints.frames import joint_frames
from mathota_jax.constraints.slots import bodies_of_slots, contact_offsets, find_slots, matched_force
from mathota_jax.model import Model
from mathota_jax.spatial.indexing import gather
from mathota_jax.spatial.safe import safe_sqrt
from mathota_jax.spatial.vector import Vec3, cross, dot, norm
from mathota_jax.state import State
from mathota_jax.struct import pytree


@pytree
class Residuals:
    """What is left of the laws of rigid contact, each 0 for a perfect engine.

    Attributes:
      complementarity: () largest ``|impulse_n v_n|`` [J]: contacts that push do not part. A contact that bounces does
        part: for it this is the work of the rebound.
      penetration: () largest overlap [m].
      cone: () largest excess of the tangential impulse over friction times the normal one [N s].
      dissipation: () largest ``friction impulse_n |v_t| + impulse_t . v_t`` [J]: friction opposes sliding with all that
        it has.
    """

    complementarity: Array
    penetration: Array
    cone: Array
    dissipation: Array


@pytree
class JointGaps:
    """Violation of the motions that joints forbid.

    Attributes:
      translation: (joint,) distance of the anchors along the forbidden directions [m].
      rotation: (joint,) angle about the forbidden axes [rad], of first order.
    """

    translation: Array
    rotation: Array


def residuals(model: Model, state: State) -> Residuals:
    """The four residuals of the contacts of the last step, without derivative of use.

    The impulses are those of the last step, in the contacts that are the same at the present poses; the
    velocities and normals are the present ones. So a body that turned by an angle in the last step shows terms of the
    order of that angle that are none of the solver's.

    Source: Q. Le Lidec et al., "Contact Models in Robotics: a Comparative Analysis", IEEE Trans. Robotics 40, 2024.

    Args:
      model: parameters and static scene.
      state: state of one world, after a step.

    Raises:
      ValueError: a state of another scene.
    """
    if state.contact_force.shape[-2:] != (model.scene.slot_count, 3):
        raise ValueError(
            f"residuals: the state has {state.contact_force.shape[-2]} contact slots, the model {model.scene.slot_count}: "
            "they belong to different scenes"
        )
    return _residuals(model, state)


def penetration(model: Model, state: State) -> Array:
    """Largest overlap of any two bodies that may collide [m], (); 0 without any. Differentiable."""
    return _penetration(model, state)


def joint_gaps(model: Model, state: State) -> JointGaps:
    """How far each joint is open, in the order of adding. Differentiable; 0 at a closed joint, with derivative 0."""
    return _joint_gaps(model, state)


class _Slots(NamedTuple):
    """All contact slots at the present poses: contacts, bodies (slot, world or 1), forces [N] of the last step."""

    contacts: ContactSet
    body_a: Array
    body_b: Array
    force: Vec3


def _slots(model: Model, state: State, bodies: Bodies) -> _Slots:
    scene = model.scene
    contacts, close = find_slots(model, bodies, None)
    offset = contact_offsets(model, bodies, contacts, close)
    return _Slots(
        contacts,
        *bodies_of_slots(scene, close),
        matched_force(scene, contacts, offset, close, state, state.contact_force),
    )


@batch_last
def _residuals(model: Model, state: State) -> Residuals:
    scene = model.scene
    bodies = unpack(state)
    if not scene.slot_count:
        none = jnp.zeros(state.position.shape[-1], state.position.dtype)
        return Residuals(none, none, none, none)
    slots = _slots(model, state, bodies)
    normal = slots.contacts.normal
    velocity = _velocity_at(bodies, slots.contacts.position, slots.body_b) - _velocity_at(
        bodies, slots.contacts.position, slots.body_a
    )
    impulse = slots.force * model.dt
    normal_velocity, normal_impulse = dot(velocity, normal), dot(impulse, normal)
    sliding, tangential = velocity - normal * normal_velocity, impulse - normal * normal_impulse
    coefficient = safe_sqrt(gather(model.friction, slots.body_a) * gather(model.friction, slots.body_b))
    limit = coefficient * normal_impulse

    def largest(values: Array) -> Array:
        return jnp.max(jnp.where(slots.contacts.active, values, 0.0), axis=0, initial=0.0)

    return Residuals(
        complementarity=largest(jnp.abs(normal_impulse * normal_velocity)),
        penetration=largest(-slots.contacts.separation),
        cone=largest(norm(tangential) - limit),
        dissipation=largest(limit * norm(sliding) + dot(tangential, sliding)),
    )


def _velocity_at(bodies: Bodies, point: Vec3, body: Array) -> Vec3:
    position, velocity, angular_velocity = (
        component.map(lambda x: gather(x, body))
        for component in (bodies.position, bodies.velocity, bodies.angular_velocity)
    )
    return velocity + cross(angular_velocity, point - position)


@batch_last
def _penetration(model: Model, state: State) -> Array:
    none = jnp.zeros(state.position.shape[-1], state.position.dtype)
    if not model.scene.slot_count:
        return none
    contacts, _ = find_slots(model, unpack(state), None)
    return jnp.maximum(none, jnp.max(jnp.where(contacts.active, -contacts.separation, 0.0), axis=0))


@batch_last
def _joint_gaps(model: Model, state: State) -> JointGaps:
    scene, bodies = model.scene, unpack(state)
    count, worlds = len(scene.joints), state.position.shape[-1]
    squares = [jnp.zeros((count, worlds), state.position.dtype) for _ in range(2)]
    for group in joint_groups(scene):
        for row in group.kind.fixed_rows(joint_frames(model, bodies, group.joints)):
            # A row that forbids a translation pushes; one that forbids a rotation only turns.
            pushes = dot(row.child.linear, row.child.linear) + dot(row.parent.linear, row.parent.linear) > 0.5
            for kind, chosen in enumerate((pushes, ~pushes)):
                amount = jnp.where(chosen, row.error * row.error, 0.0)
                squares[kind] = squares[kind].at[jnp.asarray(group.joints)].add(amount)
    return JointGaps(*(safe_sqrt(square) for square in squares))
