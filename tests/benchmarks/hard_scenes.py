"""The hard cases of the solver tiers: what is built, how long it runs, and what of it is judged."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mathota_jax import Box, Capsule, Hinge, Options, Plane, SceneBuilder, Sphere
from tests.scenes import DOWN, axis_angle, box_stack, rotation_matrix

DT = 1 / 60

Record = dict[str, np.ndarray]
"""Positions, orientations and velocities (step, body, component), without the static first body."""


class Case(NamedTuple):
    """One scene.

    Attributes:
      name: with its label in the benchmark suite.
      build: from options.
      steps: of 1/60 s.
      judge: a line on the start (body, 3) and the record; the truth is in the name of what it measures.
      tiers: those to run.
    """

    name: str
    build: Callable[[Options], tuple[Any, Any]]
    steps: int
    judge: Callable[[np.ndarray, Record], str]
    tiers: tuple[str, ...]


def two_cubes(ratio: float, options: Options) -> tuple[Any, Any]:
    """A cube of mass `ratio` on one of 1 kg, sides 0.2 m."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=0.9)
    for level, mass in enumerate((1.0, ratio)):
        builder.add_body(Box((0.1, 0.1, 0.1)), mass=mass, position=(0.0, 0.1 + 0.2 * level, 0.0), friction=0.9)
    return builder.build(options)


def chain(links: int, options: Options, end_mass: float | None = None) -> tuple[Any, Any]:
    """Capsules of length 1 hung from a fixed point, lying along X; a heavier ball at the end if `end_mass` is given."""
    builder = SceneBuilder(gravity=DOWN)
    parent = builder.add_body(Sphere(0.1), static=True, collides=False)
    for index in range(links):
        child = builder.add_body(
            Capsule(0.125, 0.375), mass=5.98, position=(index + 0.5, 0, 0),
            orientation=axis_angle((0, 0, 1), np.pi / 2), collides=False,
        )  # fmt: skip
        builder.add_joint(Hinge(parent=parent, child=child, anchor=(index, 0, 0), axis=(0, 0, 1)))
        parent = child
    if end_mass:
        ball = builder.add_body(Sphere(8.0), mass=end_mass, position=(links + 8.0, 0, 0), collides=False)
        builder.add_joint(Hinge(parent=parent, child=ball, anchor=(links, 0, 0), axis=(0, 0, 1)))
    return builder.build(options)


def card_house(options: Options) -> tuple[Any, Any]:
    """Five levels of leaning cards, 40 in all (benchmark B5a)."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.7)
    height, left = 0.18, 0.0
    for level in range(5, 0, -1):
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


def overlapping_pyramid(options: Options) -> tuple[Any, Any]:
    """Four rows of cubes of 1 m that overlap by a quarter (benchmark B10a)."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=0.6)
    for row in range(4):
        for column in range(4 - row):
            place = (0.75 * (column + 0.5 * row), 0.5 + 0.75 * row, 0.0)
            builder.add_body(Box((0.5, 0.5, 0.5)), density=1.0, position=place, friction=0.6)
    return builder.build(options)


def _standing(start: np.ndarray, record: Record) -> str:
    moved = record["position"] - start
    sideways = np.linalg.norm(moved[..., [0, 2]], axis=-1).max()
    return (
        f"dip {_length(-moved[..., 1].min())}, sink at the end {_length(-moved[-1, :, 1].min())}, "
        f"sideways {_length(sideways)}"
    )


def joint_gaps(record: Record, links: int) -> np.ndarray:
    """Distances [m] (step, joint) between the ends of neighbouring links, the first against the fixed point."""
    position = record["position"][:, :links]
    along = -rotation_matrix(record["orientation"][:, :links])[..., :, 1]
    ends, starts = position + 0.5 * along, position - 0.5 * along
    gaps = np.concatenate([starts[:, :1], starts[:, 1:] - ends[:, :-1]], axis=1)
    return np.linalg.norm(gaps, axis=-1)


def _joined(links: int) -> Callable[[np.ndarray, Record], str]:
    def judge(_: np.ndarray, record: Record) -> str:
        gaps = joint_gaps(record, links).max(1)
        return f"widest gap {_share(gaps.max())} of a link, in the last second {_share(gaps[-60:].max())}"

    return judge


def _house(start: np.ndarray, record: Record) -> str:
    drop = start[:, 1] - record["position"][..., 1]
    speed = np.linalg.norm(record["velocity"], axis=-1)[-300:]
    fallen = int((~(np.abs(drop[-1]) < 0.1)).sum())
    return (
        f"{fallen} of 40 cards fallen, top drop {_length(drop[-1, -1])}, mean speed at the end {speed.mean():.2g} m/s"
    )


def _separating(_: np.ndarray, record: Record) -> str:
    speed = np.linalg.norm(record["velocity"], axis=-1)
    return f"largest speed {speed.max():.3g} m/s (gate 12.5), at the end {speed[-1].max():.2g} m/s"


def _length(value: float) -> str:
    if not np.isfinite(value):
        return "NaN"
    return f"{1e3 * value:.2g} mm" if abs(value) < 1.0 else f"{value:.2g} m"


def _share(value: float) -> str:
    return f"{100 * value:.2g} %" if np.isfinite(value) else "NaN"


ALL = ("pgs", "soft_step", "converged")
FINER = ("pgs", "pgs, 30 sweeps", "soft_step", "soft_step, 16 substeps", "converged")

CASES = (
    *(
        Case(f"cubes 1 : {ratio:g} (B1)", lambda options, ratio=ratio: two_cubes(ratio, options), 120, _standing, FINER)
        for ratio in (1.0, 100.0, 1000.0)
    ),
    *(
        Case(f"stack of {count} (B3)", lambda o, n=count: box_stack(n, 0.5, o, friction=0.6), 600, _standing, tiers)
        for count, tiers in ((10, ALL), (20, ALL[:2]), (40, ALL))
    ),
    Case("chain of 10", lambda options: chain(10, options), 600, _joined(10), ALL),
    Case("ball and chain (B7a)", lambda options: chain(40, options, 4021.0), 600, _joined(40), ALL[:2]),
    Case("overlapping pyramid (B10a)", overlapping_pyramid, 300, _separating, ALL[:2]),
    Case("card house (B5a)", card_house, 600, _house, ALL[:2]),
)
