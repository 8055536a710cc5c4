"""The motion of bodies between two impacts: constant forces, so that it is known at every time."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.bodies import Bodies, Inertia, of_all_bodies, unpack_blocks
from mathota_jax.dynamics.free_motion import rotate_at_constant_momentum
from mathota_jax.scene import Scene
from mathota_jax.spatial.quaternion import Quaternion
from mathota_jax.spatial.vector import Mat3, Vec3


class Flight(NamedTuple):
    """Bodies under constant forces, components (body, world).

    Positions are parabolas; the rotation is that of `rotate_at_constant_momentum` with the mean momentum.

    Attributes:
      position, orientation, velocity: at the start.
      acceleration: [m/s^2], with the forces of joints and contacts.
      inertia: at the start.
      momentum: angular, at the start.
      torque: its rate.
    """

    position: Vec3
    orientation: Quaternion
    velocity: Vec3
    acceleration: Vec3
    inertia: Inertia
    momentum: Vec3
    torque: Vec3

    def at(self, time: Array) -> tuple[Bodies, tuple[Vec3, Vec3]]:
        """The bodies after `time` (body or 1, world); translation and rotation vector (world frame) until then."""
        inertia = self.inertia
        shift = self.velocity * time + self.acceleration * (0.5 * time * time)
        mean = self.momentum + self.torque * (0.5 * time)
        orientation, turn = rotate_at_constant_momentum(self.orientation, inertia, mean, time)
        turned = inertia
        if inertia.rotation is not None:
            turned, turn = inertia.at(orientation), inertia.rotation.apply(turn)
        angular = turned.solve(self.momentum + self.torque * time)
        velocity = self.velocity + self.acceleration * time
        return Bodies(self.position + shift, orientation, velocity, angular), (shift, turn)


def flight(
    blocks: Bodies,
    inertia: Inertia,
    free: tuple[Vec3, Vec3],
    torque: Vec3,
    decay: float | Array,
    solved: Array,
    dt: Array,
) -> Flight:
    """The motion of the moving bodies whose velocities, after `dt`, are those solved; arguments as for `advance`."""
    linear, angular = unpack_blocks(solved)
    momentum = inertia.apply(blocks.angular_velocity)
    change = (momentum + torque * dt) * decay - momentum
    if angular is not None:
        change = change + inertia.apply(angular - free[1])
    return Flight(
        blocks.position,
        blocks.orientation,
        blocks.velocity,
        (linear - blocks.velocity) * (1.0 / dt),
        inertia,
        momentum,
        change * (1.0 / dt),
    )


def with_static(scene: Scene, bodies: Bodies, moving: Flight) -> Flight:
    """The flight of all bodies: the static ones stand."""
    inertia = moving.inertia

    def spread(vector: Vec3) -> Vec3:
        return of_all_bodies(scene, vector)

    def spread_one(component: Array) -> Array:
        return spread(Vec3(component, component, component)).x

    stands = jnp.asarray(np.asarray(scene.static, float)[:, None], moving.position.x.dtype)
    every = Inertia(
        spread_one(inertia.inverse_mass),
        spread(inertia.moments).map(lambda x: x + stands),
        None if inertia.rotation is None else Mat3(*map(spread, inertia.rotation)),
        None if inertia.frame is None else Quaternion(*map(spread_one, inertia.frame)),
    )
    return Flight(
        bodies.position,
        bodies.orientation,
        spread(moving.velocity),
        spread(moving.acceleration),
        every,
        spread(moving.momentum),
        spread(moving.torque),
    )
