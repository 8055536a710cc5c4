"""The solid under a heightfield ends in walls: level ground is the top of a tall box, for contacts, rays and scenes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mathota_jax import Box, Flag, Heightfield, Plane, SceneBuilder, Sphere, rollout, time_of_impact
from mathota_jax.collision.pairs import PAIRS
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.vector import Vec3
from tests.heightfields import CELL, REACH, SIZES, UPRIGHT, natural, place, run, shape_of
from tests.marks import slow_but
from tests.scenes import repeat, undamped

KINDS = list(SIZES)
HALF = 1.0
LEVEL = np.zeros((9, 9))
DEEP = 5.0


def beside(count, seed):
    """Poses about the four sides of the level field."""
    rng = np.random.default_rng(seed)
    out, along = HALF + rng.uniform(-0.3, 0.9, count), rng.uniform(-1.6, 1.6, count)
    side = rng.integers(0, 4, count)
    sign = np.where(side % 2 == 0, -1.0, 1.0)
    x, z = np.where(side < 2, sign * out, along), np.where(side < 2, along, sign * out)
    turns = Rotation.random(count, random_state=rng).as_quat()[:, [3, 0, 1, 2]]
    return np.stack([x, rng.uniform(-1.5, 0.5, count), z], -1), turns


def against_the_box(kind, position, orientation):
    """Manifolds with the box; the normals out of the shape of that kind."""
    first = (kind, "box") in PAIRS
    size = {"half_extents": Vec3(*(jnp.full((1, 1), half) for half in (HALF, DEEP, HALF)))}

    def function(position, orientation):
        pose = place(position, orientation)
        ours = shape_of(kind, SIZES[kind]), Pose(pose.position) if kind == "sphere" else pose
        solid = size, place(np.array([[0.0, -DEEP, 0.0]]), UPRIGHT[None])
        return PAIRS[(kind, "box") if first else ("box", kind)].function(
            *((*ours, *solid) if first else (*solid, *ours))
        )

    found = natural(jax.jit(function)(position, orientation), len(position))
    return {**found, "normal": found["normal"] * (1.0 if first else -1.0)}


def height_of_lowest_point(kind, position, orientation):
    plane = {"normal": Vec3(*(jnp.full((1, 1), n) for n in (0.0, 1.0, 0.0))), "offset": jnp.zeros((1, 1))}
    pose = place(position, orientation)
    found = PAIRS["plane", kind].function(
        plane, None, shape_of(kind, SIZES[kind]), Pose(pose.position) if kind == "sphere" else pose
    )
    return least(natural(found, len(position)))


def least(found):
    return np.where(found["active"], found["separation"], np.inf).min(0)


@pytest.mark.parametrize("kind", slow_but(("sphere", "box"), KINDS))
def test_contacts_are_those_of_a_box(kind, float64, gate):
    """All around it, but for what stands level with the border."""
    position, orientation = beside(3000, 1)
    found, truth = run(kind, LEVEL, position, orientation), against_the_box(kind, position, orientation)
    gap, true = least(found), least(truth)
    near = (true > -0.02) & (true < 0.5)
    sideways = near & (np.abs(truth["normal"][0][:, 1]) < 1e-9)
    assert near.sum() > 1000 and sideways.sum() > 300
    level = np.abs(height_of_lowest_point(kind, position, orientation)) < 0.02 * REACH[kind]
    exact = level | (np.abs(gap - true) < 1e-8)
    gate("separation", (gap - true)[near & ~level & (true > 0)], 1e-8)
    gate("normal", (found["normal"][0] - truth["normal"][0])[near & ~level & (true > 1e-3)], 1e-4)
    overlap = near & ~level & (true < 0)
    # The deepest of several contacts counts, where an edge or a corner of the solid is a shorter way out.
    gate("share of shallow overlaps seen otherwise", (overlap & ~exact).sum() / overlap.sum(), 0.125)


@pytest.mark.parametrize("kind", slow_but(("box",), ("box", "cylinder", "cone")))
def test_a_face_leans_on_as_many_points(kind, float64, gate):
    """Flat along the wall at x = 1, well under the border."""
    turn = Rotation.identity() if kind == "box" else Rotation.from_rotvec([0.0, 0.0, -0.5 * np.pi])
    out = {"box": 0.3, "cylinder": 0.2, "cone": 0.1}[kind]
    for gap in (0.01, -0.002):
        position = np.array([HALF + out + gap, -1.0, 0.1])
        found = run(kind, LEVEL, position, turn.as_quat()[[3, 0, 1, 2]])
        used = found["active"][:, 0]
        assert used.sum() == 4 if kind != "cone" else used.sum() >= 3
        gate("separation", (found["separation"][:, 0] - gap)[used], 1e-12)
        gate("normal", found["normal"][used, 0] - [-1.0, 0.0, 0.0], 1e-12)


@functools.cache
def grounds(kind):
    """The same body beside the same ground, made of a heightfield or of a box."""
    shape = {"sphere": Sphere(0.3), "box": Box((0.3, 0.15, 0.25))}[kind]

    def build(ground, height):
        builder = SceneBuilder()
        builder.add_body(ground, static=True, position=(0, height, 0), friction=0.3, restitution=0.4)
        builder.add_body(shape, mass=1.0, position=(2, -1, 0), friction=0.3, restitution=0.4)
        return builder.build(undamped(dt=1 / 240))

    return build(Heightfield(LEVEL, CELL), 0.0), build(Box((HALF, DEEP, HALF)), -DEEP)


def thrown(state, kind, count=64):
    """From all sides at the walls, at up to 8 m/s."""
    rng = np.random.default_rng(5)
    angle = rng.uniform(0, 2 * np.pi, count)
    start = np.stack([2.2 * np.cos(angle), rng.uniform(-1.2, -0.6, count), 2.2 * np.sin(angle)], -1)
    target = np.stack([rng.uniform(-0.8, 0.8, count), start[:, 1], rng.uniform(-0.8, 0.8, count)], -1)
    velocity = (target - start) * rng.uniform(1.0, 4.0, (count, 1))
    many = repeat(state, count)
    turn = many.orientation
    if kind == "box":
        turn = turn.at[:, 1].set(Rotation.random(count, random_state=rng).as_quat())
    return dataclasses.replace(
        many,
        position=many.position.at[:, 1].set(start),
        velocity=many.velocity.at[:, 1].set(velocity),
        orientation=turn,
    )


@pytest.mark.parametrize("kind", slow_but(("sphere",), ("sphere", "box")))
def test_what_comes_from_beside_rebounds(kind, float64, gate):
    """It went through the border, was lifted over it and left with up to 6 J more than it had."""
    lost = []
    for model, state in grounds(kind):
        many = thrown(state, kind)
        final = jax.jit(jax.vmap(lambda s, m=model: rollout(m, s, 120)[0]))(many)
        assert not (np.asarray(final.flags) & Flag.DEEP_OVERLAP.value).any()
        gain = energy(model, final) - energy(model, many)
        gate("energy gained [J]", np.maximum(gain, 0.0), 0.02)
        lost.append(-gain)
        free = many.position[:, 1, 1] - 0.5 * 9.81 * 0.5**2
        assert (np.asarray(final.position[:, 1, 1] - free) < 1.0).all(), "lifted"
        inside = np.abs(np.asarray(final.position[:, 1])[:, [0, 2]]).max(1) < HALF
        assert not inside.any()
    # A single point foresees its rebound, four points wait for the touch: by a step's way they meet edges elsewhere.
    np.testing.assert_array_equal(lost[0] > 0.1, lost[1] > 0.1)
    assert (lost[0] > 0.1).sum() > 30
    gate("median energy lost as to a box [J]", np.median(np.abs(lost[0] - lost[1])), 0.1)


def energy(model, state):
    """Of the body [J]."""
    height, velocity, turn, spin = (
        np.array(x) for x in (state.position, state.velocity, state.orientation, state.angular_velocity)
    )
    local = Rotation.from_quat(np.roll(turn[:, 1], -1, -1)).inv().apply(spin[:, 1])
    kinetic = 0.5 * (velocity[:, 1] ** 2).sum(-1) + 0.5 * (np.asarray(model.inertia[1]) * local**2).sum(-1)
    return 9.81 * height[:, 1, 1] + kinetic


def test_what_slides_in_on_a_level_floor_goes_on(float64, gate):
    """Resting a fraction of a millimetre in the floor it is that much under the border: a step, no wall."""
    builder = SceneBuilder()
    builder.add_body(Heightfield(LEVEL, CELL), static=True, friction=0.0)
    builder.add_body(Plane((0, 1, 0), 0.0), static=True, friction=0.0)
    builder.add_body(Box((0.3, 0.15, 0.25)), mass=1.0, position=(2, 0.1499, 0), velocity=(-2, 0, 0), friction=0.0)
    model, state = builder.build(undamped(dt=1 / 240))
    final, _ = jax.jit(lambda s: rollout(model, s, 240))(state)
    gate("distance [m]", final.position[2, 0] - 0.0, 1e-3)
    gate("height [m]", final.position[2, 1] - 0.15, 1e-3)


def test_the_inside_of_a_bowl_has_no_walls(float64):
    """What lies low near a high border is not pushed out through it."""
    heights = np.zeros((9, 9))
    heights[[0, -1]], heights[:, [0, -1]] = 5.0, 5.0
    inner = 3.0 * CELL - 0.31
    position = np.array([[inner, 0.29, 0.0], [inner, 0.29, inner], [0.0, -0.3, inner]])
    found = run("sphere", heights, position, np.tile(UPRIGHT, (3, 1)))
    assert (np.abs(found["normal"][..., 1][found["active"]]) > 0.01).all()
    assert found["active"][0].all()


@pytest.mark.slow
@pytest.mark.parametrize("shape", [Sphere(0.3), Box((0.3, 0.15, 0.25))], ids=["sphere", "box"])
def test_flight_into_a_wall(shape, float64, gate):
    """From beside, 2 m away, at 4 m/s, well under the border."""
    still, flying = (np.zeros(3), np.zeros(3)), (np.array([-4.0, 0.0, 0.0]), np.zeros(3))
    start = (np.array([HALF + 2.0 + 0.3, -1.0, 0.1]), UPRIGHT)
    hit = time_of_impact(Heightfield(LEVEL, CELL), (np.zeros(3), UPRIGHT), still, shape, start, flying, 1.0)
    assert bool(hit.hit)
    gate("time [s]", hit.time - 0.5, 1e-6)
