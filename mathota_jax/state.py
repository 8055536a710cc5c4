"""`State`: everything that changes from step to step."""

from __future__ import annotations

import dataclasses
import enum
import operator
from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array
from jax.core import Tracer

from mathota_jax.struct import pytree


class Flag(enum.IntFlag):
    """Bits of `State.flags`. Bits stay set until the user clears them."""

    NON_FINITE = 1
    """A position or velocity of this world became NaN or infinite, or an orientation lost its length."""

    CONTACT_OVERFLOW = 2
    """More pairs were close to each other than `Options.pair_capacity`, or than fit around one body, or touched than
    `Options.touching_capacity`; the deepest were kept as far as there was room, the others passed through in this step."""

    NOT_CONVERGED = 4
    """The search for the closest points of two shapes ended at its limit; the best bound that it found was used."""

    SOLVER_NOT_CONVERGED = 8
    """`Options.solver="converged"` ended at its limit of iterations; the best impulses that it found were used."""

    INVALID_TIME_STEP = 16
    """A step was asked for with a negative or not finite `Model.dt`, or an elapsed time; nothing was done."""

    OPEN_LOOP = 32
    """A joint of a closed loop was open by a tenth of the arms of its bodies, or by 0.1 rad, at the start of a step: the
    joints contradict each other, the solver can not close them (more sweeps, smaller steps), or the state was given so."""

    INVALID_PARAMETER = 64
    """A leaf of the model is not finite or out of range: a negative friction, a restitution beyond 0 to 1, a length of a
    shape that is not positive, a negative damping, stiffness or armature of a joint, limits of a joint the wrong way round,
    a negative limit, cap or gain of a motor; or the scene was built without it: unequal moments of inertia where all moving
    bodies had equal ones, a body so large that more cells of a heightfield are below it than are searched. (A mass or a
    moment of inertia that is not positive makes the motion NaN.)"""

    DEEP_OVERLAP = 128
    """At the start of a step two bodies overlapped by more than half of the inner radius of the smaller one: the solver can
    not hold what presses it (heavy on light: `Options.conjugate`, more sweeps, another solver), something flew into it
    (smaller steps, `Options.continuous`), or the state was given so."""


@pytree
class Sleep:
    """What sleeping needs to remember; exists in scenes built with `Options.sleep`.

    Attributes:
      time: (body,) how long each body has been at rest [s].
      asleep: (body,) whether it sleeps.
      pose: (body, 7) position and orientation at the end of the last step, by which a change by the user is noticed.
    """

    time: Array
    asleep: Array
    pose: Array


@pytree
class EndForces:
    """Forces at the end of the last step, from which the small steps start; in scenes that take them alone.

    The mean forces of a step are late by half of it. Sweeps that start from them lag behind a load that changes, which
    acts like a damper of the wrong sign: a stack of twenty swayed ever more.

    Attributes:
      contact_force: (slot, 3) on body B of each contact slot, mean of the last substep [N], world frame.
      joint_force: (joint row,) mean generalized force of the last substep [N] or [N m].
      time: () length of that substep [s].
    """

    contact_force: Array
    joint_force: Array
    time: Array


@pytree
class State:
    """State of one world (or of many, with leading axes, under `jax.vmap`).

    Attributes:
      position: (body, 3) centres of mass [m], world frame. A static body may be put elsewhere between steps, but for planes,
        whose place is in the model (`shapes["plane"]`); its velocity, if given, moves and drags nothing.
      orientation: (body, 4) unit quaternions (w, x, y, z), world from body frame (as given to the builder, whatever the
        principal axes).
      velocity: (body, 3) of the centres of mass [m/s], world frame.
      angular_velocity: (body, 3) [rad/s], world frame.
      applied_force: (body, 3) force accumulated for the next step [N], world frame.
      applied_torque: (body, 3) torque about the centre of mass accumulated for the next step [N m], world frame.
      contact_force: (slot, 3) mean force of the last step on body B of each contact slot [N], world frame.
      contact_feature: (slot,) feature that held each slot in the last step, -1 for none.
      joint_force: (joint row,) mean generalized force of each joint row in the last step [N] or [N m]. Joints of one kind
        with the same features form a group; rows are numbered group (by its first joint), row (those of the kind, then
        those of the features in order), joint. `joint_forces` gives them as vectors.
      flags: () bits of `Flag`; 0 when all is well.
      contact_pair: (place,) pair that held each place of the compact groups in the last step, ``first * shapes + second``
        in the numbering of the broadphase, -1 for none; None in scenes without broadphase.
      contact_offset: (slot, 3) where each contact was in the last step, from the centre of mass of its smaller moving body,
        in inner radii of that body along the axes of the world; None unless contacts are matched by distance
        (`Options.warm_start_match`).
      sleep: timers of the sleeping system; None unless `Options.sleep`.
      end_forces: from which the small steps start; None unless a scene takes them (``Options.solver``).
    """

    in_each_world: ClassVar[bool] = True

    position: Array
    orientation: Array
    velocity: Array
    angular_velocity: Array
    applied_force: Array
    applied_torque: Array
    contact_force: Array
    contact_feature: Array
    joint_force: Array
    flags: Array
    contact_pair: Array | None = None
    contact_offset: Array | None = None
    sleep: Sleep | None = None
    end_forces: EndForces | None = None


def apply_force(state: State, body: int, force: Array, point: Array | None = None) -> State:
    """Accumulates a force on a body until the next step (guide 3.3). Differentiable.

    Args:
      state: state of one world.
      body: handle of the body; a traced one is not checked.
      force: (3,) force [N], world frame.
      point: (3,) point of application [m], world frame; None for the centre of mass.

    Returns:
      State with the force, and its torque about the centre of mass, added to what was applied before.

    Raises:
      ValueError: `body` is out of range, `force` or `point` is not a vector of three components, or the state is one of
        several worlds.
    """
    check_handle("apply_force", state, body)
    force = _vector("force", force, state)
    applied = dataclasses.replace(state, applied_force=state.applied_force.at[body].add(force))
    if point is None:
        return applied
    torque = jnp.cross(_vector("point", point, state) - state.position[body], force)
    return dataclasses.replace(applied, applied_torque=state.applied_torque.at[body].add(torque))


def check_handle(label: str, state: State, body: Any) -> None:
    """Checks that the state is that of one world and has this body; a traced handle can not be checked.

    Raises:
      ValueError: it is that of several, or has not.
    """
    if state.position.ndim != 2:
        raise ValueError(
            f"{label}: state.position must have shape (body, 3), got {state.position.shape}; use jax.vmap for several worlds"
        )
    if isinstance(body, Tracer):
        return
    count = len(state.position)
    try:
        fits = 0 <= operator.index(body) < count
    except TypeError:
        fits = False
    if not fits:
        raise ValueError(f"{label}: body must lie between 0 and {count - 1}, got {body!r}")


def _vector(name: str, value: Array, state: State) -> Array:
    """The value in the precision of the state."""
    value = jnp.asarray(value, state.position.dtype)
    if value.shape != (3,):
        raise ValueError(f"apply_force: {name} must have shape (3,), got {value.shape}")
    return value
