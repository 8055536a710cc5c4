"""Motion without constraints: accelerations, and rotation at constant angular momentum."""

from __future__ import annotations

import math

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
"""Angle [rad] up to which a turn is one step of the integrator: its energy is then right to 1e-3."""

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

    The rotation vector theta along the principal axes obeys ``theta' = dexpinv(theta) Omega(theta)`` with the body rate
    ``Omega = I^-1 exp(-theta) Pi`` for the momentum Pi along the axes at the start. Four Runge-Kutta stages with the
    inverse differential of the exponential cut after its second bracket give order four (H. Munthe-Kaas, "High order
    Runge-Kutta methods on manifolds", Appl. Numer. Math. 29, 1999). The momentum itself is never integrated. Bodies that
    may turn by more than `LARGEST_ANGLE` take the step in parts; where there is none, in all worlds, the parts are skipped.

    Returns:
      New orientation, and the rotation vector of the step: along the principal axes at its start, or in the world frame
      where all bodies are spherical and the two agree in effect.
    """
    if inertia.rotation is None:
        rotation_vector = inertia.solve(momentum) * dt
        return normalize(multiply(exponential(rotation_vector), orientation)), rotation_vector
    start = compute_once(inertia.rotation.apply_transposed(momentum), momentum.x)
    inverse = Vec3(1.0 / inertia.moments.x, 1.0 / inertia.moments.y, 1.0 / inertia.moments.z)
    theta = compute_once(_rotation_vector(inverse, start, dt), start.x)
    theta = _fast_rotation_vector(inverse, start, dt, theta)
    return normalize(multiply(orientation, exponential(inertia.to_body(theta)))), theta


def _rotation_vector(inverse: Vec3, start: Vec3, dt: Array) -> Vec3:
    """Rotation vector of a step for the momentum `start`, both along the principal axes at its start."""
    k1 = componentwise(inverse, start)
    k2 = compute_once(_rate(inverse, start, k1 * (0.5 * dt)), start.x)
    k3 = compute_once(_rate(inverse, start, k2 * (0.5 * dt)), start.x)
    k4 = _rate(inverse, start, k3 * dt)
    return (k1 + (k2 + k3) * 2.0 + k4) * (dt / 6.0)


def _looped_rotation_vector(inverse: Vec3, start: Vec3, dt: Array) -> Vec3:
    """The same in a loop over the stages: a third of the code, for what hardly ever runs."""

    def stage(carry: tuple[Vec3, Vec3], coefficients: Array) -> tuple[tuple[Vec3, Vec3], None]:
        rate, total = carry
        reach, weight = coefficients
        rate = _rate(inverse, start, rate * (reach * dt))
        return (rate, total + rate * weight), None

    k1 = componentwise(inverse, start)
    stages = jnp.asarray([(0.5, 2.0), (0.5, 2.0), (1.0, 1.0)], start.x.dtype)
    (_, total), _ = lax.scan(stage, (k1, k1), stages)
    return total * (dt / 6.0)


# Reverse mode would store what goes on inside, in 13 kernels a stage that are not worth their launch.
@jax.checkpoint
def _rate(inverse: Vec3, start: Vec3, theta: Vec3) -> Vec3:
    """``dexpinv(theta) Omega(theta)``."""
    theta = _within_half_turn(theta)
    omega = componentwise(inverse, _turn_back(theta, start))
    bracket = cross(theta, omega)
    return omega + bracket * 0.5 + cross(theta, bracket) * (1.0 / 12.0)


def _fast_rotation_vector(inverse: Vec3, start: Vec3, dt: Array, theta: Vec3) -> Vec3:
    """`theta`, but in `PARTS` parts for bodies that may turn by more than `LARGEST_ANGLE`.

    One step of order four over radians conserves the momentum and nothing else: where it ends up by chance the energy is
    anything between the momentum squared over the largest and the smallest moment.
    """
    angle = lax.stop_gradient(_largest_rate(inverse, start) * dt)
    fast = settle(jnp.where((angle > LARGEST_ANGLE) & (angle < jnp.inf), 1.0, 0.0)) > 0.5

    # Reverse mode would store every part, and fill as many arrays with zeros where the parts are skipped.
    @jax.checkpoint
    def in_parts(inverse: Vec3, start: Vec3, dt: Array, theta: Vec3) -> Vec3:
        # Beyond a radian a part there is nothing to resolve.
        slowed = jnp.where(fast, jnp.minimum(1.0, PARTS / jnp.where(fast, angle, 1.0)), 0.0)
        momentum = start * slowed

        def part(turned: Quaternion, _: None) -> tuple[Quaternion, None]:
            local = to_matrix(turned).apply_transposed(momentum)
            return normalize(multiply(turned, exponential(_looped_rotation_vector(inverse, local, dt / PARTS)))), None

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


def _within_half_turn(theta: Vec3) -> Vec3:
    """The rotation vector, shortened to half a turn: beyond it the series say nothing, and would overflow."""
    squared = dot(theta, theta)
    far = squared > math.pi**2
    return theta * lax.stop_gradient(jnp.where(far, math.pi / safe_sqrt(jnp.where(far, squared, 1.0)), 1.0))


def _turn_back(theta: Vec3, v: Vec3) -> Vec3:
    """``exp(-theta) v`` by Rodrigues' formula with its coefficients cut after the sixth power of the angle.

    Exact far beyond the order of the stages that use it.
    """
    squared = dot(theta, theta)
    first = 1.0 - squared * (1.0 / 6.0 - squared * (1.0 / 120.0 - squared / 5040.0))
    second = 0.5 - squared * (1.0 / 24.0 - squared * (1.0 / 720.0 - squared / 40320.0))
    once = cross(theta, v)
    return v - once * first + cross(theta, once) * second
