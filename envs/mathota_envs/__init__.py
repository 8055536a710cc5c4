"""Reinforcement-learning environments on the engine `mathota_jax`.

In functional form: ``environment = make("mathota/BallBalance-v0")``, then ``environment.reset(key)`` and
``environment.step(env_state, action)``. Importing the package registers the environments with Gymnasium, so that
``gymnasium.make("mathota_envs:mathota/BallBalance-v0")`` works by itself. For stable-baselines3 see `mathota_envs.sb3`.
"""

from mathota_envs.ball_balance import BallBalance
from mathota_envs.base import Environment, EnvState
from mathota_envs.gym_env import GymEnv
from mathota_envs.inverted_pendulum import InvertedPendulum
from mathota_envs.registration import ENVIRONMENTS, make, register_environments
from mathota_envs.simulated import SimulatedEnvironment
from mathota_envs.vector_env import GymVectorEnv

__all__ = [
    "ENVIRONMENTS",
    "BallBalance",
    "EnvState",
    "Environment",
    "GymEnv",
    "GymVectorEnv",
    "InvertedPendulum",
    "SimulatedEnvironment",
    "make",
]

register_environments()
