"""Motion without constraints: accelerations, and rotation at constant angular momentum."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax import Array

from mathota_jax.bodies import Bodies, Inertia
from mathota_jax.spatial.quaternion import Quaternion, exponential, multiply, normalize
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Vec3, cross, dot
from mathota_jax.spatial.vector import multiply as componentwise


def free_velocity(
    bodies: Bodies, inertia: Inertia, gravity: Vec3, force: Vec3, torque: Vec3, dt: Array
) -> tuple[Vec3, Vec3]:
    """Velocities at the end of a step without constraint impulses or damping (guide 4.2, with the gyroscopic term).

    The gyroscopic term changes the direction of the angular velocity, not the energy: its explicit increment is orthogonal
    to the velocity in the metric of the inertia, so that the sum is scaled back to the energy at the start. Without that
    a body that turns by a radian or more in a step would tell the solver of a velocity that it never has.

    Args:
      bodies, inertia: moving bodies.
      gravity: (1, world) components [m/s^2].
      force, torque: external, on each moving body, world frame.
      dt: time step [s].
    """
    linear = bodies.velocity + (gravity + force * inertia.inverse_mass) * dt
    angular = bodies.angular_velocity
    if inertia.rotation is not None:
        momentum = inertia.apply(angular)
        gyroscopic = cross(momentum, angular) * dt
        turned = inertia.solve(gyroscopic)
        before, added = dot(angular, momentum), dot(turned, gyroscopic)
        total = before + added
        scale = jnp.where(total > 0, safe_sqrt(safe_divide(before, total)), 1.0)
        angular = (angular + turned) * scale
    return linear, angular + inertia.solve(torque) * dt


def rotate_at_constant_momentum(
    orientation: Quaternion, inertia: Inertia, momentum: Vec3, dt: Array
) -> tuple[Quaternion, Vec3]:
    """Turns bodies for a step during which the angular momentum in the world frame is constant.

    The rotation vector theta along the principal axes obeys ``theta' = dexpinv(theta) Omega(theta)`` with the body rate
    ``Omega = I^-1 exp(-theta) Pi`` for the momentum Pi along the axes at the start. Four Runge-Kutta stages with the
    inverse differential of the exponential cut after its second bracket give order four (H. Munthe-Kaas, "High order
    Runge-Kutta methods on manifolds", Appl. Numer. Math. 29, 1999). The momentum itself is never integrated.

    Returns:
      New orientation, and the rotation vector of the step: along the principal axes at its start, or in the world frame
      where all bodies are spherical and the two agree in effect.
    """
    if inertia.rotation is None:
        rotation_vector = inertia.solve(momentum) * dt
        return normalize(multiply(exponential(rotation_vector), orientation)), rotation_vector
    start = inertia.rotation.apply_transposed(momentum)
    inverse = Vec3(1.0 / inertia.moments.x, 1.0 / inertia.moments.y, 1.0 / inertia.moments.z)

    def rate(theta: Vec3) -> Vec3:
        theta = _within_half_turn(theta)
        omega = componentwise(inverse, _turn_back(theta, start))
        bracket = cross(theta, omega)
        return omega + bracket * 0.5 + cross(theta, bracket) * (1.0 / 12.0)

    k1 = componentwise(inverse, start)
    k2 = compute_once(rate(k1 * (0.5 * dt)), start.x)
    k3 = compute_once(rate(k2 * (0.5 * dt)), start.x)
    k4 = rate(k3 * dt)
    theta = (k1 + (k2 + k3) * 2.0 + k4) * (dt / 6.0)
    theta = compute_once(theta, start.x)
    return normalize(multiply(orientation, exponential(inertia.to_body(theta)))), theta


def _within_half_turn(theta: Vec3) -> Vec3:
    """The rotation vector, shortened to half a turn: beyond it the series say nothing, and would overflow."""
    squared = dot(theta, theta)
    far = squared > math.pi**2
    return theta * jnp.where(far, math.pi / safe_sqrt(jnp.where(far, squared, 1.0)), 1.0)


def _turn_back(theta: Vec3, v: Vec3) -> Vec3:
    """``exp(-theta) v`` by Rodrigues' formula with its coefficients cut after the sixth power of the angle.

    Exact far beyond the order of the stages that use it.
    """
    squared = dot(theta, theta)
    first = 1.0 - squared * (1.0 / 6.0 - squared * (1.0 / 120.0 - squared / 5040.0))
    second = 0.5 - squared * (1.0 / 24.0 - squared * (1.0 / 720.0 - squared / 40320.0))
    once = cross(theta, v)
    return v - once * first + cross(theta, once) * second
