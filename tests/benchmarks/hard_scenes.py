"""Scenes on which engines are known to fail, each from the source that made it known, as builders of (model, state).

Y is up and lengths are those of the source. Scenes of planar engines are built from bodies as deep as they are high.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from mathota_jax import Box, Capsule, Hinge, Options, Plane, SceneBuilder, Sphere
from mathota_jax.geometry import Shape
from tests.scenes import DOWN, axis_angle, rotation_matrix

Built = tuple[Any, Any]
"""Model and state."""


def two_cubes(ratio: float, options: Options) -> Built:
    """B1: a cube of mass `ratio` on one of 1 kg, sides 0.2 m (Le Lidec, "Contact models in robotics", 2023)."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=0.9)
    for level, mass in enumerate((1.0, ratio)):
        builder.add_body(Box((0.1, 0.1, 0.1)), mass=mass, position=(0.0, 0.1 + 0.2 * level, 0.0), friction=0.9)
    return builder.build(options)


# Spheres (SimBenchmark) ----------------------------------------------------------------------------------------------

ROLLING_PUSH = 150.0


def rolling_balls(options: Options) -> Built:
    """A1: 25 balls on a board that is pushed; friction 0.4 under the board and 0.8 on it."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.4)
    builder.add_body(Box((10.0, 0.5, 10.0)), mass=10.0, position=(0.0, 0.5 - 2e-5, 0.0), friction=0.4)
    for row in range(5):
        for column in range(5):
            place = (2.0 * row - 4.0, 1.5 - 6e-5, 2.0 * column - 4.0)
            builder.add_body(Sphere(0.5), mass=1.0, position=place, friction=1.6)
    return builder.build(options)


def block_of_balls(options: Options, side: int = 6, lowest: float = 0.101, restitution: float = 0.0) -> Built:
    """A3 and A4: side^3 balls of 10 kg in a jittered lattice, without friction."""
    jitter = np.random.default_rng(0).uniform(0.0, 1e-3, (side**3, 3))
    builder = SceneBuilder(gravity=DOWN)
    surface = {"friction": 0.0, "restitution": restitution}
    builder.add_body(Plane((0, 1, 0)), static=True, **surface)
    for index in range(side**3):
        x, depth, height = 0.21 * np.array([index % side, index // side % side, index // side**2]) + jitter[index]
        builder.add_body(Sphere(0.1), mass=10.0, position=(x, lowest + height, depth), **surface)
    return builder.build(options)


# Heavy on light (Solver2D, Rapier) -----------------------------------------------------------------------------------


def loaded_pyramid(ratio: float, options: Options, base: int = 10) -> Built:
    """B2a: a pyramid of boxes of 2 m, whose top one, of `ratio` times the density, falls on it from 2 m."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.5)
    for row in range(base):
        for column in range(base - row):
            top = row == base - 1
            place = (2.0 * column + row, 1.0 + 2.0 * row + 2.0 * top, 0.0)
            builder.add_body(Box((1.0, 1.0, 1.0)), density=ratio if top else 1.0, position=place, friction=0.5)
    return builder.build(options)


def big_on_two_small(depth: float, options: Options) -> Built:
    """B2b: a box of 20 m dropped by 15 m on two that are 1 m high and of half depth `depth`.

    With 10, the depth of the big one, it is the planar scene with a mass ratio of 400; with 0.5 the ratio is 8000.
    """
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True)
    for x in (-9.0, 9.0):
        builder.add_body(Box((0.5, 0.5, depth)), density=1.0, position=(x, 0.5, 0.0))
    builder.add_body(Box((10.0, 10.0, 10.0)), density=1.0, position=(0.0, 26.0, 0.0))
    return builder.build(options)


