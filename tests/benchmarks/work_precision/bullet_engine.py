"""The scenes in PyBullet (Bullet 3 in C++, one thread, one call a step), where it is installed.

"default" is what it does when nothing is set but damping; "tuned" has 200 iterations for 50 and no threshold of
restitution.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mathota_jax import Box, Plane, Sphere
from tests.benchmarks.work_precision.one_world import OneWorldProgram
from tests.benchmarks.work_precision.scenes import Scene
from tests.benchmarks.work_precision.worlds import Motion

try:
    import pybullet
except ImportError:
    pybullet = None

PROFILES = {"default": {}, "tuned": {"numSolverIterations": 200, "restitutionVelocityThreshold": 0.0}}


def missing() -> str | None:
    """Why PyBullet can not take part, or None."""
    return "not installed (pip install pybullet)" if pybullet is None else None


def _scalar_last(quaternion: np.ndarray) -> np.ndarray:
    return np.roll(quaternion, -1)


class BulletProgram(OneWorldProgram):
    """One scene of free bodies at one profile and time step."""

    def __init__(self, scene: Scene, profile: str, dt: float):
        super().__init__(scene, dt)
        self.client = pybullet.connect(pybullet.DIRECT)
        self._call(pybullet.setGravity, *scene.world.gravity)
        self._call(pybullet.setPhysicsEngineParameter, fixedTimeStep=dt, **PROFILES[profile])
        self.bodies = []
        for body in scene.world.bodies:
            handle = self._call(
                pybullet.createMultiBody,
                baseMass=body.mass or 0.0,
                baseCollisionShapeIndex=self._shape(body.shape),
                basePosition=tuple(map(float, self._place(body))),
            )
            # Bullet multiplies the coefficients of a pair.
            surface = {"lateralFriction": body.friction**0.5, "restitution": body.restitution**0.5}
            still = {"linearDamping": 0.0, "angularDamping": 0.0, "spinningFriction": 0.0, "rollingFriction": 0.0}
            self._call(pybullet.changeDynamics, handle, -1, **surface, **still)
            if body.mass is not None:
                self.bodies.append(handle)

    def _call(self, function: Callable, *values: object, **named: object):
        return function(*values, **named, physicsClientId=self.client)

    def _place(self, body: object) -> np.ndarray:
        shape = body.shape
        return shape.offset * shape.normal if isinstance(shape, Plane) else np.array(body.position, float)

    def _shape(self, shape: object) -> int:
        make = pybullet.createCollisionShape
        if isinstance(shape, Plane):
            return self._call(make, pybullet.GEOM_PLANE, planeNormal=shape.normal.tolist())
        if isinstance(shape, Sphere):
            return self._call(make, pybullet.GEOM_SPHERE, radius=shape.radius)
        if isinstance(shape, Box):
            return self._call(make, pybullet.GEOM_BOX, halfExtents=shape.half_extents.tolist())
        return self._call(make, pybullet.GEOM_MESH, vertices=np.asarray(shape.vertices).tolist())

    def _reset(self, world: int) -> None:
        for body, handle in enumerate(self.bodies):
            turn = _scalar_last(self.start.orientation[world, body]).tolist()
            self._call(
                pybullet.resetBasePositionAndOrientation, handle, self.start.position[world, body].tolist(), turn
            )
            speeds = (self.start.velocity[world, body].tolist(), self.start.angular_velocity[world, body].tolist())
            self._call(pybullet.resetBaseVelocity, handle, *speeds)

    def _motion(self) -> Motion:
        poses = [self._call(pybullet.getBasePositionAndOrientation, handle) for handle in self.bodies]
        speeds = [self._call(pybullet.getBaseVelocity, handle) for handle in self.bodies]
        return Motion(
            np.array([pose[0] for pose in poses]),
            np.roll(np.array([pose[1] for pose in poses]), 1, axis=-1),
            np.array([speed[0] for speed in speeds]),
            np.array([speed[1] for speed in speeds]),
        )

    def _advance(self, steps: int) -> None:
        for _ in range(steps):
            pybullet.stepSimulation(physicsClientId=self.client)
