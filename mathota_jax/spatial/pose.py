"""Placement of a rigid body in the world."""

from __future__ import annotations

from typing import NamedTuple

from mathota_jax.spatial.vector import Mat3, Vec3


class Pose(NamedTuple):
    """Position [m] and rotation (world from body) of a shape; components of shape ``(element, world)``.

    `rotation` is None for shapes whose contacts do not depend on it (sphere, plane), so that scenes of spheres alone
    trace no rotation maths.
    """

    position: Vec3
    rotation: Mat3 | None = None

    def point_to_world(self, point: Vec3) -> Vec3:
        """Maps a point from the body frame to the world frame."""
        assert self.rotation is not None
        return self.position + self.rotation.apply(point)

    def point_to_local(self, point: Vec3) -> Vec3:
        """Maps a point from the world frame to the body frame."""
        assert self.rotation is not None
        return self.rotation.apply_transposed(point - self.position)
