"""The benchmark scenes: what is built, how long it runs, how it is judged, and the targets. One entry each."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from mathota_jax import Box, Polyhedron, Sphere
from tests.benchmarks import scenes as closed_forms
from tests.benchmarks.work_precision.overlap import deepest
from tests.benchmarks.work_precision.worlds import Body, Motion, World, plane
from tests.scenes import (
    GRAVITY,
    angle_between,
    axis_angle,
    box_moments,
    quaternion_product,
    rotation_matrix,
    torque_free,
)

OURS = ("pgs", "pgs, 30 sweeps", "soft_step", "converged")
"""Settings of the engine that every scene but piles is run with; see `engine.SETTINGS`."""
OF_PILES = OURS[:3]
"""Without "converged", of which a step of 27 bodies takes 30 CPU-milliseconds."""
TIGHT = "pgs, tight capacity"
"""Setting that makes room for `Scene.capacity` close pairs, no more."""
TIGHT_QUICK = "pgs, tight capacity, 6 sweeps"
"""The same with fewer sweeps than by default."""
DOUBLE = "pgs, float64"
"""The first setting in float64, for scenes of which round-off is the error."""


@dataclasses.dataclass(frozen=True)
class Target:
    """World-steps per CPU-second that a setting must reach whose error at dt 1/240 is at most `error` [unit of scene]."""

    rate: float
    error: float


@dataclasses.dataclass(frozen=True)
class Scene:
    """One scene.

    Attributes:
      name: key.
      truth: what is measured, against what.
      unit: of the error; "1" for a relative one.
      scale: error [unit] that counts as 1 in `Options.for_error`.
      kind: group of `Options.for_error`.
      world: bodies.
      seconds: horizon.
      judge: (start (world, body, component), frames (frame, world, body, component), dt) -> error of each world [unit].
      frames: poses kept over the horizon, evenly spaced; None for every step.
      vary: start -> start with different worlds.
      worlds: different worlds whose errors are taken.
      batches: numbers of worlds at which our throughput is looked for.
      finest: smallest time step [s]; runs of many bodies take long.
      capacity: close pairs that the scene needs room for, of `TIGHT`.
      settings: of our engine.
      tuned: options of MuJoCo's tuned profile, by element of its model.
      default: what its default profile needs to take part at all.
      peers: further engines that can run the scene in reasonable time.
      target: None if there is none.
    """

    name: str
    truth: str
    unit: str
    scale: float
    kind: str
    world: World
    seconds: float
    judge: Callable[[Motion, Motion, float], np.ndarray]
    target: Target
    frames: int | None = 1
    vary: Callable[[Motion], Motion] = lambda start: start
    worlds: int = 8
    batches: tuple[int, ...] = (128, 512, 2048)
    finest: float = 1 / 1000
    capacity: int | None = None
    settings: tuple[str, ...] = OURS
    tuned: dict[str, dict[str, str]] = dataclasses.field(default_factory=dict)
    default: dict[str, dict[str, str]] = dataclasses.field(default_factory=dict)
    peers: tuple[str, ...] = ()


STIFF = {"option": {"cone": "elliptic"}, "geom": {"solref": "{stiffest} 1", "solimp": "0.99 0.999 0.001"}}
"""Tuned contacts of MuJoCo for what rests: elliptic cones, and the stiffest contact that its guard allows (2 dt)."""


RUNGE_KUTTA = {"option": {"integrator": "RK4"}}
"""Tuned MuJoCo for what moves: its best of eleven settings of cone, impratio, solver, integrator and solref."""


# One body with a closed form -----------------------------------------------------------------------------------------


def _spread(start: Motion, leaf: str, component: int, interval: tuple[float, float]) -> Motion:
    values = getattr(start, leaf).copy()
    values[:, 0, component] = closed_forms.spread(interval, len(values))
    return dataclasses.replace(start, **{leaf: values})


def _slide(start: Motion, frames: Motion, dt: float) -> np.ndarray:
    truth = closed_forms.slide_distance(start.velocity[:, 0, 0])
    return np.abs((frames.position[-1, :, 0, 0] - start.position[:, 0, 0]) / truth - 1)


def _bounce(start: Motion, frames: Motion, dt: float) -> np.ndarray:
    radius = closed_forms.BOUNCE_RADIUS
    gap = start.position[:, 0, 1] - radius
    apex = closed_forms.first_apex(frames.position[:, :, 0, 1] - radius)
    error = np.abs(apex / (closed_forms.BOUNCE_RESTITUTION**2 * gap) - 1)
    return np.where(np.isfinite(error), error, 1.0)  # it never rose


STICK_FRICTION, STICK_ANGLE = 0.5, 10.0


def _stick(start: Motion, frames: Motion, dt: float) -> np.ndarray:
    return 1e6 * np.linalg.norm(frames.position - start.position, axis=-1).max(axis=(0, 2))


ROLL_RADIUS, ROLL_FRICTION, ROLL_SPEEDS = 0.1, 0.2, (4.5, 5.5)


def _roll(start: Motion, frames: Motion, dt: float) -> np.ndarray:
    speed, seconds = start.velocity[:, 0, 0], SCENES["roll"].seconds
    rolling = speed / 1.4
    distance = rolling * seconds + 0.5 * (0.4 / 1.4) ** 2 * speed**2 / (ROLL_FRICTION * GRAVITY)
    errors = (
        frames.velocity[-1, :, 0, 0] / rolling - 1,
        -frames.angular_velocity[-1, :, 0, 2] * ROLL_RADIUS / rolling - 1,
        (frames.position[-1, :, 0, 0] - start.position[:, 0, 0]) / distance - 1,
    )
    return np.max(np.abs(errors), axis=0)


TUMBLE_HALF = (0.1, 0.2, 0.3)
TUMBLE_SPIN = (0.1, 10.0, 0.0)


def _turned(start: Motion) -> Motion:
    """The same tumble from other orientations: nothing but round-off may differ."""
    turns = np.roll(Rotation.random(len(start.orientation), random_state=0).as_quat(), 1, axis=-1)
    spin = np.einsum("wij,j->wi", rotation_matrix(turns), np.array(TUMBLE_SPIN))
    return dataclasses.replace(start, orientation=turns[:, None], angular_velocity=spin[:, None])


@functools.cache
def tumbled(seconds: float) -> tuple[float, ...]:
    """Turn of the torque-free box of BENCHMARKS A7a."""
    found = torque_free(box_moments(TUMBLE_HALF), TUMBLE_SPIN, seconds)[:4]
    return tuple(found / np.linalg.norm(found))


def _tumble(start: Motion, frames: Motion, dt: float) -> np.ndarray:
    turn = tumbled(SCENES["tumble"].seconds)
    truth = np.array([quaternion_product(first, turn) for first in start.orientation[:, 0]])
    return np.degrees(angle_between(frames.orientation[-1, :, 0], truth))


# Several bodies ------------------------------------------------------------------------------------------------------


def _standing(start: Motion, frames: Motion, dt: float) -> np.ndarray:
    """Sink or sideways motion of any body at the kept frames [mm]."""
    return 1e3 * np.linalg.norm(frames.position - start.position, axis=-1).max(axis=(0, 2))


CHAIN_LINKS, CHAIN_TIP = 10, (-0.89431685, -0.14656506)
"""Tip after 1 s, BENCHMARKS A5 (DOP853, relative tolerance 1e-12)."""


def _tip(start: Motion, frames: Motion, dt: float) -> np.ndarray:
    w, _, _, z = np.moveaxis(frames.orientation[-1, :, -1], -1, 0)
    half = 0.5 / CHAIN_LINKS
    x = frames.position[-1, :, -1, 0] + half * (w * w - z * z)
    y = frames.position[-1, :, -1, 1] + half * 2 * w * z
    return 1e3 * np.hypot(x - CHAIN_TIP[0], y - CHAIN_TIP[1])


def chain() -> World:
    """A level chain 1 m long of 1 kg; balls with the moment of a thin rod, since the motion is plane."""
    length = 1 / CHAIN_LINKS
    links = tuple(
        Body(Sphere(length * math.sqrt(5 / 24)), length, ((k + 0.5) * length, 0, 0), collides=False)
        for k in range(CHAIN_LINKS)
    )
    return World(links, anchors=tuple((k * length, 0.0, 0.0) for k in range(CHAIN_LINKS)))


def boxes(masses: tuple[float, ...], friction: float) -> World:
    """Cubes of 0.2 m, exactly touching."""
    half = closed_forms.SLIDE_HALF_EXTENT
    column = tuple(
        Body(Box((half,) * 3), mass, (0, half * (2 * level + 1), 0), friction=friction)
        for level, mass in enumerate(masses)
    )
    return World((plane(friction), *column))


PILE_SIZE = 0.1
"""Radius of the spheres, half size of the boxes [m]."""


def pile(shape: object, pitch: float, half_width: float, turn: float) -> World:
    """27 bodies above a bin of five planes, not quite on a lattice, each turned by `turn` [rad] about an axis of its own."""
    rng = np.random.default_rng(0)
    bodies = []
    for x, y, z in itertools.product((-1, 0, 1), (0, 1, 2), (-1, 0, 1)):
        place = pitch * np.array([x, y, z]) + [0, 1.4 * PILE_SIZE, 0] + rng.uniform(-0.005, 0.005, 3)
        orientation = axis_angle(rng.normal(size=3), turn)
        bodies.append(Body(shape, 1.0, tuple(place), tuple(orientation), friction=0.5))
    walls = ((1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1))
    return World((plane(0.5), *(plane(0.5, normal=n, offset=-half_width) for n in walls), *bodies))


def hulls() -> World:
    """Eight point-symmetric hulls of twelve vertices in a heap above a plane."""
    rng = np.random.default_rng(1)
    bodies = []
    for x, y, z in itertools.product((-1, 1), (0, 1), (-1, 1)):
        points = rng.normal(size=(6, 3))
        points *= 0.12 / np.linalg.norm(points, axis=1, keepdims=True)
        place = np.array([0.125 * x, 0.13 + 0.25 * y, 0.125 * z]) + rng.uniform(-0.005, 0.005, 3)
        bodies.append(Body(Polyhedron(np.concatenate([points, -points])), 1.0, tuple(place), friction=0.5))
    return World((plane(0.5), *bodies))


def _resting_overlap(name: str) -> Callable[[Motion, Motion, float], np.ndarray]:
    def judge(start: Motion, frames: Motion, dt: float) -> np.ndarray:
        bodies = SCENES[name].world.bodies
        last = range(len(frames.position) - 4, len(frames.position))
        return 1e3 * np.array(
            [
                max(deepest(bodies, frames.position[k, world], frames.orientation[k, world]) for k in last)
                for world in range(frames.position.shape[1])
            ]
        )

    return judge


SLOPE = math.radians(STICK_ANGLE)
RISE = (-math.sin(SLOPE), math.cos(SLOPE), 0.0)

SCENES = {
    scene.name: scene
    for scene in (
        Scene(
            "slide", "stopping distance of a cube against the closed form", "1", 1.0, "single",
            World(
                (
                    plane(closed_forms.SLIDE_FRICTION),
                    Body(Box((0.1, 0.1, 0.1)), 1.0, (0, 0.1, 0), velocity=(2, 0, 0), friction=closed_forms.SLIDE_FRICTION),
                ),
                gravity=(0, -closed_forms.GRAVITY, 0),
            ),
            closed_forms.SLIDE_SECONDS, _slide, Target(1.2e6, 1e-3),
            vary=lambda start: _spread(start, "velocity", 0, closed_forms.SLIDE_SPEEDS),
            tuned=RUNGE_KUTTA, peers=("MJX", "Brax spring", "PyBullet"),
        ),
        Scene(
            "bounce", "height of the first bounce of a sphere, restitution 0.8, against the closed form", "1", 1.0, "single",
            World(
                (
                    plane(0.0, closed_forms.BOUNCE_RESTITUTION),
                    Body(
                        Sphere(closed_forms.BOUNCE_RADIUS), 1.0, (0, closed_forms.BOUNCE_RADIUS + 1, 0),
                        restitution=closed_forms.BOUNCE_RESTITUTION,
                    ),
                ),
                gravity=(0, -closed_forms.GRAVITY, 0),
            ),
            closed_forms.BOUNCE_SECONDS, _bounce, Target(4e6, 1e-3), frames=None, batches=(512, 2048, 8192),
            vary=lambda start: _spread(
                start, "position", 1, tuple(closed_forms.BOUNCE_RADIUS + gap for gap in closed_forms.BOUNCE_GAPS)
            ),
            settings=("pgs", "pgs, 30 sweeps", "soft_step", "converged", "pgs, split at impacts"),
            default={"geom": {"solref": "{spring50}", "solimp": "0.99 0.99 0.001"}},
            tuned={"geom": {"solref": "{spring150}", "solimp": "0.99 0.99 0.001"}},
            peers=("MJX", "Brax spring", "PyBullet"),
        ),
        Scene(
            "incline", f"creep in 3 s of a slab that sticks on a slope of {STICK_ANGLE:g} degrees", "um", 1e5, "single",
            World(
                (
                    plane(STICK_FRICTION, normal=RISE),
                    Body(
                        Box((0.2, 0.05, 0.2)), 1.0, tuple(0.05 * component for component in RISE),
                        tuple(axis_angle((0, 0, 1), SLOPE)), friction=STICK_FRICTION,
                    ),
                )
            ),
            3.0, _stick, Target(1.2e6, 3.0), frames=30,
            tuned={**STIFF, "option": {"cone": "elliptic", "impratio": "100"}}, worlds=1,
            peers=("MJX", "Brax spring", "PyBullet"),
        ),
        Scene(
            "roll", "speed, spin and distance of a sphere thrown without spin, 2 s, against the closed form", "1", 1.0,
            "single",
            World(
                (
                    plane(ROLL_FRICTION),
                    Body(Sphere(ROLL_RADIUS), 1.0, (0, ROLL_RADIUS, 0), velocity=(5, 0, 0), friction=ROLL_FRICTION),
                )
            ),
            2.0, _roll, Target(2.5e6, 1e-5), vary=lambda start: _spread(start, "velocity", 0, ROLL_SPEEDS),
            batches=(512, 2048, 8192), tuned=RUNGE_KUTTA, peers=("MJX", "Brax spring", "PyBullet"),
        ),
        Scene(
            "tumble", "orientation of a torque-free box after 5 s against Euler's equations", "deg", 180.0, "single",
            World((Body(Box(TUMBLE_HALF), angular_velocity=TUMBLE_SPIN),), gravity=(0, 0, 0)),
            5.0, _tumble, Target(4e6, 0.01), vary=_turned,
            batches=(512, 2048, 8192), settings=(*OURS, DOUBLE), tuned=RUNGE_KUTTA,
            peers=("MJX", "Brax spring", "PyBullet"),
        ),
        Scene(
            "stack10", "sink or sideways motion of ten stacked cubes of 0.2 m after 5 s", "mm", 200.0, "stack",
            boxes((1.0,) * 10, 0.5), 5.0, _standing, Target(1e5, 0.2), finest=1 / 240, worlds=1, batches=(128, 192),
            capacity=9, settings=(*OURS, TIGHT, TIGHT_QUICK),
            tuned=STIFF, peers=("PyBullet",),
        ),
        Scene(
            "massratio", "sink or sideways motion of a cube of 1000 kg on one of 1 kg, 0.2 m each, after 2 s", "mm", 200.0,
            "mass_ratio",
            boxes((1.0, 1000.0), 0.9), 2.0, _standing, Target(4e5, 0.7), worlds=1, batches=(64, 256, 1024), tuned=STIFF,
            peers=("PyBullet",),
        ),
        Scene(
            "chain10", "tip of a chain of ten links let go level, after 1 s, against Lagrange's equations", "mm", 1000.0,
            "chain",
            chain(), 1.0, _tip, Target(2e5, 1.0), worlds=1, batches=(32, 128, 512),
            tuned=RUNGE_KUTTA,
        ),
        Scene(
            "pile27 spheres", "largest penetration of 27 spheres of 0.1 m radius at rest in a bin", "mm", 200.0, "pile",
            pile(Sphere(PILE_SIZE), 2.2 * PILE_SIZE, 0.35, 0.0), 3.0, _resting_overlap("pile27 spheres"),
            Target(12e3, 3.0), finest=1 / 240, worlds=1, frames=12, batches=(32, 128),
            capacity=100, settings=(*OF_PILES, TIGHT, TIGHT_QUICK), tuned=STIFF, peers=("PyBullet",),
        ),
        Scene(
            "pile27 boxes", "largest penetration of 27 cubes of 0.2 m at rest in a bin", "mm", 200.0, "pile",
            pile(Box((PILE_SIZE,) * 3), 2.5 * PILE_SIZE, 0.4, 0.15), 3.0, _resting_overlap("pile27 boxes"),
            Target(20e3, 9.0), finest=1 / 240, worlds=1, frames=12, batches=(32, 128),
            capacity=40, settings=(*OF_PILES, TIGHT, TIGHT_QUICK), tuned=STIFF, peers=("PyBullet",),
        ),
        Scene(
            "hulls8", "largest penetration of 8 hulls of 0.24 m at rest on a plane", "mm", 240.0, "pile",
            hulls(), 3.0, _resting_overlap("hulls8"), Target(6e4, 8.0), finest=1 / 240, worlds=1, frames=12,
            batches=(64, 128), capacity=9, settings=(*OF_PILES, TIGHT, TIGHT_QUICK), tuned=STIFF, peers=("PyBullet",),
        ),
    )
}  # fmt: skip


@functools.cache
def start_of(name: str, count: int) -> Motion:
    """The different worlds of a scene, repeated until there are `count`."""
    scene = SCENES[name]
    different = scene.vary(scene.world.start(scene.worlds))
    return different.map(lambda leaf: leaf[np.arange(count) % scene.worlds])


def steps_of(scene: Scene, dt: float) -> int:
    """Steps of `dt` in the horizon."""
    return round(scene.seconds / dt)


def kept_steps(scene: Scene, dt: float) -> np.ndarray:
    """Numbers of steps after which a frame is kept, ascending, the last one the horizon."""
    steps = steps_of(scene, dt)
    count = steps if scene.frames is None else scene.frames
    return np.unique(np.round(np.arange(1, count + 1) * steps / count).astype(int))
