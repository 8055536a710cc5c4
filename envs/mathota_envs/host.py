"""Conversions between the compiled functions and NumPy users: seeds, options, actions, results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Space
from gymnasium.utils import seeding
from jax import Array


def entropy_words(generator: np.random.Generator) -> np.ndarray:
    """Two uint32 words from which a world's keys follow (`worlds.world_keys`), drawn from a NumPy generator."""
    return generator.integers(2**32, size=2, dtype=np.uint32)


def seed_entropy(seeds: Sequence[int | None]) -> np.ndarray:
    """Entropy words ``(world, 2)`` of a seed for each world; None takes fresh entropy from the operating system."""
    return np.stack([entropy_words(seeding.np_random(seed)[0]) for seed in seeds])


def writable(array: Array, dtype: Any = None) -> np.ndarray:
    """Writable NumPy copy: a view of a JAX array is read-only and shares its memory."""
    return np.array(array, dtype=dtype)


def checked_actions(actions: Any, space: Space[Any], name: str) -> np.ndarray:
    """Actions as an array of the space's shape and type.

    Raises:
        ValueError: they are no numbers or have another shape.
    """
    try:
        array = np.asarray(actions, dtype=space.dtype)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: actions must be numbers of shape {space.shape}: {error}") from error
    if array.shape != space.shape:
        raise ValueError(f"{name}: actions must have shape {space.shape}, got {array.shape}")
    return array


def checked_reset_options(environment: Any, options: Mapping[str, Any] | None) -> dict[str, Array] | None:
    """Reset options of one world as arrays; None for none.

    Raises:
        ValueError: an option is unknown, has the wrong shape or is not finite.
    """
    if not options:
        return None
    checked = environment.checked_reset_options(options)
    for name, value in checked.items():
        if not np.isfinite(value).all():
            raise ValueError(f"{type(environment).__name__}: reset option {name!r} must be finite, got {value}")
    return checked


def repeated(options: dict[str, Array] | None, world_count: int) -> dict[str, Array] | None:
    """The same reset options for every world."""
    if options is None:
        return None
    return {name: jnp.broadcast_to(value, (world_count, *value.shape)) for name, value in options.items()}


def info_scalar(value: Any) -> Any:
    """Entry of a single world's info: Python bool, NumPy number or writable NumPy array."""
    array = writable(value)
    if array.ndim:
        return array
    return bool(array) if array.dtype == bool else array[()]


def require_world_count(world_count: Any) -> int:
    """The number of worlds.

    Raises:
        ValueError: it is no positive integer.
    """
    if isinstance(world_count, bool) or not isinstance(world_count, int | np.integer) or world_count < 1:
        raise ValueError(f"num_envs must be a positive integer, got {world_count!r}")
    return int(world_count)


def require_render_mode(render_mode: str | None, modes: Sequence[str]) -> None:
    """Raises ValueError unless the render mode is None or among the modes."""
    if render_mode is not None and render_mode not in modes:
        raise ValueError(
            f"unknown render_mode {render_mode!r}; valid: {', '.join([repr(m) for m in modes] + ['None'])}"
        )
