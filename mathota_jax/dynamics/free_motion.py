"""Motion without constraints: accelerations, and rotation at constant angular momentum."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.bodies import Bodies, Inertia
from mathota_jax.spatial.quaternion import Quaternion, exponential, logarithm, multiply, normalize, to_matrix
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import compute_once, settle
from mathota_jax.spatial.vector import Vec3, cross, dot, where
from mathota_jax.spatial.vector import multiply as componentwise

LARGEST_ANGLE = 0.5
"""Angle [rad] up to which a turn is one step of the integrator: its energy is then right to 4e-4, that of a box to 3e-5."""

PARTS = 16
"""Parts of the turn of faster bodies."""


def free_velocity(
    bodies: Bodies, inertia: Inertia, carried: Vec3 | None, gravity: Vec3, force: Vec3, torque: Vec3, dt: Array
) -> tuple[Vec3, Vec3]:
    """Velocities at the end of a step without constraint impulses or damping (guide 4.2, with the gyroscopic term).

    The gyroscopic term changes the direction of the angular velocity, not the energy: its explicit increment is orthogonal
    to the velocity in the metric of the inertia, so that the sum is scaled back to the energy at the start. Without that
    a body that turns by a radian or more in a step would tell the solver of a velocity that it never has.

    Args:
      bodies, inertia: moving bodies.
      carried: angular velocities that already have the gyroscopic term, see `drift`; None where there are none.
      gravity: (1, world) components [m/s^2].
      force, torque: external, on each moving body, world frame.
      dt: time step [s].
    """
    linear = bodies.velocity + (gravity + force * inertia.inverse_mass) * dt
    angular = bodies.angular_velocity if carried is None else carried
    if inertia.rotation is not None and carried is None:
        momentum = inertia.apply(angular)
        gyroscopic = cross(momentum, angular) * dt
        turned = inertia.solve(gyroscopic)
        before, added = dot(angular, momentum), dot(turned, gyroscopic)
        total = before + added
        scale = jnp.where(total > 0, safe_sqrt(safe_divide(before, total)), 1.0)
        angular = (angular + turned) * scale
    return linear, angular + inertia.solve(torque) * dt


def drift(bodies: Bodies, inertia: Inertia, time: Array) -> tuple[Inertia, Bodies]:
    """Bodies after some time without forces, and their inertia there.

    What joints do, they do at the middle of the step: rows of that moment need its inertia too, and the momentum that the
    bodies bring along. A torque across a thin rod, seen from where the rod was or will be, has a part along it, where the
    moment is thousands of times less; and so has a momentum that does not belong to the way the rod has turned.

    Args:
      bodies, inertia: moving bodies, not all spherical, at the start.
      time: until then [s].
    """
    momentum = inertia.apply(bodies.angular_velocity)
    orientation, _ = rotate_at_constant_momentum(bodies.orientation, inertia, momentum, time)
    there = inertia.at(orientation)
    angular = there.solve(momentum)
    # For bodies that turn too fast to be followed.
    energy, found = dot(bodies.angular_velocity, momentum), dot(angular, momentum)
    angular = angular * jnp.where(found > 0, safe_sqrt(safe_divide(energy, found)), 1.0)
    return there, Bodies(bodies.position + bodies.velocity * time, orientation, bodies.velocity, angular)


def rotate_at_constant_momentum(
    orientation: Quaternion, inertia: Inertia, momentum: Vec3, dt: Array
) -> tuple[Quaternion, Vec3]:
    """Turns bodies for a step during which the angular momentum in the world frame is constant.

    The rotation vector theta along the principal axes obeys ``theta' = dexpinv(theta) Omega`` with the body rate
    ``Omega = I^-1 L`` for the momentum ``L' = L x Omega`` along the turning axes. Its Taylor series is cut after the fourth
    power of the time t (compare the Magnus expansion: S. Blanes, F. Casas, J. A. Oteo, J. Ros, Phys. Rep. 470, 2009)::

        Omega t + Omega' t^2/2 + (Omega'' + Omega x Omega' / 2) t^3/6 + (Omega''' + Omega x Omega'') t^4/24

    The momentum in the world is never integrated. All derivatives are those at one point of the true motion, so that the
    small moment of a thin rod divides nothing but what is small with it; stages beside the motion, as in a Runge-Kutta
    method, give a rod that turns by a quarter of a radian thousands of times its energy. Bodies that may turn by more than
    `LARGEST_ANGLE` take the step in parts; where there is none, in all worlds, the parts are skipped.

    Returns:
      New orientation, and the rotation vector of the step: along the principal axes at its start, or in the world frame
      where all bodies are spherical and the two agree in effect.
    """
    if inertia.rotation is None:
        rotation_vector = inertia.solve(momentum) * dt
        return normalize(multiply(exponential(rotation_vector), orientation)), rotation_vector
    start = compute_once(inertia.rotation.apply_transposed(momentum), momentum.x)
    inverse = Vec3(1.0 / inertia.moments.x, 1.0 / inertia.moments.y, 1.0 / inertia.moments.z)
    angle = lax.stop_gradient(_largest_rate(inverse, start) * dt)
    fast = settle(jnp.where(angle > LARGEST_ANGLE, 1.0, 0.0)) > 0.5
    # A single step would overflow for them, and its series say nothing.
    slow = start.map(lambda x: jnp.where(fast, 0.0, x))
    theta = compute_once(_rotation_vector(inverse, slow, dt), start.x)
    theta = _fast_rotation_vector(inverse, start, dt, theta, angle, fast)
    return normalize(multiply(orientation, exponential(inertia.to_body(theta)))), theta


# Reverse mode would store every product, in kernels that are not worth their launch.
@jax.checkpoint
def _rotation_vector(inverse: Vec3, start: Vec3, dt: Array) -> Vec3:
    """Rotation vector of a step for the momentum `start`, both along the principal axes at its start."""
    # Derivatives of the momentum along the turning axes and of the rate, times the powers of dt that go with them.
    momentum = start * dt
    rate = componentwise(inverse, momentum)
    momentum1 = cross(momentum, rate)
    rate1 = componentwise(inverse, momentum1)
    momentum2 = cross(momentum1, rate) + cross(momentum, rate1)
    rate2 = componentwise(inverse, momentum2)
    momentum3 = cross(momentum2, rate) + cross(momentum1, rate1) * 2.0 + cross(momentum, rate2)
    rate3 = componentwise(inverse, momentum3)
    third = rate2 + cross(rate, rate1) * 0.5
    fourth = rate3 + cross(rate, rate2)
    return rate + rate1 * 0.5 + third * (1.0 / 6.0) + fourth * (1.0 / 24.0)


def _fast_rotation_vector(inverse: Vec3, start: Vec3, dt: Array, theta: Vec3, angle: Array, fast: Array) -> Vec3:
    """`theta`, but in `PARTS` parts for the bodies that are `fast`, which may turn by `angle`.

    One step of order four over radians conserves the momentum and nothing else: where it ends up by chance the energy is
    anything between the momentum squared over the largest and the smallest moment.
    """

    # Reverse mode would store every part, and fill as many arrays with zeros where the parts are skipped.
    @jax.checkpoint
    def in_parts(inverse: Vec3, start: Vec3, dt: Array, theta: Vec3) -> Vec3:
        # Beyond a radian a part there is nothing to resolve.
        slowed = jnp.where(fast, jnp.minimum(1.0, PARTS / jnp.where(fast, angle, 1.0)), 0.0)
        momentum = start * slowed

        def part(turned: Quaternion, _: None) -> tuple[Quaternion, None]:
            local = to_matrix(turned).apply_transposed(momentum)
            return normalize(multiply(turned, exponential(_rotation_vector(inverse, local, dt / PARTS)))), None

        one, zero = jnp.ones_like(start.x), jnp.zeros_like(start.x)
        turned, _ = lax.scan(part, Quaternion(one, zero, zero, zero), None, length=PARTS)
        return where(fast, logarithm(turned), theta)

    return lax.cond(fast.any(), in_parts, lambda inverse, start, dt, theta: theta, inverse, start, dt, theta)


def _largest_rate(inverse: Vec3, momentum: Vec3) -> Array:
    """Largest angular speed of a free body on its way, from its momentum and energy.

    The squares of the components of the momentum add up to that of the momentum, divided by the moments to twice the
    energy: the square of the speed, linear in them, is largest with the largest and the smallest moment alone. (The momentum
    over the smallest moment would be thousands of times too much for a thin rod that does not spin.)
    """
    largest = jnp.maximum(jnp.maximum(inverse.x, inverse.y), inverse.z)
    smallest = jnp.minimum(jnp.minimum(inverse.x, inverse.y), inverse.z)
    energy = dot(momentum, componentwise(inverse, momentum))
    return jnp.sqrt(jnp.maximum(energy * largest + (energy - dot(momentum, momentum) * largest) * smallest, 0.0))
