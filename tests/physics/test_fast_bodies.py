"""Fast bodies pass through nothing (benchmark B12, guide 10.4)."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import (
    BallAndSocket,
    Box,
    Capsule,
    Cone,
    Cylinder,
    Flag,
    Options,
    Plane,
    Polyhedron,
    SceneBuilder,
    Sphere,
    energy,
    rollout,
    step,
)
from tests.benchmarks import hard_scenes
from tests.marks import QUICK_AND_SLOW_PRECISION, QUICK_IN_FLOAT64, slow_but
from tests.scenes import (
    advance,
    body_on_plane,
    invariants,
    motion,
    record_worlds,
    repeat,
    rotation_matrix,
    slab_on_plane,
    undamped,
)

DT = 1 / 60
RUNS = 1000
MOTION = ("position", "orientation", "velocity", "angular_velocity")
SHAPES = {
    "sphere": Sphere(0.1),
    "capsule": Capsule(0.1, 0.2),
    "box": Box((0.4, 0.1, 0.1)),
    "cylinder": Cylinder(0.1, 0.2),
    "cone": Cone(0.15, 0.2),
    "polyhedron": Polyhedron([(0.3, 0, 0), (-0.3, 0, 0), (0, 0.1, 0), (0, -0.1, 0), (0, 0, 0.2), (0, 0, -0.2)]),
}
OTHERS = [pytest.param(name, marks=pytest.mark.slow) for name in ("capsule", "cylinder", "cone", "polyhedron")]


def flying(shape, obstacle, continuous, surface=None, **body):
    """Body 0: an obstacle about the origin; body 1: the shape, in free space."""
    surface = surface or {"friction": 0.5}
    builder = SceneBuilder(gravity=(0, 0, 0))
    builder.add_body(obstacle, static=True, **surface)
    builder.add_body(shape, **{"density": 1000.0, "position": (-5, 0, 0), **surface, **body})
    return builder.build(undamped(dt=DT, continuous=continuous))


def shots(state, speed, spin, seed=0):
    """A batch that flies at the wall x = 0 from the left, from all sides and in every orientation."""
    rng = np.random.default_rng(seed)
    speed, spin = np.broadcast_to(speed, RUNS), np.broadcast_to(spin, RUNS)
    place = np.stack([-rng.uniform(0.6, 4, RUNS), *rng.uniform(-3, 3, (2, RUNS))], axis=-1)
    heading = np.stack([np.ones(RUNS), *rng.uniform(-0.5, 0.5, (2, RUNS))], axis=-1)
    turn, axis = rng.normal(size=(RUNS, 4)), rng.normal(size=(RUNS, 3))
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    states = repeat(state, RUNS)
    return dataclasses.replace(
        states,
        position=states.position.at[:, 1].set(place),
        orientation=states.orientation.at[:, 1].set(turn),
        velocity=states.velocity.at[:, 1].set(heading * speed[:, None]),
        angular_velocity=states.angular_velocity.at[:, 1].set(axis * spin[:, None]),
    )


def escapes(model, states, steps=20):
    """Which runs ever have the centre of body 1 beyond the middle of the wall, or end up not finite."""
    final, record = record_worlds(repeat(model, RUNS), states, steps, motion)
    assert not np.any(np.asarray(final.flags) & ~Flag.DEEP_OVERLAP), "the worlds stay finite"
    return (np.asarray(record["position"])[:, :, 1, 0] > 0).any(0)


@pytest.mark.parametrize("half", [0.1, 0.05, 5e-4], ids=["0.2 m", "0.1 m", "1 mm"])
@pytest.mark.parametrize("continuous", [False, True])
def test_a_sphere_never_passes_a_wall(continuous, half):
    """B12a and f: 1000 runs at 1 to 200 m/s."""
    model, state = flying(SHAPES["sphere"], Box((half, 20, 20)), continuous)
    states = shots(state, 10 ** np.random.default_rng(1).uniform(0, 2.3, RUNS), 20.0)
    assert not escapes(model, states).any()


@pytest.mark.slow
@pytest.mark.parametrize("half", [0.1, 5e-4], ids=["0.2 m", "1 mm"])
@pytest.mark.parametrize("shape", ["box", *OTHERS])
def test_a_turning_body_never_passes_a_wall(shape, half):
    """B12a: 1000 runs of every shape at 1 to 200 m/s, turning at up to 40 rad/s."""
    model, state = flying(SHAPES[shape], Box((half, 20, 20)), continuous=True)
    rng = np.random.default_rng(2)
    states = shots(state, 10 ** rng.uniform(0, 2.3, RUNS), rng.uniform(0, 40, RUNS))
    assert not escapes(model, states).any()


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_sphere_comes_to_rest_at_the_surface(precision, gate):
    """B12a: with e = 0 at 180 m/s, straight at the wall, the surfaces meet and stay."""
    for continuous, limit in ((False, 1e-5), (True, 2e-4)):
        model, state = flying(Sphere(0.1), Box((0.1, 20, 20)), continuous, velocity=(180.0, 0, 0))
        final = advance(model, state, 20)
        gate("centre [m]", float(final.position[1, 0]) + 0.2, limit)
        gate("velocity [m/s]", final.velocity[1], 1e-3)


def test_an_elastic_ball_stays_in_its_room(float64, gate):
    """B12c: 60 s at 170 m/s in a room of 20 x 20 x 10 m; each coordinate goes to and fro at its own constant speed."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"friction": 0.0, "restitution": 1.0}
    half = np.array([10.0, 5.0, 10.0])
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.zeros(3)
            normal[axis] = -sign
            builder.add_body(Plane(normal=normal, offset=-half[axis]), static=True, **surface)
    speed = np.array([120.0, 7.0, 120.0])
    ball = builder.add_body(Sphere(0.5), mass=1.0, velocity=speed, **surface)
    path = DT * np.arange(1, 3601)[:, None] * speed + half - 0.5
    width = 2 * half - 1.0
    truth = np.abs((path + width) % (2 * width) - width) - (half - 0.5)
    for continuous in (False, True):
        model, state = builder.build(undamped(dt=DT, continuous=continuous))
        _, record = record_worlds(repeat(model, 1), repeat(state, 1), 3600, motion)
        place = np.abs(np.asarray(record["position"])[:, 0, ball])
        gate("centre outside of the room [m]", np.maximum(0.0, (place - half).max()), 0.0)
        if not continuous:  # which stops the ball at a wall for the rest of a step, one wall after the other
            gate("place - truth [m]", np.asarray(record["position"])[:, 0, ball] - truth, 1e-9)
        gate("overlap with a wall / radius", np.maximum(0.0, (place - (half - 0.5)).max()) / 0.5, 1e-3)
        energy = np.sum(np.asarray(record["velocity"])[:, 0, ball] ** 2, axis=-1)
        gate("energy / start - 1", energy / (120.0**2 * 2 + 49) - 1, 1e-9)


