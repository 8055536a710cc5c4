"""The two timed scenes as numbers, with their closed forms. Engines build them in files of their own.

Slide: a cube of 0.2 m edge on a plane, thrown along x, friction at all four lower corners. Bounce: a sphere dropped
from a gap, restitution 0.8. No damping. The worlds of a batch differ in launch speed or drop gap, so that no engine can
gain from equal worlds and no error can hide in a lucky phase of the time step.
"""

from __future__ import annotations

import math

import numpy as np

GRAVITY = 9.8
MASS = 1.0

SLIDE_HALF_EXTENT = 0.1
SLIDE_FRICTION = 0.4
SLIDE_SPEEDS = (1.9, 2.1)
SLIDE_TIMED_STEPS = 100
"""At 1/240 s the slowest cube still slides after these steps."""
SLIDE_SECONDS = 2.0
"""Horizon of the error: every cube has stopped."""

BOUNCE_RADIUS = 0.1
BOUNCE_RESTITUTION = 0.8
BOUNCE_GAPS = (1.0, 1.1)
BOUNCE_TIMED_STEPS = 480
"""At 1/240 s: the drop, three impacts and the flights between them."""
BOUNCE_SECONDS = 1.1
"""Horizon of the error: past the first apex, before the second impact, for every gap."""


def spread(interval: tuple[float, float], count: int) -> np.ndarray:
    """`count` values over `interval`; its middle for a single one."""
    return np.linspace(*interval, count) if count > 1 else np.array([0.5 * sum(interval)])


def step_count(seconds: float, dt: float) -> int:
    """Steps of `dt` that reach `seconds`."""
    return math.ceil(seconds / dt - 1e-9)


def slide_distance(speed: np.ndarray) -> np.ndarray:
    """Distance until friction has stopped the cube [m]."""
    return speed**2 / (2 * SLIDE_FRICTION * GRAVITY)


def slide_errors(speed: np.ndarray, distance: np.ndarray, dt: float) -> dict[str, float]:
    """Largest relative errors of the stopping distance over the worlds.

    `distance_error` is against the closed form, `distance_error_euler` against what an exact contact gives under the
    semi-implicit Euler rule, which lags behind the closed form by half a step (BENCHMARKS A9).
    """
    truth = slide_distance(speed)
    return {
        "distance_error": float(np.max(np.abs(distance / truth - 1))),
        "distance_error_euler": float(np.max(np.abs(distance / (truth - 0.5 * speed * dt) - 1))),
    }


def bounce_errors(gap: np.ndarray, first_apex: np.ndarray) -> dict[str, float]:
    """Relative errors of the height of the first bounce above the plane, over the worlds."""
    error = np.abs(first_apex / (BOUNCE_RESTITUTION**2 * gap) - 1)
    return {"apex_error": float(np.max(error)), "apex_error_median": float(np.median(error))}


def first_apex(gaps: np.ndarray) -> np.ndarray:
    """Largest gap after the first impact, from gaps of shape (step, world) that start with a fall [m]."""
    rises = np.diff(gaps, axis=0) > 0
    first_rise = np.argmax(rises, axis=0)
    after = np.arange(len(gaps))[:, None] >= first_rise
    return np.where(rises.any(axis=0), np.max(np.where(after, gaps, -np.inf), axis=0), np.nan)
