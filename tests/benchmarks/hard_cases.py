"""The hard scenes as measurements: how long each runs, with which settings, what is measured, its gates and peers.

Tests and the report (`hard_report`) run the same cases. A measurement is a plain number, so that a gate is a comparison.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import Cylinder, Options, Sphere, step
from tests.benchmarks import hard_scenes
from tests.benchmarks.hard_scenes import ROLLING_PUSH, Built, bridge_gaps, joint_gaps
from tests.scenes import GRAVITY, box_stack

TIERS: dict[str, dict[str, Any]] = {
    "pgs": {},
    "pgs, conjugate": {"conjugate": True},
    "pgs, 40 sweeps": {"velocity_iterations": 40},
    "soft_step": {"solver": "soft_step"},
    "soft_step, 16 substeps": {"solver": "soft_step", "substeps": 16},
    "converged": {"solver": "converged"},
}
"""Solver settings by the name under which the option table (docs/solvers.md) knows them."""


class Run(NamedTuple):
    """A record in NumPy, (step, body, component) but for the masses; the first body is static."""

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray
    start: np.ndarray
    mass: np.ndarray
    dt: float

    def last(self, seconds: float) -> slice:
        """The steps of the last seconds."""
        return slice(-max(1, round(seconds / self.dt)), None)

    @property
    def speed(self) -> np.ndarray:
        """(step, body) [m/s]."""
        return np.linalg.norm(self.velocity, axis=-1)


Measure = Callable[[Run], dict[str, float]]


class Push(NamedTuple):
    """A force on one body.

    Attributes:
      force: [N] all the time.
      growth: [N] more in each step.
      body: on which it acts.
      point: from its centre of mass [m], along the axes of the world.
    """

    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    growth: tuple[float, float, float] = (0.0, 0.0, 0.0)
    body: int = 1
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def loads(self, step_count: int) -> np.ndarray:
        """(step, 6) force and torque of each step."""
        force = np.asarray(self.force) + np.arange(1, step_count + 1)[:, None] * np.asarray(self.growth)
        return np.concatenate([force, np.cross(self.point, force)], axis=1)


NO_PUSH = Push()


@dataclasses.dataclass(frozen=True)
class Case:
    """One scene with its measurement.

    Attributes:
      label: of the benchmark suite.
      what: in words.
      build: from options.
      seconds: to simulate.
      measure: names and values of what is measured, units in the names.
      gates: largest value of each measurement that has a gate.
      tiers: keys of `TIERS` to report.
      tested: those that are to carry the scene (docs/solvers.md), and must meet the gates; none where that is not known yet.
      dt: [s].
      settings: further options.
      push: force from outside.
      peers: published figures for the same measurement.
    """

    label: str
    what: str
    build: Callable[[Options], Built]
    seconds: float
    measure: Measure
    gates: Mapping[str, float]
    tiers: tuple[str, ...]
    tested: tuple[str, ...]
    dt: float = 1 / 60
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    push: Push = NO_PUSH
    peers: str = ""

    @property
    def name(self) -> str:
        """Label and description."""
        return f"{self.label} {self.what}"

    def built(self, tier: str) -> Built:
        """Model and state in the current precision."""
        undamped = {"linear_damping": 0.0, "angular_damping": 0.0}
        return self.build(Options(**{"dt": self.dt, **undamped, **self.settings, **TIERS[tier]}))


def simulate(model: Any, state: Any, loads: Any, pushed: int) -> tuple[Any, Any]:
    """The final state and the motion after each step, with `loads` (step, 6) on the body `pushed`."""

    def body(current: Any, load: Any) -> tuple[Any, Any]:
        force = current.applied_force.at[pushed].add(load[:3])
        torque = current.applied_torque.at[pushed].add(load[3:])
        new = step(model, dataclasses.replace(current, applied_force=force, applied_torque=torque))
        return new, (new.position, new.orientation, new.velocity, new.angular_velocity)

    return jax.lax.scan(body, state, loads)


def record(case: Case, tier: str, seconds: float | None = None) -> tuple[Run, int]:
    """The run of a case, and the flags of the final state; shorter if `seconds` says so."""
    model, state = case.built(tier)
    steps = round((case.seconds if seconds is None else seconds) / case.dt)
    loads = jnp.asarray(case.push.loads(steps), state.position.dtype)
    final, motion = jax.jit(simulate, static_argnums=3)(model, state, loads, case.push.body)
    return as_run(case, model, state, motion), int(final.flags)


def as_run(case: Case, model: Any, state: Any, motion: Any) -> Run:
    """What `simulate` returned, in NumPy."""
    arrays = [np.asarray(part, dtype=float) for part in motion]
    return Run(*arrays, np.asarray(state.position, dtype=float), np.asarray(model.mass, dtype=float), case.dt)


# Measurements --------------------------------------------------------------------------------------------------------


def rolling(run: Run, along: np.ndarray) -> dict[str, float]:
    """Mean squared error of the velocities of ball 0 and the board (closed form: both accelerate uniformly)."""
    mass, count = 10.0, 25
    drive = ROLLING_PUSH - 0.4 * (mass + count) * GRAVITY
    ball = drive / (count + 3.5 * mass)
    time = run.dt * np.arange(1, len(run.velocity) + 1)[:, None]
    errors = [run.velocity[:, body] - rate * time * along for body, rate in ((1, 3.5 * ball), (2, ball))]
    return {"squared error of the velocities [m^2/s^2]": float(sum((e**2).sum(-1) for e in errors).mean())}


def overlap_of_balls(run: Run, radius: float = 0.1) -> dict[str, float]:
    """Mean over the steps of the sum of all squared overlaps."""
    total = 0.0
    for place in run.position[:, 1:]:
        gap = np.linalg.norm(place[:, None] - place[None], axis=-1)[np.triu_indices(len(place), 1)] - 2 * radius
        total += float((np.minimum(gap, 0.0) ** 2).sum() + (np.minimum(place[:, 1] - radius, 0.0) ** 2).sum())
    return {"sum of squared overlaps [m^2]": total / len(run.position)}


def energy_of_balls(run: Run) -> dict[str, float]:
    """Against that of the start, at rest."""
    mass = run.mass[1:]
    start = GRAVITY * (mass * run.start[1:, 1]).sum()
    energy = (mass * (0.5 * run.speed[:, 1:] ** 2 + GRAVITY * run.position[:, 1:, 1])).sum(-1)
    return {
        "energy gained / that at the start": float((energy / start - 1).max()),
        "mean squared error of the energy [J^2]": float(((energy - start) ** 2).mean()),
        "energy at the end / that at the start - 1": float(energy[-1] / start - 1),
    }


def standing(run: Run, size: float, first: int = 1) -> dict[str, float]:
    """How far any body goes from where it started, relative to its size."""
    moved = (run.position - run.start)[:, first:]
    return {
        "dip / size": float(-moved[..., 1].min() / size),
        "sink at the end / size": float(-moved[-1, :, 1].min() / size),
        "sideways / size": float(np.linalg.norm(moved[..., [0, 2]], axis=-1).max() / size),
    }


def bearing(run: Run, bodies: slice, half: float) -> dict[str, float]:
    """Small bodies under a load: how deep any is pressed into the ground y = 0, and whether anything is thrown out."""
    depth = (half - run.position[run.last(1.0), bodies, 1]) / (2 * half)
    after = run.speed[round(5.0 / run.dt) :, 1:] if len(run.speed) * run.dt > 5.5 else run.speed[-1:, 1:]
    return {
        "pressed into the ground / size": float(depth.max()),
        "largest speed after 5 s [m/s]": float(after.max()),
        "speed at the end [m/s]": float(run.speed[-1, 1:].max()),
    }


def house(run: Run) -> dict[str, float]:
    """Cards fallen; how far the top came down; how fast the cards creep."""
    drop = run.start[1:, 1] - run.position[:, 1:, 1]
    window = run.last(min(5.0, 0.5 * len(drop) * run.dt))
    seconds = len(drop[window]) * run.dt
    creep = np.linalg.norm(run.position[-1, 1:] - run.position[window][0, 1:], axis=-1) / seconds
    return {
        "cards fallen": float((~(np.abs(drop[-1]) < 0.1)).sum()),
        "drop of the top [m]": float(drop[-1, -1]),
        "creep [m/s]": float(creep.max()),
    }


def joined(run: Run, links: int) -> dict[str, float]:
    """Gaps of the joints, in the whole run and after three seconds, and the largest speed."""
    gaps = joint_gaps(run.position, run.orientation, links).max(-1)
    return {
        "widest gap / link": float(gaps.max()),
        "widest gap after 3 s / link": float(gaps[round(3.0 / run.dt) :].max(initial=0.0)),
        "largest speed [m/s]": float(run.speed.max()),
    }


def bridging(run: Run, links: int) -> dict[str, float]:
    """Gaps of the joints of a bridge, and the largest speed."""
    gaps = bridge_gaps(run.position, run.orientation, links)
    return {"widest gap / link": float(gaps.max()), "largest speed [m/s]": float(run.speed.max())}


def separating(run: Run) -> dict[str, float]:
    """Speeds of bodies that start with an overlap."""
    place = run.position[-1, 1:]
    apart = np.linalg.norm(place[:, None] - place[None], axis=-1)[np.triu_indices(len(place), 1)]
    return {
        "largest speed [m/s]": float(run.speed.max()),
        "speed at the end [m/s]": float(run.speed[-1].max()),
        "nearest centres at the end [m]": float(apart.min()),
    }


def pressed(run: Run, radius: float) -> dict[str, float]:
    """Balls on y = 0 under a plank, body 1: overlap, how far they are squeezed out, and the largest speed."""
    balls = run.position[:, 2:]
    underside = run.position[:, 1:2, 1] - 0.25
    overlap = np.maximum(radius - balls[..., 1], balls[..., 1] + radius - underside)
    aside = np.linalg.norm((run.position - run.start)[:, 2:, [0, 2]], axis=-1)
    return {
        "overlap / diameter": float(overlap.max() / (2 * radius)),
        "sideways / diameter": float(aside.max() / (2 * radius)),
        "largest speed [m/s]": float(run.speed.max()),
    }


def passing(run: Run, middle: float, half: float, top: float) -> dict[str, float]:
    """Bodies that go through the middle of a wall across X, from which the way around it does not count."""
    before, after = np.concatenate([run.start[None], run.position[:-1]])[:, 3:], run.position[:, 3:]
    crosses = (before[..., 0] < middle) & (after[..., 0] >= middle)
    share = (middle - before[..., 0]) / np.where(crosses, after[..., 0] - before[..., 0], 1.0)
    place = before + share[..., None] * (after - before)
    inside = crosses & (np.abs(place[..., 2]) < half) & (place[..., 1] < top)
    return {"bodies through the wall": float(inside.sum()), "largest speed [m/s]": float(run.speed.max())}


# Cases ---------------------------------------------------------------------------------------------------------------

ALL = ("pgs", "soft_step", "converged")
FINER = tuple(TIERS)
DAMPED = {"linear_damping": 0.1, "angular_damping": 0.1}
REST = {"dip / size": 0.01, "sideways / size": 0.005}
BEARS = {"pressed into the ground / size": 0.2, "largest speed after 5 s [m/s]": 5.0}
DIAGONAL = np.array([0.5, 0.0, 0.866]) / np.hypot(0.5, 0.866)


def _rolling(name: str, along: np.ndarray, peers: str) -> Case:
    return Case(
        "A1",
        f"balls on a board, pushed {name}",
        hard_scenes.rolling_balls,
        4.0,
        lambda run: rolling(run, along),
        {"squared error of the velocities [m^2/s^2]": 1e-6},
        ("pgs", "pgs, 40 sweeps", "converged"),
        ("pgs", "converged"),
        dt=1e-3,
        push=Push(tuple(ROLLING_PUSH * along)),
        peers=f"10 / 40 iterations: {peers}",
    )


def _collapsing(dt: float) -> Case:
    return Case(
        "A3",
        f"collapsing block of 216 balls, dt {dt:.4f}",
        hard_scenes.block_of_balls,
        10.0,
        overlap_of_balls,
        {"sum of squared overlaps [m^2]": 135 * dt**2},
        ("pgs",),
        ("pgs",),
        dt=dt,
        peers="at 1e-3: RaiSim 1.35e-4, ODE 1.57e-4, DART 2.8e-4, MuJoCo 0.095, Bullet 0.38; at 1e-2: RaiSim 0.0153, "
        "ODE 0.016, MuJoCo 0.93, Bullet 37",
    )


def _elastic(dt: float, squared: float) -> Case:
    return Case(
        "A4",
        f"elastic block of 216 balls, dt {dt:.4f}",
        lambda options: hard_scenes.block_of_balls(options, lowest=1.101, restitution=1.0),
        10.0,
        energy_of_balls,
        {"energy gained / that at the start": 1e-4, "mean squared error of the energy [J^2]": squared},
        ("pgs",),
        ("pgs",),
        dt=dt,
        peers="mean squared error at 1e-3: RaiSim 8.4, ODE 112, Bullet 4.1e4, DART 3.5e5; at 1e-2: 5e6 to 1e10",
    )


def _cubes(ratio: float, tiers: tuple[str, ...], tested: tuple[str, ...], peers: str) -> Case:
    return Case(
        "B1",
        f"cube of {ratio:g} times the mass on a cube",
        lambda options: hard_scenes.two_cubes(ratio, options),
        2.0,
        lambda run: standing(run, 0.2),
        REST,
        tiers,
        tested,
        peers=peers,
    )


def _dragged(ratio: float, tiers: tuple[str, ...], tested: tuple[str, ...]) -> Case:
    plain = _cubes(ratio, tiers, tested, "")
    # Half of what its friction holds; at its lower face, since pulled by its centre a heavy one tips the pair over.
    push = Push((0.5 * 0.9 * ratio * GRAVITY, 0.0, 0.0), body=2, point=(0.0, -0.1, 0.0))
    return dataclasses.replace(plain, what=f"{plain.what}, pulled", push=push)


def _loaded_pyramid(ratio: float) -> Case:
    return Case(
        "B2a",
        f"pyramid hit by a box of density {ratio:g}",
        lambda options: hard_scenes.loaded_pyramid(ratio, options),
        10.0,
        lambda run: bearing(run, slice(1, None), 1.0),
        BEARS,
        ALL,
        ("soft_step", "converged"),
    )


def _two_small(ratio: int, depth: float, tested: tuple[str, ...]) -> Case:
    return Case(
        "B2b",
        f"box of {ratio} times the mass on two small ones",
        lambda options: hard_scenes.big_on_two_small(depth, options),
        8.0,
        lambda run: bearing(run, slice(1, 3), 0.5),
        BEARS,
        FINER,
        tested,
    )


def _stack(count: int, tested: tuple[str, ...], peers: str) -> Case:
    return Case(
        "B3",
        f"stack of {count} cubes",
        lambda options: box_stack(count, 0.5, options, friction=0.6),
        10.0,
        lambda run: standing(run, float(count)),
        REST,
        (*ALL, "pgs, conjugate"),
        tested,
        peers=peers,
    )


def _column(name: str, shape: Any, tested: tuple[str, ...]) -> Case:
    return Case(
        "B3",
        f"column of 30 {name}",
        lambda options: hard_scenes.column(30, shape, options),
        10.0,
        lambda run: standing(run, 30.0),
        REST,
        ALL,
        tested,
    )


def _card_house(dt: float, tiers: tuple[str, ...], tested: tuple[str, ...]) -> Case:
    return Case(
        "B5a",
        f"card house, dt {dt:.4f}",
        hard_scenes.card_house,
        10.0,
        house,
        {"cards fallen": 0.0, "drop of the top [m]": 0.028, "creep [m/s]": 5e-4},
        tiers,
        tested,
        dt=dt,
        peers="fallen: PyBullet (50 iterations) 7 at 1/60, 18 at 1/240; MuJoCo 10 at 1/60, 0 at 1/240 (drop 35 mm)",
    )


CASES: tuple[Case, ...] = (
    _rolling(
        "along an axis",
        np.array([0.0, 0.0, 1.0]),
        "RaiSim 1.9e-6 / 4.1e-7, Bullet 8.6e-7 / 6.1e-15, ODE 4.8e-7 / 7.7e-9; MuJoCo 2e-3 to 9e-3; DART 0.43",
    ),
    _rolling("diagonally", DIAGONAL, "RaiSim 4.1e-7, Bullet 4e-27; ODE and DART 3.1, the board does not move"),
    _collapsing(1 / 240),
    _collapsing(1e-3),
    _elastic(1 / 240, 100.0),
    _elastic(1e-3, 10.0),
    _cubes(1.0, FINER, ("pgs", "soft_step", "converged"), ""),
    _cubes(
        1e2,
        FINER,
        ("pgs, conjugate", "soft_step, 16 substeps", "converged"),
        "dip: PyBullet (50 iterations) 0.021, MuJoCo 0.05",
    ),
    _cubes(1e3, FINER, ("converged",), "PyBullet throws the small cube out; MuJoCo 0.48; RaiSim's solver fails"),
    _dragged(1.0, FINER, ()),
    _dragged(1e2, FINER, ()),
    _dragged(1e3, FINER, ("converged",)),
    _loaded_pyramid(100.0),
    _loaded_pyramid(300.0),
    _two_small(400, 10.0, ("pgs, conjugate",)),
    _two_small(8000, 0.5, ("pgs, conjugate", "soft_step", "converged")),
    Case(
        "B2c",
        "cube on crossed sticks, mass ratio 200",
        hard_scenes.crossed_sticks,
        8.0,
        lambda run: {**bearing(run, slice(2, None), 0.2), **standing(run, 0.4, 2)},
        BEARS,
        ("pgs", "soft_step", "soft_step, 16 substeps", "converged"),
        ("soft_step", "converged"),
    ),
    _stack(
        10,
        ("pgs, conjugate", "soft_step", "converged"),
        "PyBullet collapses (10 iterations), leans 0.017 (50); MuJoCo dips 0.0014",
    ),
    _stack(20, ("pgs, conjugate", "soft_step", "converged"), "PyBullet collapses; MuJoCo dips 0.0028"),
    _stack(
        40,
        ("pgs, conjugate", "soft_step", "converged"),
        "PyBullet collapses; MuJoCo dips 0.0056; soft steps, in theory, 0.011",
    ),
    _column("spheres", Sphere(0.5), ("soft_step",)),
    _column("cylinders", Cylinder(0.5, 0.5), ("soft_step",)),
    Case(
        "B4",
        "wall of 210 cubes",
        lambda options: hard_scenes.wall(20, options),
        2000 / 60,
        lambda run: standing(run, 20.0),
        {"dip / size": 0.01, "sideways / size": 0.01},
        ("pgs", "soft_step"),
        ("soft_step",),
        peers="Box3D: a wall of base 80 falls after 1000 steps",
    ),
    _card_house(1 / 60, ALL, ()),
    _card_house(1 / 240, ALL, ("soft_step", "converged")),
    Case(
        "B5b",
        "tower of 102 planks, dt 0.01",
        hard_scenes.kapla_tower,
        60.0,
        lambda run: standing(run, 3.4),
        {"dip / size": 0.01, "sideways / size": 0.01},
        ("pgs", "soft_step"),
        (),
        dt=0.01,
        peers="steps until collapse (here of 6000): RaiSim 25 (10 iterations) to never (1000); Bullet 147 to 55058, "
        "ODE 122 to 6453, MuJoCo 218 to 3297, DART 17 to 19",
    ),
    Case(
        "B7",
        "chain of 10 links",
        lambda options: hard_scenes.chain(10, options),
        10.0,
        lambda run: joined(run, 10),
        {"widest gap / link": 0.01},
        ALL,
        ("pgs", "converged"),
        settings=DAMPED,
    ),
    Case(
        "B7a",
        "ball of 672 links' mass on a chain of 40",
        lambda options: hard_scenes.chain(40, options, 4021.0),
        10.0,
        lambda run: joined(run, 40),
        {"widest gap / link": 0.01},
        ALL,
        ("pgs",),
        settings=DAMPED,
        peers="a showcase of Box2D; sweeps stretch it by metres",
    ),
    Case(
        "B7b",
        "bridge of 160 links",
        lambda options: hard_scenes.bridge(160, options),
        10.0,
        lambda run: bridging(run, 160),
        {"widest gap / link": 0.02},
        ("pgs", "soft_step", "converged"),
        ("pgs",),
        settings=DAMPED,
        peers="a showcase of Box2D",
    ),
    Case(
        "B7c",
        "hanging chain of 40 links, made twice as long",
        lambda options: hard_scenes.chain(40, options, level=False, spacing=2.0),
        10.0,
        lambda run: joined(run, 40),
        {"widest gap after 3 s / link": 0.01, "largest speed [m/s]": 30.0},
        ALL,
        ("pgs",),
        settings=DAMPED,
    ),
    Case(
        "B10a",
        "pyramid of overlapping cubes",
        hard_scenes.overlapping_pyramid,
        5.0,
        separating,
        {"largest speed [m/s]": 12.5},
        ("pgs", "soft_step"),
        ("pgs", "soft_step"),
        peers="largest speed: PyBullet 3.4 (1/60), 15.3 (1/240); MuJoCo 13.5, 20.8",
    ),
    Case(
        "B10b",
        "20 cubes within 1e-4 of one point",
        lambda options: hard_scenes.at_one_point(1e-4, options),
        5.0,
        separating,
        {"largest speed [m/s]": 4.5},
        ("pgs", "soft_step"),
        ("pgs", "soft_step"),
        peers="largest speed: PyBullet 9.8, MuJoCo 50",
    ),
    Case(
        "B10c",
        "20 cubes at one point",
        lambda options: hard_scenes.at_one_point(0.0, options),
        5.0,
        separating,
        {"largest speed [m/s]": 4.5},
        ("pgs", "soft_step"),
        ("pgs", "soft_step"),
        peers="largest speed: PyBullet 39, MuJoCo 102",
    ),
    Case(
        "B10d",
        "8 x 8 balls under a plank pressed by up to 5e6 N",
        hard_scenes.compression,
        500 / 60,
        lambda run: pressed(run, 0.5),
        {"largest speed [m/s]": 4.5 + np.sqrt(2 * GRAVITY), "overlap / diameter": 0.1},
        ALL,
        ("pgs",),
        push=Push(growth=(0.0, -1e4, 0.0)),
    ),
    Case(
        "B12b",
        "ball at 500 m/s against a stack and a wall",
        hard_scenes.bullet_against_stack,
        2.0,
        lambda run: passing(run, 10.0, 10.0, 20.0),
        {"bodies through the wall": 0.0},
        ALL,
        ("pgs", "converged"),
        settings={"continuous": True},
        peers="PyBullet and MuJoCo pass through walls at 180 m/s and 1/60 to 1e-3 s",
    ),
)