def crossed_sticks(options: Options) -> Built:
    """B2c: four levels of crossed sticks under a cube of 200 times the mass of one."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Box((2.0, 2.0, 2.0)), static=True, position=(0.0, -2.0, 0.0))
    for level in range(4):
        for side in (-0.8, 0.8):
            builder.add_body(Box((1.0, 0.2, 0.2)), density=1.0, position=(0.0, 0.2 + 0.8 * level, side))
        for side in (-0.8, 0.8):
            builder.add_body(Box((0.2, 0.2, 1.0)), density=1.0, position=(side, 0.6 + 0.8 * level, 0.0))
    builder.add_body(Box((2.0, 2.0, 2.0)), density=1.0, position=(0.0, 5.2, 0.0))
    return builder.build(options)


# Stacks (Box2D, PEEL) ------------------------------------------------------------------------------------------------


def column(count: int, shape: Shape, options: Options) -> Built:
    """B3: bodies 1 m high, exactly on one another."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.6)
    for level in range(count):
        builder.add_body(shape, density=1.0, position=(0.0, 0.5 + level, 0.0), friction=0.6)
    return builder.build(options)


def wall(base: int, options: Options) -> Built:
    """B4: rows of touching cubes of 1 m, each row one shorter."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.6)
    for row in range(base):
        for column in range(base - row):
            place = (column + 0.5 * row - 0.5 * base, 0.5 + row, 0.0)
            builder.add_body(Box((0.5, 0.5, 0.5)), density=1.0, position=place, friction=0.6)
    return builder.build(options)


def card_house(options: Options, levels: int = 5) -> Built:
    """B5a: levels of leaning cards, 40 in all with five."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.7)
    height, left = 0.18, 0.0
    for level in range(levels, 0, -1):
        for index in range(level):
            x = left + 0.35 * index
            cards = [(x, height, -65.0), (x + 0.175, height, 65.0)]
            if index < level - 1:
                cards.append((x + 0.25, height + 0.185, 0.0))
            for across, up, angle in cards:
                builder.add_body(
                    Box((0.2, 0.001, 0.1)), density=1.0, friction=0.7, position=(across, up, 0.0),
                    orientation=axis_angle((0, 0, 1), -np.radians(angle)),
                )  # fmt: skip
        height, left = height + 0.37, left + 0.175
    return builder.build(options)


def kapla_tower(options: Options, levels: int = 34) -> Built:
    """B5b: levels of three blocks of 0.2 x 0.05 x 0.1 m, each across the one below; 102 blocks with 34."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.8)
    for level in range(levels):
        for lane in (-0.05, 0.0, 0.05):
            along = level % 2 == 0
            half = (0.1, 0.05, 0.025) if along else (0.025, 0.05, 0.1)
            place = (0.0 if along else lane * 1.5, 0.05 + 0.1 * level, lane * 1.5 if along else 0.0)
            builder.add_body(Box(half), density=500.0, position=place, friction=0.8)
    return builder.build(options)


def overlapping_pyramid(options: Options) -> Built:
    """B10a: four rows of cubes of 1 m that overlap by a quarter."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.6)
    for row in range(4):
        for column in range(4 - row):
            place = (0.75 * (column + 0.5 * row), 0.5 + 0.75 * row, 0.0)
            builder.add_body(Box((0.5, 0.5, 0.5)), density=1.0, position=place, friction=0.6)
    return builder.build(options)


def at_one_point(spread: float, options: Options) -> Built:
    """B10b and c: 20 cubes of 1 m within `spread` of one point, without gravity."""
    offsets = np.random.default_rng(0).uniform(-spread, spread, (20, 3))
    builder = SceneBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_body(Sphere(0.1), static=True, position=(0.0, -100.0, 0.0), collides=False)
    for place in offsets:
        builder.add_body(Box((0.5, 0.5, 0.5)), density=1.0, position=place, friction=0.6)
    return builder.build(options)


