"""Scenes whose parameters are fitted, and data made from them."""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
import numpy as np

from mathota_jax import Box, Plane, SceneBuilder, Sphere, rollout
from mathota_jax.fit import Noise, Parameter, Trajectories
from mathota_jax.fit.arrays import turned
from tests.scenes import undamped

GRAVITY = 9.81
TRUTH = {"friction[ball]": 0.02, "restitution[ball]": 0.7, "mass[ball]": 0.8, "radius[ball]": 0.12}
NOISE = Noise(position=1e-3, orientation=np.radians(1.0))
FRAME = 1 / 60
SUBSTEPS = 2
FRAMES = 61
RADIUS = 0.1


def bounce_height(times, restitution, drop=1.0):
    """Height of a ball above its resting height after it was dropped: parabolas between impacts (BENCHMARKS A12a)."""
    heights = []
    for time in times:
        if time < (first := math.sqrt(2 * drop / GRAVITY)):
            heights.append(drop - GRAVITY * time**2 / 2)
            continue
        time, speed = time - first, restitution * GRAVITY * first
        while time > 2 * speed / GRAVITY:
            time, speed = time - 2 * speed / GRAVITY, speed * restitution
        heights.append(speed * time - GRAVITY * time**2 / 2)
    return np.asarray(heights)


def struck_ball():
    """A spinning ball that bounces and is then struck in the air by a known one, which shows its mass."""
    builder = SceneBuilder(gravity=(0.0, -GRAVITY, 0.0))
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=0.4, restitution=0.9, name="ground")
    builder.add_body(
        Sphere(TRUTH["radius[ball]"]),
        mass=TRUTH["mass[ball]"],
        friction=TRUTH["friction[ball]"],
        restitution=TRUTH["restitution[ball]"],
        name="ball",
    )
    builder.add_body(Sphere(0.1), mass=1.0, friction=0.4, restitution=0.9, name="striker")
    return builder.build(undamped(dt=FRAME / SUBSTEPS))


def puck(friction):
    """A flat box on a table."""
    builder = SceneBuilder(gravity=(0.0, 0.0, -GRAVITY))
    builder.add_body(Plane((0, 0, 1)), static=True, friction=friction, name="table")
    builder.add_body(Box((0.04, 0.04, 0.01)), mass=0.1, position=(0, 0, 0.01), friction=friction, name="puck")
    return builder.build(undamped())


def slides(friction, seed):
    """Positions (trajectory, frame, 1, 3) of three sliding pucks in closed form, 1 mm of noise, a tenth of them missing."""
    generator = np.random.default_rng(seed)
    times, motions = np.arange(50) / 50, []
    for speed, heading in ((1.0, 0.3), (0.6, 2.0), (1.4, -1.0)):
        sliding = np.minimum(times, speed / (friction * GRAVITY))
        way = speed * sliding - friction * GRAVITY * sliding**2 / 2
        motions.append(np.stack([way * math.cos(heading), way * math.sin(heading), np.full(50, 0.01)], -1))
    position = np.asarray(motions)[:, :, None]
    position = position + generator.normal(0, 1e-3, position.shape)
    position[generator.random(position.shape[:2]) < 0.1] = np.nan
    return Trajectories("puck", 1 / 50, position)


def unknown(factor=1.3):
    """The four parameters, begun that far from the truth."""
    away = {"friction[ball]": factor, "restitution[ball]": 1 / factor, "mass[ball]": factor, "radius[ball]": 0.9}
    return [Parameter(name, start=value * away[name]) for name, value in TRUTH.items()]


@functools.lru_cache(maxsize=2)
def clean_throws(count=4, seed=1):
    """Exact motion of some throws."""
    model, state = struck_ball()
    random = np.random.default_rng(seed)
    begin = np.broadcast_to(np.asarray(state.position, float), (count, 3, 3)).copy()
    velocity, spin = np.zeros_like(begin), np.zeros_like(begin)
    begin[:, 1] = [0.0, 0.5, 0.0] + 0.05 * random.normal(size=(count, 3))
    velocity[:, 1] = [3.0, -1.0, 0.0] + 0.2 * random.normal(size=(count, 3))
    spin[:, 1] = 10.0 * random.normal(size=(count, 3))
    run = jax.jit(jax.vmap(lambda state: rollout(model, state, (FRAMES - 1) * SUBSTEPS)[1]))

    def throw():
        states = jax.vmap(lambda p, v, w: dataclasses.replace(state, position=p, velocity=v, angular_velocity=w))(
            *(np.asarray(leaf, state.position.dtype) for leaf in (begin, velocity, spin))
        )
        return states, run(states)

    # The striker, far away at first, is then aimed at where the ball is after 0.55 s.
    begin[:, 2] = [50.0, 50.0, 50.0]
    meeting = np.asarray(throw()[1].position, float)[:, round(0.55 / FRAME * SUBSTEPS) - 1, 1]
    velocity[:, 2] = [-1.0, 1.5, 0.0]
    apart = np.asarray([0.18, 0.05, 0.03])
    begin[:, 2] = meeting + apart - velocity[:, 2] * 0.55 + np.asarray([0.0, GRAVITY / 2, 0.0]) * 0.55**2
    states, later = throw()
    names = ("position", "orientation", "velocity", "angular_velocity")
    channels = {
        name: np.concatenate(
            [np.asarray(getattr(states, name))[:, None], np.asarray(getattr(later, name))[:, SUBSTEPS - 1 :: SUBSTEPS]],
            1,
        )[:, :, 1:]
        for name in names
    }
    return Trajectories(("ball", "striker"), FRAME, **channels)


def noisy(data, seed, with_velocity=False):
    """Positions and orientations with noise; velocities, of which residuals know nothing, only help to begin."""
    random = np.random.default_rng(seed)
    position = data.position + NOISE.position * random.normal(size=data.position.shape)
    turn = NOISE.orientation * random.normal(size=(*data.orientation.shape[:-1], 3))
    orientation = np.asarray(turned(turn, data.orientation), float)
    velocities = (data.velocity, data.angular_velocity) if with_velocity else (None, None)
    return Trajectories(data.bodies, data.dt, position, orientation, *velocities)
