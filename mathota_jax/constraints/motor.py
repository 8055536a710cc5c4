"""Motors that exert what the action says; those with a target are rows of their joint."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.bodies import Bodies
from mathota_jax.constraints.joints import JOINTS
from mathota_jax.constraints.joints.frames import joint_frames
from mathota_jax.constraints.row_coefficients import motor_command
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.vector import Vec3


def exert_torque(scene: Scene) -> bool:
    """Whether any motor is a torque motor."""
    return any(motor.kind == "torque" for motor in scene.motors)


def motor_forces(model: Model, bodies: Bodies, action: Array) -> tuple[Vec3, Vec3]:
    """Forces and torques of the torque motors on all bodies, components (body, world).

    Args:
      model: parameters.
      bodies: all bodies.
      action: (motor, world); clipped to the limit of each motor and multiplied by its gear.
    """
    scene = model.scene
    effort = motor_command(model, action)
    worlds = max(effort.shape[-1], bodies.position.x.shape[-1])
    totals = [jnp.zeros((scene.body_count, worlds), effort.dtype) for _ in range(6)]
    for kind_name, kind in JOINTS.items():
        motors = [
            motor
            for motor, entry in enumerate(scene.motors)
            if entry.kind == "torque" and scene.joints[entry.joint].kind == kind_name
        ]
        if not motors:
            continue
        assert kind.coordinate is not None
        joints = tuple(scene.motors[motor].joint for motor in motors)
        sides = kind.coordinate.sides(joint_frames(model, bodies, joints))
        chosen = take(effort, motors)
        for side, name in zip(sides, ("parent", "child"), strict=True):
            receivers = np.asarray([getattr(scene.joints[joint], name) for joint in joints])
            assert side.angular is not None
            for axis, component in enumerate((*side.linear, *side.angular)):
                totals[axis] = totals[axis].at[receivers].add(component * chosen)
    return Vec3(*totals[:3]), Vec3(*totals[3:])
