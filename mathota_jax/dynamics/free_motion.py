"""Motion without constraints: accelerations, and rotation at constant angular momentum."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax import Array

from mathota_jax.bodies import Bodies, Inertia
from mathota_jax.spatial.quaternion import Quaternion, exponential, multiply, normalize
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Vec3, cross, dot
from mathota_jax.spatial.vector import multiply as componentwise


def free_velocity(
    bodies: Bodies, inertia: Inertia, gravity: Vec3, force: Vec3, torque: Vec3, dt: Array
) -> tuple[Vec3, Vec3]:
    """Velocities at the end of a step without constraint impulses or damping (guide 4.2, with the gyroscopic term).

    Args:
      bodies, inertia: moving bodies.
      gravity: (1, world) components [m/s^2].
      force, torque: external, on each moving body, world frame.
      dt: time step [s].
    """
    linear = bodies.velocity + (gravity + force * inertia.inverse_mass) * dt
    if inertia.rotation is not None:
        torque = torque - cross(bodies.angular_velocity, inertia.apply(bodies.angular_velocity))
    return linear, bodies.angular_velocity + inertia.solve(torque) * dt


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


def _turn_back(theta: Vec3, v: Vec3) -> Vec3:
    """``exp(-theta) v`` by Rodrigues' formula with its coefficients cut after the sixth power of the angle.

    Exact far beyond the order of the stages that use it; the angle is capped at half a turn, where they say nothing.
    """
    squared = jnp.minimum(dot(theta, theta), math.pi**2)
    first = 1.0 - squared * (1.0 / 6.0 - squared * (1.0 / 120.0 - squared / 5040.0))
    second = 0.5 - squared * (1.0 / 24.0 - squared * (1.0 / 720.0 - squared / 40320.0))
    once = cross(theta, v)
    return v - once * first + cross(theta, once) * second
