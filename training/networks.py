"""The Gaussian actor and the critic: multilayer perceptrons on plain pytrees."""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

Parameters = dict[str, Any]


def initial_parameters(
    key: Array,
    observation_size: int,
    action_size: int,
    hidden_sizes: Sequence[int],
    initial_log_standard_deviation: float,
) -> Parameters:
    """Orthogonal weights; a small last actor layer, so that the first policy is centred on the middle action.

    Returns:
        ``{"actor": layers, "critic": layers, "log_standard_deviation": (action,)}``, where ``layers`` is a list of
        ``{"weight": (in, out), "bias": (out,)}``.
    """
    actor_key, critic_key = jax.random.split(key)
    return {
        "actor": _initial_layers(actor_key, (observation_size, *hidden_sizes, action_size), output_scale=0.01),
        "critic": _initial_layers(critic_key, (observation_size, *hidden_sizes, 1), output_scale=1.0),
        "log_standard_deviation": jnp.full(action_size, initial_log_standard_deviation, jnp.float32),
    }


def action_mean(parameters: Parameters, observations: Array) -> Array:
    """Mean of the policy, ``(..., observation) -> (..., action)``; 1 is the bound of the action space."""
    return _apply_layers(parameters["actor"], observations)


def state_value(parameters: Parameters, observations: Array) -> Array:
    """The critic's estimate of the discounted return, ``(..., observation) -> (...)``."""
    return _apply_layers(parameters["critic"], observations)[..., 0]


def log_probability(mean: Array, log_standard_deviation: Array, actions: Array) -> Array:
    """Log density of a diagonal Gaussian, ``(..., action) -> (...)``."""
    standardized = (actions - mean) * jnp.exp(-log_standard_deviation)
    return jnp.sum(-0.5 * standardized**2 - log_standard_deviation - 0.5 * math.log(2 * math.pi), axis=-1)


def entropy(log_standard_deviation: Array) -> Array:
    """Entropy of a diagonal Gaussian, ``(action,) -> ()``, in nats."""
    return jnp.sum(log_standard_deviation + 0.5 * math.log(2 * math.pi * math.e))


def _initial_layers(key: Array, sizes: Sequence[int], output_scale: float) -> list[dict[str, Array]]:
    layers = []
    for index, layer_key in enumerate(jax.random.split(key, len(sizes) - 1)):
        scale = output_scale if index == len(sizes) - 2 else math.sqrt(2.0)
        initializer = jax.nn.initializers.orthogonal(scale)
        weight = initializer(layer_key, (sizes[index], sizes[index + 1]), jnp.float32)
        layers.append({"weight": weight, "bias": jnp.zeros(sizes[index + 1], jnp.float32)})
    return layers


def _apply_layers(layers: list[dict[str, Array]], inputs: Array) -> Array:
    for layer in layers[:-1]:
        inputs = jnp.tanh(inputs @ layer["weight"] + layer["bias"])
    return inputs @ layers[-1]["weight"] + layers[-1]["bias"]
