"""`Model`: the differentiable parameters of a scene."""

from __future__ import annotations

from jax import Array

from mathota_jax.scene import Scene
from mathota_jax.struct import pytree, static


@pytree
class Model:
    """Parameters of a scene; every leaf is a float array and differentiable. Made by `SceneBuilder.build`.

    The static structure is `scene`; replacing a leaf (`dataclasses.replace(model, friction=...)`) never recompiles. A
    leaf can not bring back what the scene lacks: friction raised from 0 in a scene built without friction has no effect.

    Attributes:
      dt: () time step [s].
      gravity: (3,) acceleration [m/s^2], world frame.
      mass: (body,) [kg]; 1 for static bodies (not used).
      inertia: (body, 3) principal moments about the centre of mass [kg m^2]. Where all moving bodies were built with three
        equal ones (spheres, cubes) they must stay equal, for derivatives too: then nobody asks which axis they belong to.
      inertia_frame: (body, 4) principal axes in the body frame, quaternion; None where they are the axes of all bodies.
      size: (body,) characteristic length of the body [m] by which tolerances scale (its inner radius).
      friction: (body,) Coulomb coefficient; a pair uses the geometric mean.
      restitution: (body,) Newton coefficient; a pair uses the smaller.
      shapes: shape kind -> parameter -> (shape of that kind, ...); lengths in m. A kind that is not always at the centre
        of mass along the body axes also has "local_position" (shape, 3) from the centre of mass or "local_orientation"
        (shape, 4), quaternion, both in the body frame. Vertices of polyhedra are (shape, vertex, 3) from the centre of
        mass in the body frame, the first one repeated for polyhedra that have fewer than others.
      joint_anchor_parent, joint_anchor_child: (joint, 3) anchor from the centre of mass, body frame [m].
      joint_frame_parent, joint_frame_child: (joint, 4) orientation of the joint frame in each body, quaternion; the x axis
        is the axis of the joint.
      joint_limits: (joint, 2) lower and upper limit [rad] or [m]: the angle of a hinge, displacement of a slider, twist of
        a ball, length of a distance joint. A coordinate whose limits are equal is held at their mean.
      joint_swing: (joint,) half angle of the cone of a ball joint's axis [rad].
      joint_damping: (joint,) viscous coefficient [N m s/rad] or [N s/m].
      joint_friction: (joint,) largest dry friction [N m] or [N].
      joint_stiffness: (joint,) of the spring [N m/rad] or [N/m].
      joint_rest: (joint,) coordinate at which the spring is slack [rad] or [m].
      joint_armature: (joint,) inertia of a rotor that turns with the coordinate [kg m^2] or [kg].
      motor_limit: (motor,) largest absolute action.
      motor_gear: (motor,) torque [N m] or force [N], target rate or target coordinate per unit of action.
      motor_cap: (motor,) largest torque [N m] or force [N] of a velocity or position motor.
      motor_stiffness: (motor,) of a position motor [N m/rad] or [N/m].
      motor_damping: (motor,) of a position motor [N m s/rad] or [N s/m].
      scene: static structure.
    """

    dt: Array
    gravity: Array
    mass: Array
    inertia: Array
    inertia_frame: Array | None
    size: Array
    friction: Array
    restitution: Array
    shapes: dict[str, dict[str, Array]]
    joint_anchor_parent: Array
    joint_anchor_child: Array
    joint_frame_parent: Array
    joint_frame_child: Array
    joint_limits: Array
    joint_swing: Array
    joint_damping: Array
    joint_friction: Array
    joint_stiffness: Array
    joint_rest: Array
    joint_armature: Array
    motor_limit: Array
    motor_gear: Array
    motor_cap: Array
    motor_stiffness: Array
    motor_damping: Array
    scene: Scene = static()