def compression(options: Options) -> Built:
    """B10d: a plank of 9 x 0.5 x 9 m, body 1, on 64 balls of 1 m on the ground, all of density 1."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.6)
    builder.add_body(Box((4.5, 0.25, 4.5)), density=1.0, position=(0.0, 1.25, 0.0), friction=0.6)
    for row in range(8):
        for column in range(8):
            place = (1.1 * (row - 3.5), 0.5, 1.1 * (column - 3.5))
            builder.add_body(Sphere(0.5), density=1.0, position=place, friction=0.6)
    return builder.build(options)


# Chains (Box2D) ------------------------------------------------------------------------------------------------------


def chain(
    links: int, options: Options, end_mass: float | None = None, level: bool = True, spacing: float = 1.0
) -> Built:
    """B7: capsules of length 1 at a fixed point, level or hanging; a heavier ball at the end if `end_mass` is given.

    With a `spacing` above 1 the joints start open.
    """
    builder = SceneBuilder(gravity=DOWN)
    parent = builder.add_body(Sphere(0.1), static=True, collides=False)
    along = np.array([1.0, 0.0, 0.0] if level else [0.0, -1.0, 0.0])
    for index in range(links):
        child = builder.add_body(
            Capsule(0.125, 0.375), mass=5.98, position=(index + 0.5) * along,
            orientation=axis_angle((0, 0, 1), np.pi / 2 if level else 0.0), collides=False,
        )  # fmt: skip
        builder.add_joint(Hinge(parent=parent, child=child, anchor=index * along, axis=(0, 0, 1)))
        parent = child
    if end_mass:
        ball = builder.add_body(Sphere(8.0), mass=end_mass, position=(links + 8.0) * along, collides=False)
        builder.add_joint(Hinge(parent=parent, child=ball, anchor=links * along, axis=(0, 0, 1)))
    model, state = builder.build(options)
    return model, dataclasses.replace(state, position=state.position * spacing)


def bridge(links: int, options: Options) -> Built:
    """B7b: boxes of 1 x 0.25 m in a row, jointed, the first and the last also to the ground: a closed loop."""
    builder = SceneBuilder(gravity=DOWN)
    ground = builder.add_body(Sphere(0.1), static=True, collides=False)
    parent = ground
    for index in range(links):
        child = builder.add_body(
            Box((0.5, 0.125, 0.125)), density=20.0, position=(index + 0.5, 0.0, 0.0), collides=False
        )
        builder.add_joint(Hinge(parent=parent, child=child, anchor=(index, 0.0, 0.0), axis=(0, 0, 1)))
        parent = child
    builder.add_joint(Hinge(parent=parent, child=ground, anchor=(links, 0.0, 0.0), axis=(0, 0, 1)))
    return builder.build(options)


def bridge_gaps(position: np.ndarray, orientation: np.ndarray, links: int) -> np.ndarray:
    """`joint_gaps` of a bridge, (step, links + 1)."""
    position = position[:, 1:]
    along = rotation_matrix(orientation[:, 1:])[..., :, 0]
    starts, ends = position - 0.5 * along, position + 0.5 * along
    far = np.broadcast_to(np.array([float(links), 0.0, 0.0]), ends[:, :1].shape)
    gaps = np.concatenate([starts, far], axis=1) - np.concatenate([np.zeros_like(far), ends], axis=1)
    return np.linalg.norm(gaps, axis=-1)


def joint_gaps(position: np.ndarray, orientation: np.ndarray, links: int) -> np.ndarray:
    """Distances [m] (step, joint) between the ends of neighbouring links, the first against the fixed point.

    Args:
      position, orientation: (step, body, component) of all bodies, the fixed one first.
      links: their number.
    """
    position = position[:, 1 : links + 1]
    along = -rotation_matrix(orientation[:, 1 : links + 1])[..., :, 1]
    ends, starts = position + 0.5 * along, position - 0.5 * along
    gaps = np.concatenate([starts[:, :1], starts[:, 1:] - ends[:, :-1]], axis=1)
    return np.linalg.norm(gaps, axis=-1)


# Bullets (Box3D) -----------------------------------------------------------------------------------------------------


def bullet_against_stack(options: Options) -> Built:
    """B12b: a ball at 500 m/s, of ten times their density, at a stack of ten cubes before a wall."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.6)
    builder.add_body(Box((0.5, 10.0, 10.0)), static=True, position=(10.0, 10.0, 0.0), friction=0.6)
    for level in range(10):
        builder.add_body(Box((0.5, 0.5, 0.5)), density=1.0, position=(0.0, 0.5 + level, 0.0), friction=0.6)
    builder.add_body(Sphere(0.25), density=10.0, position=(-15.3, 5.2, 0.1), velocity=(500.0, 0.0, 0.0))
    return builder.build(options)
