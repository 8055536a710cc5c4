"""`smoothed_step`: the values of `step`, with derivatives that feel contacts from a distance.

Bodies that miss each other do not know of each other: the derivative of where the target ends by how the ball was thrown is
exactly 0, and no descent finds the hit. In the backward pass alone, this step lets bodies that approach each other feel a
part of the impulse that they would pass on if they met (A. Paulus et al., "Hard contacts with soft gradients", 2025,
arXiv:2506.14186: contacts from a distance, straight through).

The surfaces are taken to meet at a gap that is not 0 but random with density ``w(gap / reach) / reach`` (randomized
smoothing: H. J. T. Suh, T. Pang, R. Tedrake, "Bundled gradients through contact via randomized smoothing", 2022). The
expected impulse per time, with v the speed of approach and m the reduced mass, is the force

    F(gap) = (1 + restitution) m v^2 w(gap / reach) / reach,    w(s) = s^2 exp(-s) / 2,

so that all of the approach together passes on one impulse. A share of its derivative by the gap is added to that of the
step, the force itself is not. The density vanishes at the surface, so that over an approach that ends in a head-on impact
the added velocities cancel; the places that they have moved until then do not: a real impact's derivatives are biased by
the same share.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.diagnostics import Contacts, contacts
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.state import State
from mathota_jax.step import step


def smoothed_step(
    model: Model, state: State, action: Array | None = None, *, reach: float, strength: float = 0.1
) -> State:
    """`step`, bitwise, whose derivatives feel contacts from a distance of about `reach`.

    Arguments, result and errors as for `step`; to be used with `long_rollout` as
    ``stepper=functools.partial(smoothed_step, reach=0.1)``. Both modes of differentiation work.

    What is added to the exact derivatives is `strength` times that of the expected force by the gap, normal to the surfaces
    (see the module); speeds and masses count as constants. Where bodies really meet, the derivatives are biased in
    proportion: by about half the strength for a ball after a head-on impact. Pairs that part, rest or overlap add nothing.
    A broadphase (`Options.broadphase`) finds no pair that is further apart than its margin.

    Args:
      model: parameters and static scene.
      state: state of one world.
      action: (motor,) as for `step`.
      reach: [m], positive. What pulls bodies together peaks at a gap of 3.4 times this and is 5 % of that at 9 times.
      strength: positive share of an impact that is felt: how loud a miss is beside the exact derivatives.

    Raises:
      ValueError: as `step`, or a reach or strength that is not positive.
    """
    if not reach > 0:
        raise ValueError(f"smoothed_step: reach must be a positive length [m], got {reach!r}")
    if not strength > 0:
        raise ValueError(f"smoothed_step: strength must be positive, got {strength!r}")
    if not model.scene.slot_count:
        return step(model, state, action)
    force, torque = jax.checkpoint(lambda model, state: _expected_forces(model, state, reach, strength))(model, state)
    felt = dataclasses.replace(
        state,
        applied_force=state.applied_force + _tangent_only(force),
        applied_torque=state.applied_torque + _tangent_only(torque),
    )
    return step(model, felt, action)


@jax.custom_jvp
def _tangent_only(value: Array) -> Array:
    """Zeros with the derivative of `value`; where nothing is differentiated `value` is never computed."""
    return jnp.zeros_like(value)


@_tangent_only.defjvp
def _tangent_only_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return jnp.zeros_like(primals[0]), tangents[0]


def _expected_forces(model: Model, state: State, reach: float, share: float) -> tuple[Array, Array]:
    """Forces and torques (body, 3) by which the bodies of every pair would feel each other from afar."""
    scene = model.scene
    held, constants = lax.stop_gradient((state, model))
    # The gap depends on poses and shapes alone, and nothing else is differentiated.
    placed = dataclasses.replace(held, position=state.position, orientation=state.orientation)
    found = contacts(dataclasses.replace(constants, shapes=model.shapes), placed)
    fixed = lax.stop_gradient(found)
    sides = (fixed.body_a, fixed.body_b)
    arms = [fixed.position - held.position[body] for body in sides]
    speeds = [
        held.velocity[body] + jnp.cross(held.angular_velocity[body], arm) for body, arm in zip(sides, arms, strict=True)
    ]
    approach = jnp.maximum(-jnp.sum(fixed.normal * (speeds[1] - speeds[0]), axis=-1), 0.0)
    strength = share * _stopping_mass(constants, fixed) * approach**2 / reach
    depth = jnp.where(found.active, jnp.maximum(found.separation, 0.0), 0.0) / reach
    force = (strength * 0.5 * depth**2 * jnp.exp(-depth))[:, None] * fixed.normal
    total, torque = jnp.zeros_like(state.velocity), jnp.zeros_like(state.velocity)
    for body, arm, sign in zip(sides, arms, (-1.0, 1.0), strict=True):
        total = total.at[body].add(sign * force)
        torque = torque.at[body].add(sign * jnp.cross(arm, force))
    moves = jnp.asarray(~np.asarray(scene.static))[:, None]
    return jnp.where(moves, total, 0.0), jnp.where(moves, torque, 0.0)


def _stopping_mass(model: Model, found: Contacts) -> Array:
    """(slot,) reduced mass times 1 + restitution, shared among the points of a manifold."""
    inverse = jnp.where(jnp.asarray(model.scene.static), 0.0, 1.0 / model.mass)
    inverses = inverse[found.body_a] + inverse[found.body_b]
    share = 1.0 / jnp.asarray(_points_of_slots(model.scene), model.mass.dtype)
    restitution = jnp.minimum(model.restitution[found.body_a], model.restitution[found.body_b])
    return jnp.where(found.active, (1.0 + restitution) * share / inverses, 0.0)


def _points_of_slots(scene: Scene) -> np.ndarray:
    """(slot,) number of points of the manifold that each slot of `contacts` belongs to."""
    groups = (*scene.pair_groups, *scene.compact_groups)
    return np.concatenate([np.full(group.slot_count, group.point_count) for group in groups])