def test_a_spinning_stick_does_not_fall_through_the_ground():
    """B12d: half (2, 0.1, 0.1) m at 100 m/s, turning at up to 50 rad/s."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    builder.add_body(Plane(normal=(-1, 0, 0), offset=0.0), static=True)
    builder.add_body(Box((2.0, 0.1, 0.1)), mass=1.0, position=(-5, 0, 0))
    model, state = builder.build(undamped(dt=DT, continuous=True))
    states = shots(state, 100.0, np.random.default_rng(3).uniform(-50, 50, RUNS))
    states = dataclasses.replace(states, position=states.position.at[:, 1, 0].add(-2.0))
    assert not escapes(model, states, steps=40).any()


@pytest.mark.parametrize("way", slow_but(("pgs",), ("pgs", "soft_step", "converged")))
def test_what_flies_past_touches_nothing(way, gate):
    """Balls that pass a post and each other at up to 200 m/s, by as little as a hundredth of their radius."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    radius = 0.1
    for _ in range(2):
        builder.add_body(Sphere(radius), mass=1.0, friction=0.5)
    builder.add_body(Sphere(radius), static=True, friction=0.5, position=(0, 0, 0))
    model, state = builder.build(undamped(dt=DT, solver=way))
    rng = np.random.default_rng(8)
    angle, clearance = rng.uniform(0, 2 * np.pi, RUNS), radius * (2.0 + 10 ** rng.uniform(-2, 1, RUNS))
    beside = np.stack([np.zeros(RUNS), np.cos(angle), np.sin(angle)], axis=-1) * clearance[:, None]
    place, velocity = np.zeros((2, RUNS, 3, 3))
    place[:, 0], place[:, 1] = beside, -beside
    place[:, :2, 0] = rng.uniform(-3, 3, (RUNS, 2))
    velocity[:, :2, 0] = -np.sign(place[:, :2, 0]) * 10 ** rng.uniform(0.5, 2.3, (RUNS, 2))
    states = dataclasses.replace(repeat(state, RUNS), position=jnp.asarray(place), velocity=jnp.asarray(velocity))
    final, _ = record_worlds(repeat(model, RUNS), states, 20, motion)
    gate("change of velocity [m/s]", np.asarray(final.velocity) - velocity, 1e-5)


