"""The work-precision harness: its truths, its judge of penetration, equal scenes in all engines, and its conclusions."""

import dataclasses
import math

import jax
import numpy as np
import pytest

from mathota_jax import Box, Polyhedron, Sphere
from mathota_jax.step import step_worlds_last
from tests.benchmarks.work_precision import engine, fronts, mujoco_engine
from tests.benchmarks.work_precision.features import count_equations, worlds_last
from tests.benchmarks.work_precision.overlap import deepest
from tests.benchmarks.work_precision.scenes import SCENES, kept_steps, start_of, steps_of
from tests.benchmarks.work_precision.worlds import Body, plane, stack
from tests.hulls import BOX_CORNERS
from tests.scenes import axis_angle

DT = 1 / 240
RESTING = ("incline", "stack10", "massratio")


def record(name, **leaves):
    """Frames in which nothing moves, but for the leaves given."""
    start = start_of(name, SCENES[name].worlds)
    count = len(kept_steps(SCENES[name], DT))
    frames = stack([start] * count)
    return start, dataclasses.replace(
        frames, **{key: np.broadcast_to(v, getattr(frames, key).shape) for key, v in leaves.items()}
    )


@pytest.mark.parametrize("name", RESTING)
def test_what_rests_has_no_error_and_what_moves_has_that_of_the_motion(name):
    start, frames = record(name)
    assert SCENES[name].judge(start, frames, DT).max() == 0
    moved = frames.position.copy()
    moved[-1, :, -1, 1] -= 1e-3
    errors = SCENES[name].judge(start, dataclasses.replace(frames, position=moved), DT)
    assert errors == pytest.approx(1e3 if name == "incline" else 1.0)


def test_errors_of_a_slide_of_known_length():
    start = start_of("slide", 8)
    speed = start.velocity[:, 0, 0]
    place = start.position.copy()
    place[:, 0, 0] = 0.99 * speed**2 / (2 * 0.4 * 9.8)
    assert SCENES["slide"].judge(*record("slide", position=place), DT) == pytest.approx(0.01)
    assert speed.min() == 1.9 and speed.max() == 2.1


def test_errors_of_a_roll_of_known_distance_and_of_one_that_slips():
    start = start_of("roll", 8)
    speed = start.velocity[:, 0, 0]
    # A sphere thrown at 5 m/s: 7.662943 m in 2 s at 3.571429 m/s (BENCHMARKS A11); the distance is quadratic in the speed.
    rolls_at = speed * (2 / 7) / (0.2 * 9.81)
    distance = speed * rolls_at - 0.5 * 0.2 * 9.81 * rolls_at**2 + speed / 1.4 * (2 - rolls_at)
    assert np.interp(5.0, speed, distance) == pytest.approx(7.662943, abs=0.02)
    place, velocity, spin = start.position.copy(), start.velocity / 1.4, np.zeros_like(start.velocity)
    place[:, 0, 0], spin[:, 0, 2] = distance, -speed / 1.4 / 0.1
    good = {"position": place, "velocity": velocity, "angular_velocity": spin}
    assert SCENES["roll"].judge(*record("roll", **good), DT).max() < 1e-6
    assert SCENES["roll"].judge(*record("roll", **good | {"angular_velocity": 0.9 * spin}), DT) == pytest.approx(0.1)


def test_a_ball_that_never_rises_has_missed_its_apex():
    assert SCENES["bounce"].judge(*record("bounce"), DT) == pytest.approx(1.0)


def test_the_chain_that_still_hangs_level_is_off_by_the_way_to_its_true_tip():
    away = 1e3 * math.hypot(1 + 0.89431685, 0.14656506)
    assert SCENES["chain10"].judge(*record("chain10"), DT) == pytest.approx(away)


@pytest.mark.parametrize(
    ("name", "limit"), [("tumble", 1e-7), ("chain10", 1e-3), ("roll", 1e-4), ("slide", 1e-3), ("stack10", 0.05)]
)
def test_truths_against_another_engine(name, limit):
    """MuJoCo at 1/1000 s: with Runge-Kutta where nothing touches. BENCHMARKS A5 has 3.5e-7 m for the chain."""
    pytest.importorskip("mujoco")
    scene = SCENES[name]
    frames = mujoco_engine.MujocoProgram(scene, "tuned", 1 / 1000).record()
    assert scene.judge(start_of(name, scene.worlds), frames, 1 / 1000).max() < limit


def test_the_tumble_that_does_not_turn_is_seen():
    assert SCENES["tumble"].judge(*record("tumble"), DT).min() > 1.0


# Penetration ---------------------------------------------------------------------------------------------------------


def overlap(*bodies):
    moving = [body for body in bodies if body.mass is not None]
    return deepest(
        bodies,
        np.array([body.position for body in moving], float),
        np.array([body.orientation for body in moving], float),
    )


CUBE = Box((0.1, 0.1, 0.1))
ON_EDGE = tuple(axis_angle((0, 0, 1), math.pi / 4))


