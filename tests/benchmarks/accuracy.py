"""Scenes with closed forms (BENCHMARKS A7, A9, A10, A11a) and the ten-box stack, with the CPU time they took."""

from __future__ import annotations

import functools
import itertools
import math
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import Box, Options, Plane, SceneBuilder, Sphere, angular_momentum, contacts, energy, rollout
from tests.benchmarks import compile_probe
from tests.benchmarks.settings import TIME_STEP, Settings

GRAVITY = 9.81
SLAB = (0.2, 0.05, 0.2)
BODY = 1
DAMPING_OFF = {"linear_damping": 0.0, "angular_damping": 0.0}


def measure(settings: Settings) -> dict:
    """All scenes; each with its figures, gate by gate, and its CPU time after compilation."""
    del settings
    return {scene.__name__: scene() for scene in (tumble, stopping_distance, incline, tipping, slide_to_roll, stack)}


def tumble() -> dict:
    """A7: torque-free box about its middle axis; drift of angular momentum and energy over 10 s at dt 1/100."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    builder.add_body(Box((0.1, 0.2, 0.3)), mass=1.0, angular_velocity=(0.1, 10, 0))
    dt = 0.01
    model, state = builder.build(Options(dt=dt, **DAMPING_OFF))
    track, cpu = _track(model, state, 1000)
    angular = np.asarray(jax.vmap(angular_momentum, (None, 0))(model, track), float)
    kinetic = np.asarray(jax.vmap(energy, (None, 0))(model, track), float)
    angular_start, kinetic_start = np.array([0.1 * 0.13, 10 * 0.10, 0]) / 3, (0.13 * 0.1**2 + 0.10 * 10**2) / 6
    drift = np.linalg.norm(angular - angular_start, axis=1).max() / np.linalg.norm(angular_start)
    return {
        "angular momentum, relative drift": _gate(drift, 1e-5),
        "energy, relative drift": _gate(np.abs(kinetic / kinetic_start - 1).max(), 1e-3),
        "settings": {"dt": dt, "seconds": 10, "precision": "float32"},
        "cpu_seconds": cpu,
    }


def stopping_distance() -> dict:
    """A9: a slab thrown at 2 m/s in five directions at three frictions; distance, heading, isotropy, creep."""
    frictions, angles, speed = (0.2, 0.4, 0.7), np.radians([0, 11.25, 22.5, 33.75, 45]), 2.0
    slide, rest = round(1.5 / TIME_STEP), round(5 / TIME_STEP)
    worst = {"distance": 0.0, "heading": 0.0, "anisotropy": 0.0, "creep": 0.0}
    cpu_total = 0.0
    for friction in frictions:
        distances = []
        for angle in angles:
            velocity = (speed * math.cos(angle), 0, speed * math.sin(angle))
            model, state = _on_plane(Box(SLAB), 0.05, friction, velocity=velocity)
            track, cpu = _track(model, state, slide + rest)
            cpu_total += cpu
            path = np.asarray(track.position[:, BODY], float)[:, [0, 2]]
            stopped = path[slide - 1]
            distances.append(np.hypot(*stopped))
            heading = abs(math.degrees(math.atan2(stopped[1], stopped[0]) - angle))
            worst["heading"] = max(worst["heading"], heading)
            worst["creep"] = max(worst["creep"], np.hypot(*(path[-1] - stopped)))
        truth = speed**2 / (2 * friction * GRAVITY)
        worst["distance"] = max(worst["distance"], np.max(np.abs(np.array(distances) / truth - 1)))
        worst["anisotropy"] = max(worst["anisotropy"], max(distances) / min(distances) - 1)
    return {
        "distance, relative error to the closed form": _gate(worst["distance"], 0.01),
        "distance, largest over smallest direction - 1": _gate(worst["anisotropy"], 0.01),
        "heading error [deg]": _gate(worst["heading"], 0.1),
        "creep in 5 s after the stop [mm]": _gate(1e3 * worst["creep"], 0.1),
        "settings": {"dt": TIME_STEP, "frictions": frictions, "precision": "float32"},
        "cpu_seconds": cpu_total,
    }


def incline() -> dict:
    """A10: a slab on a slope for 3 s; creep where it sticks, distance where it slides."""
    seconds = 3.0
    creep, sliding, cpu_total = 0.0, 0.0, 0.0
    for friction, degrees in itertools.product((0.1, 0.3, 0.5, 0.7, 1.0), (3, 10, 20, 30, 40)):
        if abs(degrees - math.degrees(math.atan(friction))) < 2:
            continue
        angle = math.radians(degrees)
        model, state = _on_plane(Box(SLAB), 0.05, friction, slope=angle)
        track, cpu = _track(model, state, round(seconds / TIME_STEP))
        cpu_total += cpu
        path = np.asarray(track.position[:, BODY], float) - np.asarray(state.position[BODY], float)
        distance = np.linalg.norm(path, axis=1)
        acceleration = GRAVITY * (math.sin(angle) - friction * math.cos(angle))
        if acceleration <= 0:
            creep = max(creep, distance.max())
        else:
            sliding = max(sliding, abs(distance[-1] / (0.5 * acceleration * seconds**2) - 1))
    return {
        "stick: displacement in 3 s [mm]": _gate(1e3 * creep, 0.1),
        "slide: distance, relative error": _gate(sliding, 0.01),
        "settings": {"dt": TIME_STEP, "precision": "float32"},
        "cpu_seconds": cpu_total,
    }


def tipping() -> dict:
    """A10, tip variant: the slope at which a tall box falls over, by half degrees, then by bisection."""
    grid, halvings = np.arange(10, 20.01, 0.5), 6
    cpu_total = 0.0

    def falls(degrees: float) -> bool:
        nonlocal cpu_total
        model, state = _on_plane(Box((0.1, 0.4, 0.1)), 0.4, 1.5, slope=math.radians(degrees))
        track, cpu = _track(model, state, round(3 / TIME_STEP))
        cpu_total += cpu
        turn = 2 * np.arccos(np.clip(np.abs(np.asarray(track.orientation[-1, BODY] @ state.orientation[BODY])), 0, 1))
        return math.degrees(turn) > 10

    fallen = np.array([falls(degrees) for degrees in grid])
    stands_at = max(grid[~fallen], default=math.nan)
    falls_at = min(grid[fallen], default=math.nan)
    monotone = stands_at < falls_at  # False for nan
    for _ in range(halvings if monotone else 0):
        middle = 0.5 * (stands_at + falls_at)
        stands_at, falls_at = (stands_at, middle) if falls(middle) else (middle, falls_at)
    found = 0.5 * (stands_at + falls_at) if monotone else math.nan
    return {
        "tipping angle, error [deg]": _gate(abs(found - math.degrees(math.atan(0.25))), 0.25),
        "settings": {
            "dt": TIME_STEP,
            "grid [deg]": f"{grid[0]:g} to {grid[-1]:g} by {grid[1] - grid[0]:g}, its last interval halved {halvings} times",
            "found [deg]": f"{found:.3f} +- {0.5 * (falls_at - stands_at):.3f}",
            "precision": "float32",
        },
        "cpu_seconds": cpu_total,
    }


def slide_to_roll() -> dict:
    """A11a: a sphere thrown without spin; speed after it rolls, slip, distance."""
    radius, friction, speed, seconds = 0.1, 0.2, 5.0, 2.0
    model, state = _on_plane(Sphere(radius), radius, friction, velocity=(speed, 0, 0))
    track, cpu = _track(model, state, round(seconds / TIME_STEP))
    velocity = np.asarray(track.velocity[:, BODY, 0], float)
    spin = -np.asarray(track.angular_velocity[:, BODY, 2], float)
    rolls_at = 0.4 * speed / (1.4 * friction * GRAVITY)
    rolling = np.arange(1, len(velocity) + 1) * TIME_STEP > rolls_at + 2 * TIME_STEP
    rolled_speed = speed / 1.4
    distance = speed * seconds / 1.4 + 0.5 * (0.4 / 1.4) ** 2 * speed**2 / (friction * GRAVITY)
    return {
        "rolling speed, relative error": _gate(np.abs(velocity[rolling] / rolled_speed - 1).max(), 1e-4),
        "slip v - r w [m/s]": _gate(np.abs(velocity - radius * spin)[rolling].max(), 1e-4),
        "distance at 2 s, relative error": _figure(abs(float(track.position[-1, BODY, 0]) / distance - 1)),
        "settings": {"dt": TIME_STEP, "precision": "float32"},
        "cpu_seconds": cpu,
    }


def stack() -> dict:
    """Ten boxes of 0.1 m half size for 5 s at the engine's defaults."""
    model, state = compile_probe.stack(10)
    steps = round(5 / TIME_STEP)
    track, cpu = _track(model, state, steps)
    start = np.asarray(state.position[1:], float)
    path = np.asarray(track.position[:, 1:], float)
    depth = -np.asarray(jax.vmap(lambda s: _deepest(contacts(model, s)))(track), float)
    drift = np.linalg.norm((path - start)[..., [0, 2]], axis=-1).max()
    stands = bool(np.abs(path[-1, :, 1] - start[:, 1]).max() < compile_probe.HALF)
    return {
        "stands (1 = yes)": {"value": float(stands), "gate": 1.0, "met": stands},
        "penetration [mm]": _gate(1e3 * max(0.0, depth.max()), 1.0),
        "horizontal drift [mm]": _gate(1e3 * drift, 1.0),
        "settings": {"dt": TIME_STEP, "seconds": 5, "sweeps": 10, "precision": "float32"},
        "cpu_seconds": cpu,
    }


