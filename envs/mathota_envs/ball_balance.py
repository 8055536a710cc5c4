"""`BallBalance`: roll a ball after a moving target by tilting the plate it lies on."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from mathota_envs.base import EnvState
from mathota_envs.kinematics import place
from mathota_envs.simulated import SimulatedEnvironment
from mathota_jax import (
    Box,
    Hinge,
    Model,
    Options,
    Plane,
    SceneBuilder,
    Sphere,
    State,
    joint_position,
    joint_velocity,
)
from mathota_jax.spatial.quaternion import Quaternion, to_matrix
from mathota_jax.spatial.vector import Vec3, cross

BASE, FRAME, PLATE, BALL = range(4)
PIVOT = (0.0, 0.4, 0.0)
PLATE_HALF_EXTENTS = (0.25, 0.01, 0.25)
BALL_RADIUS = 0.04
MAXIMUM_TILT = 0.35

# A gimbal: the base carries a frame, the frame carries the plate. Positive angles roll the ball towards +x and +z.
TILT_X = Hinge(
    parent=BASE, child=FRAME, anchor=PIVOT, axis=(0, 0, -1), limits=(-MAXIMUM_TILT, MAXIMUM_TILT), damping=0.2
)
TILT_Z = Hinge(
    parent=FRAME, child=PLATE, anchor=PIVOT, axis=(1, 0, 0), limits=(-MAXIMUM_TILT, MAXIMUM_TILT), damping=0.2
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BallBalance(SimulatedEnvironment):
    """A ball rolls, with friction, on a plate that two motors tilt about two perpendicular axes.

    Observation, 12 numbers in pairs along the plate's x and z axes: ball position [m] and velocity [m/s] in the frame
    of the plate; tilt angles [rad] and rates [rad/s], positive where they roll the ball forwards; target position [m]
    and velocity [m/s] in the frame of the plate.

    Action, 2 numbers in ±1: torques on the two axes as fractions of 0.5 N m.

    Reward ``1 / (1 + (d / 0.05 m)^2) - 0.01 mean(action^2)`` with the distance `d` from ball to target: at most 1, more
    than -0.01. The target moves as ``amplitude * sin(rate t + phase)`` along each axis, with rates and phases drawn for
    every episode. Termination when the ball's centre leaves the plate; truncation after 600 steps of 1/60 s.

    Attributes:
        target_amplitude: largest coordinate of the target [m].
        start_radius: largest distance of the ball from the centre at the start [m].
    """

    max_episode_steps: int | None = 600
    frame_skip: int = 4
    target_amplitude: float = 0.12
    start_radius: float = 0.12

    time_step: ClassVar[float] = 1 / 240
    observation_size: ClassVar[int] = 12
    action_limit: ClassVar[tuple[float, ...]] = (1.0, 1.0)
    reset_options: ClassVar[dict[str, tuple[int, ...]]] = {"ball_position": (2,), "tilt": (2,)}

    def __post_init__(self) -> None:
        self.require_number("target_amplitude", minimum=0.0, maximum=PLATE_HALF_EXTENTS[0])
        self.require_number("start_radius", minimum=0.0, maximum=PLATE_HALF_EXTENTS[0])
        super().__post_init__()

    def build(self) -> tuple[Model, State]:
        """Base, gimbal frame, plate and ball."""
        builder = SceneBuilder(gravity=(0.0, -9.8, 0.0))
        builder.add_body(Box((0.03, 0.19, 0.03)), static=True, position=(0, 0.19, 0), collides=False, name="base")
        builder.add_body(Box((0.08, 0.008, 0.08)), mass=0.3, position=PIVOT, collides=False, name="frame")
        builder.add_body(Box(PLATE_HALF_EXTENTS), mass=0.6, position=PIVOT, friction=0.9, name="plate")
        above = (PIVOT[0], PIVOT[1] + PLATE_HALF_EXTENTS[1] + BALL_RADIUS, PIVOT[2])
        builder.add_body(Sphere(BALL_RADIUS), mass=0.1, position=above, friction=0.9, name="ball")
        builder.add_body(Plane((0.0, 1.0, 0.0), 0.0), static=True, collides=False, name="ground")  # only to look at
        for joint, name in ((TILT_X, "tilt x"), (TILT_Z, "tilt z")):
            builder.add_motor(builder.add_joint(joint, name=name), kind="torque", limit=1.0, gear=0.5)
        return builder.build(Options(dt=self.engine_step))

    def start(self, key: Array, options: dict[str, Array]) -> tuple[State, Any]:
        """Ball at rest on the tilted plate, target somewhere on its course."""
        ball_key, tilt_key, rate_key, phase_key = jax.random.split(key, 4)
        tilt = options.get("tilt", jax.random.uniform(tilt_key, (2,), minval=-0.05, maxval=0.05))
        ball_position = options.get("ball_position", self.start_radius * _disc(ball_key))
        state = place(self.rest_state, (TILT_X, TILT_Z), tilt, jnp.zeros_like(tilt))
        height = PLATE_HALF_EXTENTS[1] + BALL_RADIUS
        above = to_matrix(Quaternion(*state.orientation[PLATE])).apply(Vec3(ball_position[0], height, ball_position[1]))
        state = dataclasses.replace(
            state, position=state.position.at[BALL].set(state.position[PLATE] + jnp.stack(above))
        )
        return state, {
            "rate": jax.random.uniform(rate_key, (2,), minval=0.4, maxval=1.0),
            "phase": jax.random.uniform(phase_key, (2,), maxval=2 * math.pi),
        }

    def observe(self, model: Model, env_state: EnvState) -> Array:
        """Ball, plate and target in the frame of the plate."""
        state = env_state.state
        position, velocity = _in_plate_frame(state)
        target, target_velocity = self.target(env_state)
        return jnp.concatenate(
            [
                jnp.stack([position.x, position.z, velocity.x, velocity.z]),
                joint_position(model, state),
                joint_velocity(model, state),
                target,
                target_velocity,
            ]
        )

    def judge(self, observation: Array, action: Array) -> tuple[Array, Array, dict[str, Array]]:
        """Closeness of the ball to the target."""
        offset = observation[:2] - observation[8:10]
        squared_distance = offset @ offset
        reward = 1.0 / (1.0 + squared_distance / 0.05**2) - 0.01 * jnp.mean(action**2)
        terminated = (jnp.abs(observation[:2]) > PLATE_HALF_EXTENTS[0]).any()
        return reward, terminated, {"squared_distance": squared_distance}

    def target(self, env_state: EnvState) -> tuple[Array, Array]:
        """Position [m] and velocity [m/s] of the target along the plate's x and z axes, each ``(2,)``."""
        rate, phase = env_state.extras["rate"], env_state.extras["phase"]
        angle = rate * (env_state.step_count * self.dt) + phase
        return self.target_amplitude * jnp.sin(angle), self.target_amplitude * rate * jnp.cos(angle)


def _disc(key: Array) -> Array:
    """Uniform point of the unit disc, ``(2,)``."""
    radius_key, angle_key = jax.random.split(key)
    radius = jnp.sqrt(jax.random.uniform(radius_key))
    angle = jax.random.uniform(angle_key, maxval=2 * math.pi)
    return radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def _in_plate_frame(state: State) -> tuple[Vec3, Vec3]:
    """Position and velocity of the ball as seen from the moving plate."""
    rotation = to_matrix(Quaternion(*state.orientation[PLATE]))
    offset = Vec3(*state.position[BALL]) - Vec3(*state.position[PLATE])
    relative_velocity = Vec3(*state.velocity[BALL]) - Vec3(*state.velocity[PLATE])
    spin = Vec3(*state.angular_velocity[PLATE])
    return rotation.apply_transposed(offset), rotation.apply_transposed(relative_velocity - cross(spin, offset))