@pytest.mark.parametrize("way", slow_but(("pgs",), ("pgs", "soft_step", "converged")))
def test_balls_that_roll_past_each_other_roll_straight_on(way, gate):
    """On a table, 3 cm and more apart, at 3 to 100 m/s: what the table does to them does not bring them together."""
    radius = 0.1
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, friction=0.5)
    for _ in range(2):
        builder.add_body(Sphere(radius), mass=1.0, friction=0.5)
    model, state = builder.build(undamped(dt=DT, solver=way))
    rng = np.random.default_rng(9)
    place, velocity, spin = np.zeros((3, RUNS, 3, 3))
    place[:, 1:, 1] = radius
    place[:, 1:, 0] = rng.uniform(-2, 2, (RUNS, 2))
    place[:, 2, 2] = 2 * radius + 0.03 + rng.uniform(0, 0.3, RUNS)
    velocity[:, 1:, 0] = -np.sign(place[:, 1:, 0]) * 10 ** rng.uniform(0.5, 2.0, (RUNS, 2))
    spin[:, 1:, 2] = -velocity[:, 1:, 0] / radius
    moved = {"position": place, "velocity": velocity, "angular_velocity": spin}
    states = dataclasses.replace(
        repeat(state, RUNS), **{name: jnp.asarray(x, jnp.float32) for name, x in moved.items()}
    )
    final, _ = record_worlds(repeat(model, RUNS), states, 30, motion)
    gate("change of velocity [m/s]", np.asarray(final.velocity)[..., ::2] - velocity[..., ::2], 0.02)


