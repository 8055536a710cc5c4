"""From solved velocities to the state at the end of the step."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from mathota_jax.bodies import Bodies, Inertia, unpack_blocks
from mathota_jax.dynamics.free_motion import rotate_at_constant_momentum
from mathota_jax.spatial.quaternion import exponential, multiply, normalize, rotate, turn_between
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import compute_once, materialize, settle
from mathota_jax.spatial.vector import Vec3, dot, where

LARGEST_GAIN = 0.01
"""Share of the energy of its turning that a body may seem to gain in a step by turning alone."""


def advance(
    bodies: Bodies,
    inertia: Inertia,
    acting: Inertia,
    halfway: Bodies | None,
    free: tuple[Vec3, Vec3],
    torque: Vec3,
    decay: float | Array,
    solved: Array,
    lever: Array | None,
    dt: Array,
    beyond: Array | None = None,
    gained: Array | None = None,
) -> tuple[Bodies, tuple[Vec3, Vec3]]:
    """Moves the bodies through one step (guide 11.1, phase 6).

    Positions are exact for constant forces: ``x + dt (v_start + v_free) / 2`` plus what the constraints add over
    their lever. Rotation keeps the angular momentum of the step, which is exact between contacts.

    Args:
      bodies, inertia: moving bodies at the start of the step.
      acting: inertia with which they responded to the impulses.
      halfway: where they did so, at the middle of the step, with that inertia; None if at its start.
      free: linear and angular velocity at the end of the step without constraints.
      torque: external torque, world frame.
      decay: factor by which damping reduces the angular momentum in this step.
      solved: (component, block, world) velocities with all constraint impulses.
      lever: (block, world) time [s] that the velocity change by the constraints had to act on the position.
      dt: time step.
      beyond: (component, block, world) what they move the bodies more than that, as `gained`.
      gained: (component, block, world) displacement by the constraints where it is known itself, in place of the lever.

    Returns:
      Bodies at the end of the step; translation and rotation vector (world frame) of the step.
    """
    free_linear, free_angular = free
    solved_linear, solved_angular = unpack_blocks(solved)
    gained_linear, gained_angular = (None, None) if gained is None else unpack_blocks(gained)
    beyond_linear, beyond_angular = (None, None) if beyond is None else unpack_blocks(beyond)
    if gained_linear is None:
        assert lever is not None
        gained_linear = (solved_linear - free_linear) * lever
        if beyond_linear is not None:
            gained_linear = gained_linear + beyond_linear
    shift = (bodies.velocity + free_linear) * (0.5 * dt) + gained_linear
    start = inertia.apply(bodies.angular_velocity)
    end = (start + torque * dt) * decay
    mean = (start + end) * 0.5
    if solved_angular is not None:
        change = acting.apply(solved_angular - free_angular)
        end = end + change
        if gained_angular is not None:
            mean = mean + inertia.apply(gained_angular) / dt
        else:
            assert lever is not None
            mean = mean + change * (lever / dt)
            if beyond_angular is not None:
                mean = mean + acting.apply(beyond_angular) / dt
    mean, end, shift = compute_once((mean, end, shift), bodies.position.x)
    if halfway is None:
        orientation, turn = rotate_at_constant_momentum(bodies.orientation, inertia, mean, dt)
        orientation = compute_once(orientation, bodies.position.x)
    else:
        # The first half had the momentum of the start.
        orientation, _ = rotate_at_constant_momentum(halfway.orientation, acting, mean * 2.0 - start, 0.5 * dt)
        orientation = compute_once(orientation, bodies.position.x)
        turn = turn_between(bodies.orientation, orientation)
    if inertia.rotation is None:
        angular = inertia.solve(end)
    else:
        turned = inertia.at(orientation)
        angular = turned.solve(end)
        # One refinement: round-off of the solve alone drifts (measured: 1.2e-4 of the momentum in 1000 float32 steps).
        angular = angular + jax.lax.stop_gradient(turned.solve(end - turned.apply(angular)))
        if solved_angular is None:
            angular = _with_energy(acting, free_angular, angular, end, turn)
        else:
            angular = _with_energy(acting, solved_angular, angular, end, turn, turned)
        # Else its expressions end in the array of the new state, and are worked out element by element.
        angular = materialize(angular)
        turn = inertia.rotation.apply(turn) if halfway is None else turn
    moved = Bodies(bodies.position + shift, orientation, solved_linear, angular)
    return moved, (shift, turn)


def _with_energy(
    acting: Inertia, before: Vec3, after: Vec3, momentum: Vec3, turn: Vec3, turned: Inertia | None = None
) -> Vec3:
    """The angular velocity `after` of the momentum at the end of a step, but where its energy says that it is wrong.

    Beyond a radian in a step the orientation at the end, and with it the energy that belongs to the momentum, is a matter
    of chance, which contacts would turn into ever more momentum: there the energy is kept, not the momentum.

    So it is where a body was hit and has turned since. The impulse was across a rod, and has a part along it where the rod
    is now, where the moment is hundreds of times less: a pencil that fell from 1 m jumped to 4.5 m (1/60 s). There the rates
    about its own axes are those that the impulse left.

    Args:
      acting: inertia with which the bodies responded.
      before: angular velocity then.
      after, momentum: at the end of the step.
      turn: rotation vector of the step.
      turned: inertia at the end of the step, of bodies that may have been hit; None where nothing hits.
    """
    unresolved = dot(turn, turn) > 1.0
    energy, found = dot(before, acting.apply(before)), dot(after, momentum)
    ratio = safe_divide(energy, jnp.where(unresolved, found, 1.0))
    after = after * jnp.where(unresolved, safe_sqrt(ratio), 1.0)
    if turned is None:
        return after
    assert acting.rotation is not None and turned.rotation is not None
    gains = settle(jnp.where(~unresolved & (found > (1.0 + LARGEST_GAIN) * energy), 1.0, 0.0)) > 0.5
    return where(gains, turned.rotation.apply(acting.rotation.apply_transposed(before)), after)


def displace(bodies: Bodies, inertia: Inertia, displacement: Array) -> Bodies:
    """Applies the displacement (component, block, world) of the position correction.

    The angular velocity of a body that is not spherical turns with it, so that its energy stays.
    """
    linear, angular = unpack_blocks(displacement)
    moved = bodies._replace(position=bodies.position + linear)
    if angular is None:
        return moved
    turn = exponential(angular)
    moved = moved._replace(orientation=normalize(multiply(turn, bodies.orientation)))
    if inertia.rotation is None:
        return moved
    return moved._replace(angular_velocity=rotate(turn, bodies.angular_velocity))