def _deepest(found: Any) -> jax.Array:
    return jnp.min(jnp.where(found.active, found.separation, jnp.inf))


def _on_plane(
    shape: Any,
    height: float,
    friction: float,
    *,
    velocity: tuple[float, float, float] = (0, 0, 0),
    slope: float = 0.0,
) -> tuple[Any, Any]:
    """A body whose centre is `height` above a plane that is turned about z by `slope` [rad]."""
    normal = (-math.sin(slope), math.cos(slope), 0)
    builder = SceneBuilder(gravity=(0, -GRAVITY, 0))
    builder.add_body(Plane(normal=normal, offset=0.0), static=True, friction=friction)
    builder.add_body(
        shape,
        mass=1.0,
        position=tuple(height * component for component in normal),
        orientation=(math.cos(slope / 2), 0, 0, math.sin(slope / 2)),
        velocity=velocity,
        friction=friction,
    )
    return builder.build(Options(dt=TIME_STEP, **DAMPING_OFF))


@functools.partial(jax.jit, static_argnames="steps")
def _rollout(model: Any, state: Any, steps: int) -> Any:
    return rollout(model, state, steps)[1]


def _track(model: Any, state: Any, steps: int) -> tuple[Any, float]:
    """Trajectory and the CPU time of the rollout [s], compilation left out."""
    jax.block_until_ready(_rollout(model, state, steps=steps))
    start = time.process_time()
    track = jax.block_until_ready(_rollout(model, state, steps=steps))
    return track, time.process_time() - start


def _gate(value: float, gate: float) -> dict:
    return {"value": float(value), "gate": gate, "met": bool(value <= gate)}


def _figure(value: float) -> dict:
    return {"value": float(value)}
