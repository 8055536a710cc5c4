"""Small functional environments whose best behaviour is known in closed form."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box

from mathota_envs.base import Environment, EnvState, key_data, unbounded_box


def ignore(*_):
    """A report that nobody reads, and a stop that never comes."""
    return False


def _start(key, state):
    return EnvState(state, key_data(key), jnp.zeros((), jnp.int32), ())


def _advance(env_state, state):
    return dataclasses.replace(env_state, state=state, step_count=env_state.step_count + 1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MatchTarget(Environment):
    """Observe a number in [-1, 1]; the reward is 1 - |action - 2 target|. Best return: one for each step."""

    max_episode_steps: int = 8

    def __post_init__(self):
        super().__post_init__()
        self.set_derived(observation_space=Box(-1.0, 1.0, (1,)), action_space=Box(-2.0, 2.0, (1,)), dt=1.0)

    def reset(self, key, options=None):
        target = jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)
        return _start(key, target), target

    def step(self, env_state, action, model=None):
        reward = 1.0 - jnp.abs(action[0] - 2.0 * env_state.state[0])
        env_state = _advance(env_state, env_state.state)
        return env_state, env_state.state, reward, jnp.array(False), self.is_truncated(env_state.step_count), {}


@dataclasses.dataclass(frozen=True, kw_only=True)
class ConstantReward(Environment):
    """Reward 1 whatever is done, for episodes of a few steps that end by termination or by truncation.

    The observation is constant, so a critic can only learn the mean value of the states. If the episodes are truncated
    that value is 1 / (1 - discount); if they terminate it is the mean over the episode of what is left.
    """

    max_episode_steps: int = 5
    terminates: bool = False

    def __post_init__(self):
        super().__post_init__()
        self.set_derived(observation_space=Box(-1.0, 1.0, (1,)), action_space=Box(-1.0, 1.0, (1,)), dt=1.0)

    def reset(self, key, options=None):
        return _start(key, jnp.ones(1)), jnp.ones(1)

    def step(self, env_state, action, model=None):
        env_state = _advance(env_state, env_state.state)
        end = self.is_truncated(env_state.step_count)
        terminated = end & self.terminates
        return env_state, env_state.state, jnp.ones(()), terminated, end & ~terminated, {}


@dataclasses.dataclass(frozen=True, kw_only=True)
class CartPole(Environment):
    """A cart-pole by its Lagrangian equations, with the masses, sizes and limits of Gymnasium's InvertedPendulum-v5."""

    def __post_init__(self):
        super().__post_init__()
        action_space = Box(-3.0, 3.0, (1,), np.float32)
        self.set_derived(observation_space=unbounded_box(4), action_space=action_space, dt=0.04)

    def reset(self, key, options=None):
        coordinates = jax.random.uniform(key, (4,), minval=-0.01, maxval=0.01)
        return _start(key, coordinates), coordinates

    def step(self, env_state, action, model=None):
        force = 100.0 * jnp.clip(action[0], -3.0, 3.0)
        coordinates = _integrate(_integrate(env_state.state, force), force)
        env_state = _advance(env_state, coordinates)
        terminated = jnp.abs(coordinates[1]) > 0.2
        reward = jnp.where(terminated, 0.0, 1.0)
        return env_state, coordinates, reward, terminated, self.is_truncated(env_state.step_count), {}


def _integrate(coordinates, force, time_step=0.02):
    cart_mass, pole_mass, half_length, pole_inertia, damping, gravity = 10.47, 5.02, 0.3, 0.19, 1.0, 9.81
    _, angle, velocity, rate = coordinates
    coupling = pole_mass * half_length * jnp.cos(angle)
    rotation = pole_inertia + pole_mass * half_length**2
    cart_force = force - damping * velocity + pole_mass * half_length * rate**2 * jnp.sin(angle)
    pole_torque = pole_mass * gravity * half_length * jnp.sin(angle) - damping * rate
    mass = cart_mass + pole_mass
    determinant = mass * rotation - coupling**2
    acceleration = (rotation * cart_force - coupling * pole_torque) / determinant
    angular_acceleration = (mass * pole_torque - coupling * cart_force) / determinant
    speeds = coordinates[2:] + time_step * jnp.stack([acceleration, angular_acceleration])
    return jnp.concatenate([coordinates[:2] + time_step * speeds, speeds])
