"""`InvertedPendulum`: keep a pole upright on a cart, the task of Gymnasium's ``InvertedPendulum-v5``."""

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
from mathota_jax import Capsule, Hinge, Model, Options, SceneBuilder, Slider, State, joint_position, joint_velocity

RAIL, CART, POLE = range(3)
DENSITY = 1000.0
POLE_TIP = (0.001, 0.6, 0.0)
"""Centre of the pole's upper cap [m] in the build pose: Gymnasium's pole leans by 1/600 rad at angle 0."""
MAXIMUM_ANGLE = 0.2

# The rail carries the cart; the cart carries the pole. Positive angles lean towards positive positions.
SLIDER = Slider(parent=RAIL, child=CART, anchor=(0, 0, 0), axis=(1, 0, 0), limits=(-1.0, 1.0), damping=1.0)
HINGE = Hinge(parent=CART, child=POLE, anchor=(0, 0, 0), axis=(0, 0, -1), damping=1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class InvertedPendulum(SimulatedEnvironment):
    """A pole hinged to a cart that a motor pushes along a rail.

    Same task as Gymnasium 1.4's ``InvertedPendulum-v5``: observation ``[cart position (m), pole angle (rad), cart
    velocity (m/s), pole angular velocity (rad/s)]``; action ``[a]`` with ``|a| <= 3`` for a force of ``100 a`` N on the
    cart; reward 1 for each step that does not terminate; termination when the angle exceeds 0.2 rad; truncation after
    1000 steps; two time steps of 0.02 s in each control step; a start with every coordinate and rate uniform in
    ±`reset_noise_scale`; a cart of 10.472 kg and a pole of 5.0186 kg (capsules of 1000 kg/m^3), damping 1 N s/m and
    1 N m s/rad, gravity 9.81 m/s^2, a rail of ±1 m, and no collisions.

    What differs:
      * the Y axis points up, and gravity is in the plane x-y;
      * observations are float32;
      * constrained bodies with a step of second order, where MuJoCo has joint coordinates and a Runge-Kutta step of
        fourth order; the motion converges to MuJoCo's as `substeps` grows;
      * the ends of the rail are hard limits, MuJoCo's are soft;
      * no limit of ±90 degrees on the pole, which no episode reaches;
      * a non-finite state is reported in ``info["non_finite"]`` and its observation is made finite.

    Error against effort: that of the rate (4.54/s) at which the pole falls, the fastest of the linearised motion, in
    float64. A control step costs in proportion to the substeps.

        substeps                      1         2         4          8
        error of the rate        -0.054 %  -0.014 %  -0.0034 %  -0.0009 %

    Attributes:
        reset_noise_scale: largest magnitude of every coordinate [m, rad] and rate [m/s, rad/s] at the start.
    """

    frame_skip: int = 2
    reset_noise_scale: float = 0.01

    time_step: ClassVar[float] = 0.02
    observation_size: ClassVar[int] = 4
    action_limit: ClassVar[tuple[float, ...]] = (3.0,)
    reset_options: ClassVar[dict[str, tuple[int, ...]]] = {"joint_position": (2,), "joint_velocity": (2,)}

    def __post_init__(self) -> None:
        self.require_number("reset_noise_scale", minimum=0.0, maximum=MAXIMUM_ANGLE)
        super().__post_init__()

    def build(self) -> tuple[Model, State]:
        """Rail, cart and pole."""
        builder = SceneBuilder(gravity=(0.0, -9.81, 0.0))
        quarter_turn = (math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5))
        lean = -0.5 * math.atan2(POLE_TIP[0], POLE_TIP[1])
        pole_length = math.hypot(*POLE_TIP)
        builder.add_body(Capsule(0.02, 1.0), static=True, orientation=quarter_turn, collides=False, name="rail")
        builder.add_body(Capsule(0.1, 0.1), density=DENSITY, orientation=quarter_turn, collides=False, name="cart")
        builder.add_body(
            Capsule(0.049, 0.5 * pole_length),
            density=DENSITY,
            position=tuple(0.5 * coordinate for coordinate in POLE_TIP),
            orientation=(math.cos(lean), 0.0, 0.0, math.sin(lean)),
            collides=False,
            name="pole",
        )
        slider = builder.add_joint(SLIDER, name="slider")
        builder.add_joint(HINGE, name="hinge")
        builder.add_motor(slider, kind="torque", limit=3.0, gear=100.0)
        # The dampings of the free bodies are off: Gymnasium's model damps the joints only.
        return builder.build(Options(dt=self.engine_step, linear_damping=0.0, angular_damping=0.0))

    def start(self, key: Array, options: dict[str, Array]) -> tuple[State, Any]:
        """Random joint coordinates and rates, or those of the options."""
        scale = self.reset_noise_scale
        noise = jax.random.uniform(key, (2, 2), minval=-scale, maxval=scale)
        position = options.get("joint_position", noise[0])
        velocity = options.get("joint_velocity", noise[1])
        return place(self.rest_state, (SLIDER, HINGE), position, velocity), ()

    def observe(self, model: Model, env_state: EnvState) -> Array:
        """Joint coordinates and rates."""
        state = env_state.state
        return jnp.concatenate([joint_position(model, state), joint_velocity(model, state)])

    def judge(self, observation: Array, action: Array) -> tuple[Array, Array, dict[str, Array]]:
        """One for each step with the pole up."""
        terminated = jnp.abs(observation[1]) > MAXIMUM_ANGLE
        reward = jnp.where(terminated, 0.0, 1.0).astype(observation.dtype)
        return reward, terminated, {"reward_survive": reward}