@pytest.mark.parametrize(
    ("bodies", "depth"),
    [
        ((plane(0.5), Body(CUBE, position=(0, 0.09, 0))), 0.01),
        ((plane(0.5), Body(CUBE, position=(0, 0.11, 0))), 0.0),
        ((plane(0.5), Body(CUBE, position=(0, 0.1, 0), orientation=ON_EDGE)), 0.1 * math.sqrt(2) - 0.1),
        ((plane(0.5, normal=(-1, 0, 0), offset=-0.3), Body(Sphere(0.1), position=(0.25, 0, 0))), 0.05),
        ((Body(Sphere(0.1)), Body(Sphere(0.2), position=(0, 0, 0.27))), 0.03),
        ((Body(CUBE), Body(CUBE, position=(0.02, 0.19, 0.03))), 0.01),
        ((Body(CUBE), Body(CUBE, position=(0, 0.1 + 0.1 * math.sqrt(2) - 0.02, 0), orientation=ON_EDGE)), 0.02),
        ((Body(CUBE), Body(Polyhedron(0.1 * BOX_CORNERS), position=(0.19, 0.0, 0.03))), 0.01),
    ],
)
def test_depth_of_known_overlaps(bodies, depth):
    assert overlap(*bodies) == pytest.approx(depth, abs=1e-12)


def test_edges_that_cross():
    """Two cubes on edge, one edge along Z below one along X: they touch at twice half the diagonal."""
    below = Body(CUBE, orientation=ON_EDGE)
    above = tuple(axis_angle((1, 0, 0), math.pi / 4))
    for depth in (0.004, 0.01):
        place = (0.0, 0.2 * math.sqrt(2) - depth, 0.0)
        assert overlap(below, Body(CUBE, position=place, orientation=above)) == pytest.approx(depth, abs=1e-12)


@pytest.mark.parametrize("name", ["pile27 spheres", "pile27 boxes", "hulls8"])
def test_piles_start_apart(name):
    start = start_of(name, 1)
    assert deepest(SCENES[name].world.bodies, start.position[0], start.orientation[0]) == 0


# Equal scenes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(SCENES))
def test_engines_get_the_same_bodies(name):
    mujoco = pytest.importorskip("mujoco")
    scene = SCENES[name]
    for profile in mujoco_engine.PROFILES:
        peer = mujoco.MjModel.from_xml_string(mujoco_engine.xml(scene, profile, DT))
    model, state = engine.build(scene.world, engine.undamped(scene, "pgs"))
    moving = slice(len(state.position) - len(scene.world.moving), None)
    first = peer.nbody - len(scene.world.moving)
    np.testing.assert_allclose(peer.body_mass[first:], model.mass[moving], rtol=1e-6)
    ours, theirs = (
        np.sort(np.asarray(values), axis=1) for values in (model.inertia[moving], peer.body_inertia[first:])
    )
    np.testing.assert_allclose(ours, theirs, rtol=1e-4)
    np.testing.assert_allclose(peer.opt.gravity, model.gravity, rtol=1e-6)
    data = mujoco.MjData(peer)
    mujoco.mj_kinematics(peer, data)
    np.testing.assert_allclose(data.xipos[first:], state.position[moving], atol=1e-6)


@pytest.mark.parametrize("name", list(SCENES))
def test_frames_end_at_the_horizon_at_every_time_step(name):
    scene = SCENES[name]
    for dt in (1 / 60, 1 / 120, 1 / 240, 1 / 480, 1 / 1000):
        assert kept_steps(scene, dt)[-1] == steps_of(scene, dt)
        assert steps_of(scene, dt) * dt == pytest.approx(scene.seconds, rel=1e-9)


# Conclusions ---------------------------------------------------------------------------------------------------------


def point(error, rate, dt=DT, engine="mathota_jax"):
    return {"engine": engine, "setting": "", "dt": dt, "error": error, "rate": rate}


def test_front_and_time_to_error():
    good, better, beaten, broken = point(1e-2, 1e6), point(1e-4, 1e5), point(1e-3, 1e4), point(None, 1e9)
    points = [beaten, better, broken, good]
    assert fronts.front(points) == [good, better]
    assert fronts.cheapest(points, 1e-3) is better
    assert fronts.cheapest(points, 1e-5) is None
    assert fronts.cost(good) == pytest.approx(240 / 1e6)


def test_a_peer_is_compared_at_its_own_error_and_time_step():
    points = [point(1e-2, 4e6), point(1e-4, 1e6), point(1e-5, 9e9, dt=1 / 60)]
    found, ratio = fronts.against(points, point(1e-3, 5e5, engine="MuJoCo"))
    assert found is points[1] and ratio == pytest.approx(2.0)
    assert math.isnan(fronts.against(points, point(1e-9, 1.0))[1])


def test_a_target_counts_only_what_keeps_its_error():
    target = SCENES["slide"].target
    points = [point(10 * target.error, 9 * target.rate), point(target.error, 0.5 * target.rate)]
    assert fronts.verdict("slide", points).ratio == pytest.approx(0.5)
    assert fronts.verdict("slide", points[:1]).point is None


def test_equations_of_a_step_grow_with_what_the_scene_has():
    def equations(name):
        model, state = engine.build(SCENES[name].world, engine.undamped(SCENES[name], "pgs"))
        return count_equations(jax.make_jaxpr(step_worlds_last)(*worlds_last(model, state), np.zeros((0, 1))).jaxpr)

    box_on_plane = equations("slide")
    assert 100 < equations("roll") < box_on_plane
    assert 100 < equations("tumble") < box_on_plane


def test_equations_inside_a_loop_count():
    def loop(x):
        return jax.lax.scan(lambda c, _: (c * 2.0 + 1.0, None), x, None, length=3)[0]

    assert count_equations(jax.make_jaxpr(loop)(1.0).jaxpr) == 1 + 2