@pytest.mark.parametrize("way", slow_but(("pgs",), ("pgs", "soft_step", "converged")))
def test_a_ball_that_the_floor_deflects_meets_the_ball_ahead(way, gate):
    """Its own way would pass below; the floor turns it within the step, and both go on at half its speed along the floor."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    smooth = {"friction": 0.0, "restitution": 0.0}
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, **smooth)
    builder.add_body(Sphere(0.1), mass=1.0, position=(0, 0.11, 0), velocity=(40.0, -40.0, 0), **smooth)
    builder.add_body(Sphere(0.1), mass=1.0, position=(0.4, 0.1, 0), **smooth)
    model, state = builder.build(undamped(dt=DT, solver=way))
    final = advance(model, state, 6)
    gate("speed along the floor - 20 [m/s]", np.asarray(final.velocity)[1:, 0] - 20.0, 0.05)


@pytest.mark.slow
def test_nothing_of_a_struck_stack_passes_the_wall_behind_it():
    """B12b: 1000 balls at 50 to 500 m/s, at all heights and from up to 30 degrees beside the normal, at ten cubes."""
    model, state = hard_scenes.bullet_against_stack(undamped(dt=DT, continuous=True))
    rng = np.random.default_rng(6)
    speed, angle = 50.0 * 10 ** rng.uniform(0, 1, RUNS), np.radians(rng.uniform(-30, 30, RUNS))
    heading = np.stack([np.cos(angle), rng.uniform(-0.1, 0.1, RUNS), np.sin(angle)], axis=-1)
    aim = np.stack([np.zeros(RUNS), rng.uniform(0.3, 9.5, RUNS), rng.uniform(-0.6, 0.6, RUNS)], axis=-1)
    start = aim - heading * rng.uniform(1.0, 4.0, RUNS)[:, None]
    start[:, 1] = np.maximum(start[:, 1], 0.3)
    ball = model.scene.body_count - 1
    states = repeat(state, RUNS)
    states = dataclasses.replace(
        states,
        position=states.position.at[:, ball].set(start),
        velocity=states.velocity.at[:, ball].set(heading * speed[:, None]),
        angular_velocity=states.angular_velocity.at[:, ball].set(rng.normal(size=(RUNS, 3)) * 10.0),
    )
    final, record = record_worlds(repeat(model, RUNS), states, 30, motion)
    assert not np.any(np.asarray(final.flags) & int(Flag.NON_FINITE))
    place = np.asarray(record["position"])[:, :, 2:]
    struck = np.abs(place[-1, :, :-1, 0]).max(-1) > 1.0
    assert struck.mean() > 0.5, "most stacks are hit"
    behind = (place[..., 0] > 10.0) & (place[..., 1] < 20.0) & (np.abs(place[..., 2]) < 10.0)
    assert not behind.any(), f"{behind.any((0, 2)).sum()} of {RUNS} runs"
    assert (place[..., 1] > 0.0).all(), "nothing falls through the ground"


@pytest.mark.parametrize("shape", ["sphere", pytest.param("box", marks=pytest.mark.slow)])
def test_two_fast_bodies_that_meet_head_on_do_not_pass_each_other(shape):
    builder = SceneBuilder(gravity=(0, 0, 0))
    for x in (-1.0, 1.0):
        builder.add_body(SHAPES[shape], mass=1.0, position=(x, 0, 0))
    model, state = builder.build(undamped(dt=DT, continuous=True))
    rng = np.random.default_rng(4)
    states = repeat(state, RUNS)
    speed = 10 ** rng.uniform(0.5, 2.3, (RUNS, 2))
    velocity = np.zeros((RUNS, 2, 3))
    velocity[:, 0, 0], velocity[:, 1, 0] = speed[:, 0], -speed[:, 1]
    offset = rng.uniform(-0.02, 0.02, (RUNS, 2))
    spin = 0.0 if shape == "sphere" else rng.normal(size=(RUNS, 2, 3)) * 10
    states = dataclasses.replace(
        states,
        velocity=jnp.asarray(velocity, states.velocity.dtype),
        angular_velocity=states.angular_velocity + spin,
        position=states.position.at[:, 1, 1:].add(offset),
    )
    _, record = record_worlds(repeat(model, RUNS), states, 1, motion)
    place = np.asarray(record["position"])[0]
    assert (place[:, 0, 0] < place[:, 1, 0]).all()


def test_a_sphere_that_passes_an_edge_is_not_stopped(precision, gate):
    """It clears the top of the wall by 0.1 m at 180 m/s; the nearest point of the wall is ahead of it all the time."""
    model, state = flying(
        Sphere(0.1), Box((0.1, 1.0, 1.0)), True, position=(-3.0, 1.2, 0.0), velocity=(180.0, 0.0, 0.0)
    )
    final = advance(model, state, 3)
    gate("velocity [m/s]", np.asarray(final.velocity[1]) - [180.0, 0.0, 0.0], 1e-4)
    gate("place [m]", np.asarray(final.position[1]) - [-3.0 + 3 * 180 * DT, 1.2, 0.0], 1e-4)


def test_the_stop_is_where_the_surfaces_meet(precision, gate):
    """Obliquely at a plane, alone: x of the centre -0.1, the rest of the way the share of the step until then."""
    model, state = flying(
        Sphere(0.1), Plane(normal=(-1, 0, 0), offset=0.0), True, position=(-1.1, 0, 0), velocity=(120.0, 30.0, 0.0)
    )
    after = step(model, state)
    gate("velocity untouched [m/s]", np.asarray(after.velocity[1]) - [120.0, 30.0, 0.0], 1e-5)
    gate("place [m]", np.asarray(after.position[1]) - [-0.1, 0.25, 0.0], 2e-4)
    assert float(after.position[1, 0]) < -0.1, "the surfaces do not overlap"


def test_gradient_of_the_stop(float64, gate):
    """With gap g and speeds u, v the stop is at x = -0.1 whatever they are, and at y = v g / u."""
    model, state = flying(
        Sphere(0.1), Plane(normal=(-1, 0, 0), offset=0.0), True, position=(-1.1, 0, 0), velocity=(120.0, 30.0, 0.0)
    )

    def place(velocity, x):
        start = dataclasses.replace(
            state, velocity=state.velocity.at[1].set(velocity), position=state.position.at[1, 0].set(x)
        )
        return step(model, start).position[1]

    by_velocity, by_x = jax.jit(jax.jacrev(place, (0, 1)))(jnp.array([120.0, 30.0, 0.0]), -1.1)
    gap = 1.0 - 1e-4  # to the distance at which it stops
    truth = np.array([[0, 0, 0], [-30.0 * gap / 120**2, gap / 120.0, 0], [0, 0, gap / 120.0]])
    gate("by the velocity", np.asarray(by_velocity) - truth, 1e-9)
    gate("by the place", np.asarray(by_x) - [0.0, -30.0 / 120.0, 0.0], 1e-9)


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_slow_bodies_do_not_notice(precision, gate):
    """Neutral equals absent, but for the round-off of two programs (M2): nothing moves half its inner radius in a step."""
    finals = []
    for continuous in (False, True):
        model, state = slab_on_plane(velocity=(1.0, 0.0, 0.3), options=undamped(dt=DT, continuous=continuous))
        finals.append(advance(model, state, 40))
    limit = 1e-6 if precision == np.float32 else 1e-12
    for name in ("position", "orientation", "velocity"):
        gate(name, np.asarray(getattr(finals[0], name)) - np.asarray(getattr(finals[1], name)), limit)
    weight = 9.81 * float(model.mass[1])
    gate("contact force / weight", np.asarray(finals[0].contact_force - finals[1].contact_force) / weight, 100 * limit)


def test_close_pairs_are_refused():
    builder = SceneBuilder()
    for x in range(3):
        builder.add_body(Sphere(0.1), mass=1.0, position=(x, 0, 0))
    with pytest.raises(ValueError, match="continuous"):
        builder.build(Options(continuous=True, broadphase="all_pairs"))


@pytest.mark.parametrize("dt", [1 / 60, 1 / 10])
def test_a_fast_turn_keeps_its_energy(float64, dt, gate):
    """A box in free flight at 60 rad/s: 1 and 6 rad a step. Energy and momentum follow from the equations of Euler."""
    model, state = body_on_plane(Box((0.4, 0.1, 0.2)), gravity=(0, 0, 0), position=(0, 9, 0), options=undamped(dt=dt))
    spin = 60.0 * np.array([0.3, 0.9, 0.33]) / np.linalg.norm([0.3, 0.9, 0.33])
    state = dataclasses.replace(state, angular_velocity=state.angular_velocity.at[1].set(spin))
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), 60, motion)
    inertia = np.asarray(model.inertia[1])
    local = np.einsum("...ji,...j->...i", rotation_matrix(record["orientation"][:, 0, 1]),
                      np.asarray(record["angular_velocity"])[:, 0, 1])  # fmt: skip
    energy = np.sum(inertia * local**2, axis=-1)
    gate("energy / start - 1", energy / np.sum(inertia * spin**2) - 1, 0.02 if dt < 0.05 else 0.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "restitution"),
    [(0.3, 0.5), (0.3, 0.0), (0.0, 0.0), (0.0, 0.5)],
    ids=str,
)
def test_a_spinning_plank_gains_no_energy(float64, gate, friction, restitution):
    """A plank that turns by a radian and more in a step is stopped in the orientation in which it meets the wall."""
    model, state = flying(Box((0.2, 0.02, 0.1)), Box((0.005, 3, 3)), True, {"friction": 0.3, "restitution": 0.5})
    model = dataclasses.replace(
        model,
        friction=jnp.full_like(model.friction, friction),
        restitution=jnp.full_like(model.restitution, restitution),
    )
    rng, count = np.random.default_rng(0), 96
    speed = np.stack([rng.uniform(5, 60, count), *rng.uniform(-5, 5, (2, count))], axis=-1)
    turn = rng.normal(size=(count, 4))
    states = repeat(state, count)
    states = dataclasses.replace(
        states,
        position=states.position.at[:, 1].set(jnp.array([-0.6, 0, 0])),
        orientation=states.orientation.at[:, 1].set(turn / np.linalg.norm(turn, axis=-1, keepdims=True)),
        velocity=states.velocity.at[:, 1].set(speed),
        angular_velocity=states.angular_velocity.at[:, 1].set(40.0 * rng.normal(size=(count, 3))),
    )
    _, record = record_worlds(repeat(model, count), states, 60, motion)
    properties = {"mass": model.mass[1:], "inertia": model.inertia[1:]}

    def energy(place):
        """Kinetic energy of a motion (..., body, component)."""
        return invariants(properties, *(np.asarray(place[name])[..., 1:, :] for name in MOTION))[0]

    first = energy({name: getattr(states, name) for name in MOTION})
    gate("energy / that at first - 1", np.maximum(energy(record) / first - 1, 0.0), 1e-3)
    gate("beyond the wall [m]", np.maximum(record["position"][:, :, 1, 0], 0.0), 0.0)


@functools.cache
def jointed_pairs(settings):
    """48 pairs of a box and a capsule of 0.1 m on a ball joint that hit a wall at 5 to 60 m/s and turn by radians a step.

    Energies over the first one and openings of the joint [m], (step, world).
    """
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"friction": 0.3, "restitution": 0.5}
    builder.add_body(Box((0.005, 3, 3)), static=True, **surface)
    box = builder.add_body(Box((0.1, 0.02, 0.05)), mass=1.0, position=(-0.6, 0, 0), **surface)
    rod = builder.add_body(Capsule(0.02, 0.1), mass=0.5, position=(-0.6, 0.14, 0), **surface)
    builder.add_joint(BallAndSocket(box, rod, (-0.6, 0.02, 0)))
    model, state = builder.build(undamped(dt=DT, **dict(settings)))
    rng, count = np.random.default_rng(0), 48
    speed = np.stack([rng.uniform(5, 60, count), *rng.uniform(-5, 5, (2, count))], axis=-1)
    states = repeat(state, count)
    states = dataclasses.replace(states, velocity=states.velocity.at[:, 1:].set(speed[:, None]))
    _, record = record_worlds(repeat(model, count), states, 60, motion)
    position, orientation, velocity, spin = (np.asarray(record[name])[..., 1:, :] for name in MOTION)
    properties = {"mass": model.mass[1:], "inertia": model.inertia[1:]}
    energy = invariants(properties, position, orientation, velocity, spin)[0]
    arms = np.array([[0, 0.02, 0], [0, -0.12, 0]])
    anchors = position + np.einsum("swbij,bj->swbi", rotation_matrix(orientation), arms)
    return energy / (0.75 * np.sum(speed**2, -1)), np.linalg.norm(anchors[:, :, 0] - anchors[:, :, 1], axis=-1)


PAIRS = {"default": (), "continuous": (("continuous", True),), "soft_step": (("solver", "soft_step"),)}


@pytest.mark.slow
@pytest.mark.parametrize("settings", PAIRS)
def test_a_jointed_pair_that_hits_a_wall_gains_no_energy(float64, gate, settings):
    energy, _ = jointed_pairs(PAIRS[settings])
    gate("energy / that at first - 1", np.maximum(energy - 1, 0.0), 0.001)


@pytest.mark.slow
@pytest.mark.parametrize("settings", PAIRS)
def test_a_jointed_pair_that_hits_a_wall_closes_again(float64, gate, settings):
    _, opening = jointed_pairs(PAIRS[settings])
    gate("opening 0.7 s after the impact [m]", opening[-18:], 0.005)


def test_an_elastic_ball_keeps_its_energy(precision, gate):
    """What it has not fallen when it stops short of the ground it has not gained: it rose from 1 m to 1.6 in 20 s."""
    model, state = body_on_plane(
        Sphere(0.05),
        friction=0.0,
        restitution=1.0,
        position=(0, 1.05, 0),
        options=undamped(dt=DT, continuous=True),
    )
    found = jax.jit(lambda state: jax.vmap(lambda s: energy(model, s))(rollout(model, state, 1200)[1]))(state)
    start = float(energy(model, state))
    gate("energy / that of the start - 1", np.asarray(found) / start - 1.0, 1e-5 if precision == np.float32 else 1e-12)
