"""The bodies of a scene in the form the engine computes with: components apart, worlds last."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.spatial.indexing import take, unstack
from mathota_jax.spatial.quaternion import Quaternion, to_matrix
from mathota_jax.spatial.quaternion import multiply as multiply_quaternions
from mathota_jax.spatial.settle import store_cotangents
from mathota_jax.spatial.vector import Mat3, Vec3, multiply
from mathota_jax.state import State


class Inertia(NamedTuple):
    """Mass properties of bodies, components of shape (body, world).

    Attributes:
      inverse_mass: [1/kg].
      moments: principal moments about the centre of mass [kg m^2].
      rotation: of the principal axes, world frame; None where all bodies are spherical.
      frame: principal axes in the body frame; None where they are the axes of all bodies.
    """

    inverse_mass: Array
    moments: Vec3
    rotation: Mat3 | None
    frame: Quaternion | None = None

    def at(self, orientation: Quaternion) -> Inertia:
        """The inertia of bodies that are not all spherical, turned to other orientations."""
        return self._replace(rotation=to_matrix(_principal(orientation, self.frame)))

    def to_body(self, principal: Vec3) -> Vec3:
        """Components along the axes of the body of a vector given along the principal axes."""
        return principal if self.frame is None else to_matrix(self.frame).apply(principal)

    def apply(self, angular_velocity: Vec3) -> Vec3:
        """Angular momentum of an angular velocity, world frame."""
        if self.rotation is None:
            return multiply(self.moments, angular_velocity)
        local = store_cotangents(self.rotation.apply_transposed(angular_velocity))
        return store_cotangents(self.rotation.apply(multiply(self.moments, local)))

    def solve(self, torque: Vec3) -> Vec3:
        """Inverse inertia times a vector, world frame."""
        if self.rotation is None:
            return Vec3(torque.x / self.moments.x, torque.y / self.moments.y, torque.z / self.moments.z)
        local = store_cotangents(self.rotation.apply_transposed(torque))
        local = Vec3(local.x / self.moments.x, local.y / self.moments.y, local.z / self.moments.z)
        return store_cotangents(self.rotation.apply(local))

    def inverse(self) -> InverseInertia:
        """The inverse in the world frame."""
        inverse = Vec3(1.0 / self.moments.x, 1.0 / self.moments.y, 1.0 / self.moments.z)
        if self.rotation is None:
            return InverseInertia(self.inverse_mass, inverse, None)
        axes = list(zip(inverse, self.rotation, strict=True))

        def entry(row: int, column: int) -> Array:
            terms = [moment * axis[row] * axis[column] for moment, axis in axes]
            return terms[0] + terms[1] + terms[2]

        diagonal = Vec3(*(entry(k, k) for k in range(3)))
        return InverseInertia(self.inverse_mass, diagonal, Vec3(entry(1, 2), entry(0, 2), entry(0, 1)))


class InverseInertia(NamedTuple):
    """Inverse mass properties of bodies in the world frame, components of shape (body, world).

    Attributes:
      inverse_mass: [1/kg].
      diagonal: of the inverse inertia [1/(kg m^2)].
      products: its entries yz, xz and xy; None where all bodies are spherical.
    """

    inverse_mass: Array
    diagonal: Vec3
    products: Vec3 | None

    def solve(self, torque: Vec3) -> Vec3:
        """Inverse inertia times a vector."""
        along = multiply(self.diagonal, torque)
        if self.products is None:
            return along
        yz, xz, xy = self.products
        return along + Vec3(xy * torque.y + xz * torque.z, xy * torque.x + yz * torque.z, xz * torque.x + yz * torque.y)


def unpack_inverse(entries: Sequence[Array]) -> InverseInertia:
    """From its entries in order: inverse mass, diagonal and products."""
    mass, *inverse = entries
    return InverseInertia(mass, Vec3(*inverse[:3]), Vec3(*inverse[3:]) if inverse[3:] else None)


class Bodies(NamedTuple):
    """All bodies, static ones included; components of shape (body, world)."""

    position: Vec3
    orientation: Quaternion
    velocity: Vec3
    angular_velocity: Vec3


class Edges(NamedTuple):
    """Connections of bodies: handles `first` and `second`, and whether each exists; all of shape (edge, world or 1)."""

    first: Array
    second: Array
    active: Array


def vector(array: Array) -> Vec3:
    """Components of an (element, 3, world) array."""
    return Vec3(*unstack(array, 1))


def quaternion(array: Array) -> Quaternion:
    """Components of an (element, 4, world) array."""
    return Quaternion(*unstack(array, 1))


def unpack(state: State) -> Bodies:
    """Bodies of a worlds-last state."""
    return Bodies(
        vector(state.position), quaternion(state.orientation), vector(state.velocity), vector(state.angular_velocity)
    )


def moving(scene: Scene, bodies: Bodies) -> Bodies:
    """The bodies that are not static, in order: the velocity blocks of the solver."""
    return take(bodies, scene.dynamic_bodies)


def of_all_bodies(scene: Scene, blocks: Vec3) -> Vec3:
    """Values of all bodies from those of the moving ones; 0 for the static ones."""
    block_of = {body: block for block, body in enumerate(scene.dynamic_bodies)}
    index = [block_of.get(body, len(block_of)) for body in range(scene.body_count)]
    return take(blocks.map(lambda x: jnp.concatenate([x, jnp.zeros_like(x[:1])])), index)


def merge(scene: Scene, bodies: Bodies, moved: Bodies) -> Bodies:
    """All bodies, the moving ones at their new place."""
    return jax.tree.map(lambda old, new: place(scene, old[:, None], [new])[:, 0], bodies, moved)


def place(scene: Scene, old: Array, components: Sequence[Array]) -> Array:
    """(body, component, world) array: static bodies from `old`, the others from components of shape (moving, world)."""
    worlds = max(old.shape[-1], *(component.shape[-1] for component in components))
    moving_count = len(scene.dynamic_bodies)
    new = jnp.stack([jnp.broadcast_to(component, (moving_count, worlds)) for component in components], axis=1)
    # Runs of bodies that are all moving or all static; a concatenation of slices is cheaper than a gather.
    parts, start = [], 0
    for is_static, run in itertools.groupby(range(scene.body_count), key=lambda body: scene.static[body]):
        bodies = list(run)
        if is_static:
            parts.append(jnp.broadcast_to(take(old, bodies), (len(bodies), *new.shape[1:])))
        else:
            parts.append(new[start : start + len(bodies)])
            start += len(bodies)
    return jnp.concatenate(parts)


def moving_inertia(scene: Scene, model: Model, orientation: Quaternion) -> Inertia:
    """Mass properties of the moving bodies at the given orientations.

    Masses and moments that are not positive, where a fit may end, become NaN, so that the flags tell of them.
    """
    given = take((model.mass, vector(model.inertia)), scene.dynamic_bodies)
    mass, moments = jax.tree.map(lambda value: jnp.where(value > 0, value, jnp.nan), given)
    if scene.all_spherical:
        return Inertia(1.0 / mass, moments, None)
    frame = None if model.inertia_frame is None else take(quaternion(model.inertia_frame), scene.dynamic_bodies)
    return Inertia(1.0 / mass, moments, to_matrix(_principal(orientation, frame)), frame)


def _principal(orientation: Quaternion, frame: Quaternion | None) -> Quaternion:
    return orientation if frame is None else multiply_quaternions(orientation, frame)


def pack_blocks(linear: Vec3, angular: Vec3 | None) -> Array:
    """(component, block, world) array of generalized velocities; `angular` is None where nothing couples to rotation."""
    components = tuple(linear) if angular is None else (*linear, *angular)
    shape = jnp.broadcast_shapes(*(component.shape for component in components))
    return jnp.stack([jnp.broadcast_to(component, shape) for component in components])


def unpack_blocks(velocity: Array) -> tuple[Vec3, Vec3 | None]:
    """Linear and angular part of blocks."""
    components = unstack(velocity, 0)
    return Vec3(*components[:3]), Vec3(*components[3:]) if len(components) == 6 else None


def momentum(inertia: Inertia, velocity: Array) -> Array:
    """Of the blocks of a velocity (component, block, world), likewise."""
    linear, angular = unpack_blocks(velocity)
    return pack_blocks(linear * (1.0 / inertia.inverse_mass), None if angular is None else inertia.apply(angular))


def respond_alone(inertia: Inertia, impulse: Array) -> Array:
    """Velocities (component, block, ..., world) that impulses on bodies, likewise, give to each by itself."""
    linear, angular = unpack_blocks(impulse)
    assert angular is not None
    return pack_blocks(linear * inertia.inverse_mass, inertia.solve(angular))


def smaller_moving(model: Model, first: Sequence[int], second: Sequence[int]) -> Array:
    """(pair or 1, world) inner radius of the smaller moving body of each pair; infinite if none moves."""
    static = np.asarray(model.scene.static)
    sizes = [jnp.where(static[np.asarray(side)][:, None], jnp.inf, take(model.size, side)) for side in (first, second)]
    return jnp.minimum(*sizes)
