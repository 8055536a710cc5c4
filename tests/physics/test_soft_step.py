"""The small-steps tier: stacks, friction, restitution, overlap, joints, other features, momentum, derivatives."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Fixed, Flag, Hinge, Options, Plane, SceneBuilder, Sphere, is_asleep, joint_forces, rollout
from tests.benchmarks.hard_scenes import chain, joint_gaps, overlapping_pyramid
from tests.gradients.test_bounce_gradient import UNDER_GRAVITY, check
from tests.gradients.test_bounce_gradient import run as bounce
from tests.gradients.test_slide_gradient import end_of_slide
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.physics.test_joint_drives import MASS, REST, STEPS, WEIGHT, of, oscillator
from tests.scenes import (
    DOWN,
    GRAVITY,
    advance,
    advance_worlds,
    axis_angle,
    body_on_plane,
    box_stack,
    invariants,
    motion,
    per_body,
    record_worlds,
    repeat,
    slab_on_plane,
    sphere_on_plane,
    tilted_gravity,
    undamped,
)

DT = 1 / 60


def soft(**changes):
    return Options(**{"dt": DT, "solver": "soft_step", **changes})


def soft_undamped(**changes):
    return undamped(**{"dt": DT, "solver": "soft_step", **changes})


def recorded(model, state, steps, observe=motion):
    """The record of one world, in NumPy."""
    final, record = record_worlds(repeat(model, 1), repeat(state, 1), steps, observe)
    return jax.tree.map(lambda leaf: leaf[0], final), {
        name: np.asarray(values, dtype=float)[:, 0] for name, values in record.items()
    }


# Stacks (benchmark B3) -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "count", [10, pytest.param(20, marks=pytest.mark.slow), pytest.param(40, marks=pytest.mark.slow)]
)
def test_stack_stands(count, gate):
    """Cubes of 1 m. The last gates: it comes to rest, and there the load of a contact sinks it as the stiffness says."""
    half, dt = 0.5, DT
    model, state = box_stack(count, half=half, options=soft(dt=dt), friction=0.6)
    final, record = recorded(model, state, 600)
    moved = record["position"][:, 1:] - np.asarray(state.position, dtype=float)[1:]
    gate("horizontal drift in 10 s [m]", np.linalg.norm(moved[..., [0, 2]], axis=-1), 0.01)
    gate("height lost / height", moved[:, -1, 1] / (2 * half * count), 0.005)
    gate("speed at the end [m/s]", final.velocity[1:], 1e-3)
    height = np.concatenate([[-half], record["position"][-1, 1:, 1]])
    overlap = 2 * half - np.diff(height)
    load = GRAVITY * np.arange(count, 0, -1)
    inverse_mass = np.where(np.arange(count) == 0, 1.0, 2.0)
    # F sum(1/m) / (2 omega^2): half the impulse acts before the drift.
    sink = load * inverse_mass / (2 * (2 * np.pi / 4 * 4 / dt) ** 2)
    gate("overlap at rest / load over stiffness - 1", overlap / sink - 1, 0.05)
    assert int(final.flags) == 0


@pytest.mark.slow
def test_ten_small_boxes_at_the_cost_target(precision, gate):
    """The setting for which the speed of the tier is quoted: 1/240 s in two substeps."""
    model, state = box_stack(10, options=soft(dt=1 / 240, substeps=2))
    _, record = recorded(model, state, 720)
    height = np.concatenate([np.full((720, 1), -0.1), record["position"][:, 1:, 1]], axis=1)
    gate("overlap at rest [m]", np.maximum(0.2 - np.diff(height, axis=1), 0)[240:], 3e-4)
    gate("speed at the end [m/s]", record["velocity"][-1, 1:], 1e-4)


# Friction (benchmarks A9 and A10) ------------------------------------------------------------------------------------

FRICTIONS, HEADINGS = (0.2, 0.4, 0.7), (0.0, 11.25, 22.5, 33.75, 45.0)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_sliding_box_stops_where_coulomb_says(precision, gate):
    grid = list(itertools.product(FRICTIONS, (0.0, 45.0), HEADINGS))
    friction, yaw, heading = (np.array(column) for column in zip(*grid, strict=True))
    model, state = slab_on_plane(options=soft_undamped())
    models = repeat(model, len(grid))
    models = dataclasses.replace(models, friction=per_body(friction, models.friction))
    turned = np.stack([axis_angle((0, 1, 0), angle) for angle in np.radians(yaw)])
    states = repeat(state, len(grid))
    states = dataclasses.replace(states, orientation=states.orientation.at[:, 1].set(jnp.asarray(turned)))
    settled = advance_worlds(models, states, 30)
    direction = np.radians(heading)
    push = 2.0 * np.stack([np.cos(direction), np.zeros_like(direction), np.sin(direction)], axis=-1)
    pushed = dataclasses.replace(settled, velocity=settled.velocity.at[:, 1].set(jnp.asarray(push)))
    stopped = advance_worlds(models, pushed, 72)
    rested = advance_worlds(models, stopped, 300)
    path = np.asarray(stopped.position[:, 1] - settled.position[:, 1], dtype=float)
    distance = np.hypot(path[:, 0], path[:, 2])
    gate("distance / truth - 1", distance / (2.0**2 / (2 * friction * GRAVITY)) - 1, 0.01)
    gate("heading error [deg]", np.degrees(np.arctan2(path[:, 2], path[:, 0]) - direction), 0.1)
    ratio = distance.reshape(-1, len(HEADINGS))
    gate("isotropy max / min - 1", ratio.max(axis=-1) / ratio.min(axis=-1) - 1, 0.01)
    gate("creep over 5 s [m]", rested.position[:, 1] - stopped.position[:, 1], 1e-4)


def on_slopes(friction, angle):
    model, state = slab_on_plane(options=soft_undamped())
    models = repeat(model, len(angle))
    gravity = jnp.asarray(tilted_gravity(angle), dtype=models.gravity.dtype)
    models = dataclasses.replace(models, friction=per_body(friction, models.friction), gravity=gravity)
    final = advance_worlds(models, repeat(state, len(angle)), 180)
    return np.asarray(final.position[:, 1] - state.position[1], dtype=float)


SLOPES = [
    (friction, angle)
    for friction, angle in itertools.product((0.1, 0.3, 0.5, 0.7, 1.0), (3.0, 10.0, 20.0, 30.0, 40.0))
    if abs(angle - np.degrees(np.arctan(friction))) >= 2
]


@pytest.mark.slow
def test_slab_slides_down_as_coulomb_says(precision, gate):
    friction, angle = (np.array(column) for column in zip(*SLOPES, strict=True))
    path, slope = on_slopes(friction, angle), np.radians(angle)
    slides = np.tan(slope) > friction
    truth = (0.5 * GRAVITY * (np.sin(slope) - friction * np.cos(slope)) * 3.0**2)[slides]
    gate("sliding distance / truth - 1", path[slides, 0] / truth - 1, 0.01)
    gate("sideways / distance", path[slides, 2] / truth, 2e-3)
    gate("movement of those that stick in 3 s [m]", path[~slides], 1e-3)


@pytest.mark.slow
def test_slab_that_sticks_does_not_creep(precision, gate):
    friction, angle = (np.array(column) for column in zip(*SLOPES, strict=True))
    path = on_slopes(friction, angle)
    gate("creep in 3 s [m]", path[np.tan(np.radians(angle)) < friction][:, ::2], 1e-4)


# Restitution (benchmark A12a) ----------------------------------------------------------------------------------------

RESTITUTIONS = (0.0, 0.25, 0.5, 0.75, 0.8, 0.9, 1.0)
FALL_TIME = np.sqrt(2 / GRAVITY)


def drop(dt=1 / 240):
    """Heights [m] (step, world) of the dropped spheres, their speeds, and the apex of the flight through each sample."""
    model, state = sphere_on_plane(height=1.0, restitution=0.5, options=soft_undamped(dt=dt))
    models = repeat(model, len(RESTITUTIONS))
    models = dataclasses.replace(models, restitution=per_body(RESTITUTIONS, models.restitution))
    _, record = record_worlds(models, repeat(state, len(RESTITUTIONS)), 1200, motion)
    height = np.asarray(record["position"], dtype=float)[:, :, 1, 1] - 0.1
    speed = np.asarray(record["velocity"], dtype=float)[:, :, 1, 1]
    return height, speed, height + speed**2 / (2 * GRAVITY)


def check_apexes(gate, apex, bounces, dt=1 / 240):
    for world, e in enumerate(RESTITUTIONS):
        for nth in bounces:
            rise = FALL_TIME * e**nth
            if 2 * rise < 3 * dt:
                break  # too short a flight to contain a sample for certain
            middle = FALL_TIME * (1 + 2 * sum(e**earlier for earlier in range(1, nth))) + rise
            gate(f"e={e}: apex {nth} / truth - 1", apex[round(middle / dt) - 1, world] / e ** (2 * nth) - 1, 0.01)


def test_dropped_sphere(precision, gate):
    height, speed, apex = drop()
    check_apexes(gate, apex, (1, 2, 3))
    for world, e in enumerate(RESTITUTIONS):
        gate(f"e={e}: energy gained / energy", max(0.0, apex[:, world].max() - 1), 5e-4)
        gate(f"e={e}: overlap with the plane [m]", min(0.0, height[:, world].min()), 1e-3)
        if e < 0.85:
            gate(f"e={e}: speed at rest [m/s]", speed[-60:, world], 1e-3)
    gate("e=1: energy lost in 5 s", max(0.0, 1 - apex[-1, -1]), 1e-3)


# Overlap (benchmark B10) ---------------------------------------------------------------------------------------------

PUSH_OUT = 3.0
"""Largest push-out velocity [m/s] for a cube of 1 m."""


@pytest.mark.slow
def test_overlapping_pyramid_comes_apart_gently(gate):
    model, state = overlapping_pyramid(soft())
    final, record = recorded(model, state, 300)
    speed = np.linalg.norm(record["velocity"][:, 1:], axis=-1)
    gate("largest speed [m/s]", speed, 1.5 * PUSH_OUT + np.sqrt(2 * GRAVITY * 3.25))
    gate("speed at the end [m/s]", speed[-1], 0.05)
    assert not int(final.flags) & ~Flag.DEEP_OVERLAP  # the cubes overlap by the share at which it begins


@pytest.mark.slow
@pytest.mark.parametrize("spread", [1e-4, 0.0])
def test_boxes_on_one_point_separate(spread, gate):
    """Through the broadphase, whose contacts find their places anew in each step."""
    rng = np.random.default_rng(0)
    builder = SceneBuilder(gravity=(0, 0, 0))
    for _ in range(20):
        builder.add_body(Box((0.5, 0.5, 0.5)), mass=1.0, position=spread * rng.uniform(-1, 1, 3))
    model, state = builder.build(soft(broadphase="all_pairs"))
    final, record = recorded(model, state, 300)
    gate("largest speed [m/s]", np.linalg.norm(record["velocity"], axis=-1), 1.5 * PUSH_OUT)
    position = np.asarray(final.position, dtype=float)
    apart = np.linalg.norm(position[:, None] - position[None], axis=-1) + 10 * np.eye(20)
    assert np.isfinite(position).all()
    assert apart.min() > 0.9, f"two boxes are still {apart.min():.3g} m apart"


# Chains (benchmark B7) -----------------------------------------------------------------------------------------------


def damped():
    return soft(linear_damping=0.1, angular_damping=0.1)


@pytest.mark.parametrize("links", [pytest.param(6, marks=pytest.mark.slow), pytest.param(10, marks=pytest.mark.slow)])
def test_chain_holds(links, gate):
    model, state = chain(links, damped())
    _, record = recorded(model, state, 300 if links == 6 else 600)
    gate("joint gap / link", joint_gaps(record["position"], record["orientation"], links), 0.01)


@pytest.mark.slow
def test_ball_and_chain_holds(gate):
    model, state = chain(40, damped(), end_mass=4021.0)
    _, record = recorded(model, state, 600)
    gate("joint gap / link", joint_gaps(record["position"], record["orientation"], 40), 0.01)


# Name: for each box its parent, 0 for the wall, and its place.
WELDED = {
    "shelf": [(0, (0, 1.7, 0)), (1, (-0.3, 1.7, 0)), (1, (0.3, 1.7, 0))],
    "fan": [(0, (0, 1.7, 0)), (1, (-0.3, 1.7, 0)), (1, (0.3, 1.7, 0)), (1, (0, 1.7, 0.3))],
    "tree": [
        *((parent, (0.3 * (parent + 1), 2, 0)) for parent in (0, 1)),
        *((2, (0.6, 2, z)) for z in (0.3, -0.3)),
        (2, (0.9, 2, 0)),
        *((5, (0.9, 2, z)) for z in (0.3, -0.3)),
    ],
}


@pytest.mark.parametrize("masses", [(5.0,), (1.0, 30.0)])
@pytest.mark.parametrize("name", ["fan", *(pytest.param(name, marks=pytest.mark.slow) for name in ("shelf", "tree"))])
def test_welded_boxes_stay_on_their_wall(name, masses, gate):
    """Over-relaxed welds threw the shelf apart within a second; the fan and the tree swayed more and more."""
    builder = SceneBuilder(gravity=DOWN)
    places = [(0, 2, 0), *(place for _, place in WELDED[name])]
    bodies = [builder.add_body(Box((0.1, 0.1, 0.1)), static=True, position=places[0])]
    for number, (parent, place) in enumerate(WELDED[name]):
        bodies.append(builder.add_body(Box((0.1, 0.1, 0.1)), mass=masses[number % len(masses)], position=place))
        middle = (np.asarray(place) + places[parent]) / 2
        builder.add_joint(Fixed(bodies[parent], bodies[-1], anchor=middle))
    model, state = builder.build(soft())
    final, record = recorded(model, state, 240)
    gate("moved [m]", record["position"][:, 1:] - np.asarray(state.position)[1:], 1e-4)
    gate("speed at the end [m/s]", final.velocity, 1e-4)
    gate("turning at the end [rad/s]", final.angular_velocity, 1e-3)
    weight = GRAVITY * float(np.sum(np.asarray(model.mass)[1:]))
    gate("force of the wall / weight - 1", np.asarray(joint_forces(model, final)[0])[0, 1] / weight - 1, 1e-3)


# Laws of joints, against the closed forms of `test_joint_drives` -----------------------------------------------------


@pytest.mark.slow
def test_springs_follow_the_oscillator(float64, gate):
    """Each substep is exact for a coordinate alone, whatever the step; with a rotor or a damper of second order."""
    for name, stiffness, damping, inertia, limit in (
        ("spring", 50.0, 0.0, MASS, 1e-9),
        ("geared", 50.0, 0.0, MASS + 6.0, 1e-5),
        ("damped", 50.0, 3.0, MASS, 2e-3),
        ("critical", 200.0, 40.0, MASS, 2e-3),
    ):
        for world in (0, 1):
            time, found = of(float64, name, world, "soft_step")
            truth = oscillator(time, stiffness, damping, inertia)
            gate(f"{name}: place - truth, relative to the amplitude", (found["place"] - truth) / REST, limit)


@pytest.mark.slow
def test_springs_and_servos_of_any_stiffness_come_to_rest(float64, gate):
    for name, target in (("rigid", REST), ("rigid and damped", REST), ("rigid servo", 0.2)):
        _, found = of(float64, name, solver="soft_step")
        gate(f"{name}: after sixty steps / target - 1", found["place"][60:] / target - 1, 1e-4)
    gate("load / stiffness - 1", of(float64, "loaded", 0, "soft_step")[1]["place"][-1] * -400.0 / WEIGHT - 1, 1e-4)


@pytest.mark.slow
def test_friction_and_motors_give_no_more_than_their_caps(float64, gate):
    time, brake = of(float64, "brake", solver="soft_step")
    truth = np.maximum(1.5 - 4.0 / MASS * time, 0.0)
    assert 10 < np.argmax(truth == 0) < STEPS
    gate("brake: rate", brake["rate"] - truth, 1e-9)
    gate("friction: creep while sticking [m]", of(float64, "sticks", 0, "soft_step")[1]["place"], 1e-6)
    for name, cap in (("slips", 5.0), ("stalls", 10.0), ("weak servo", 10.0)):
        _, found = of(float64, name, 0, "soft_step")
        gate(f"{name}: rate / truth - 1", found["rate"] / (-(WEIGHT - cap) / MASS * time) - 1, 1e-4)
    _, lifts = of(float64, "lifts", 0, "soft_step")
    gate("velocity motor: rate - target", lifts["rate"][60:] - 0.5, 1e-5)
    gate("velocity motor: force / weight - 1", lifts["force"][60:, 1] / WEIGHT - 1, 1e-3)


# Other features ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_sleep_fast_bodies_and_a_step_of_no_time():
    """A box on a shelf that sleeps, a sphere at 180 m/s, 15 thicknesses a step, that must not pass a wall, and dt = 0."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True)
    builder.add_body(Box((0.1, 5.0, 5.0)), static=True, position=(5.0, 5.0, 20.0))
    builder.add_body(Box((0.5, 0.1, 0.5)), static=True, position=(0, 0.1, 0))
    box = builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, position=(0, 0.3, 0))
    ball = builder.add_body(Sphere(0.1), mass=1.0, position=(-7.0, 5.0, 20.0), velocity=(180.0, 0, 0))
    model, state = builder.build(soft(sleep=True, continuous=True))
    later = advance(model, state, 60)
    np.testing.assert_allclose(later.position[ball, 0], 4.8, atol=1e-2)
    assert np.asarray(is_asleep(model, later))[box]
    last = advance(model, later, 60)
    np.testing.assert_array_equal(last.position[box], later.position[box])
    still = advance(dataclasses.replace(model, dt=jnp.zeros_like(model.dt)), state, 3)
    for name in ("position", "velocity", "orientation"):
        np.testing.assert_array_equal(getattr(still, name), getattr(state, name))


# Momentum and free motion --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_free_collision_conserves_momentum(precision, gate):
    builder = SceneBuilder(gravity=(0, 0, 0))
    builder.add_body(Box((0.2, 0.1, 0.15)), mass=1.0, velocity=(1.0, 0.1, 0), angular_velocity=(1.0, 2.0, -1.0))
    builder.add_body(Box((0.25, 0.1, 0.1)), mass=3.0, position=(0.7, 0.05, 0.02), velocity=(-1.0, 0, 0.05))
    model, state = builder.build(soft_undamped(dt=1 / 240))
    final = advance(model, state, 120)
    leaves = {"mass": model.mass, "inertia": model.inertia}
    before, after = (
        invariants(leaves, s.position, s.orientation, s.velocity, s.angular_velocity) for s in (state, final)
    )
    assert after[0] < 0.9 * before[0], "they do not collide"
    eps = float(np.finfo(precision).eps)
    gate("linear momentum [kg m/s]", after[1] - before[1], 50 * eps)
    gate("angular momentum [kg m^2/s]", after[2] - before[2], 0.005)


@pytest.mark.slow
def test_flight_is_exact(precision, gate):
    """A box in flight above the plane: the parabola, and an angular momentum that stays."""
    model, state = body_on_plane(
        Box((0.1, 0.2, 0.3)), position=(0, 50.0, 0), velocity=(1.0, 2.0, 3.0), angular_velocity=(3.0, 0.1, 0.2),
        options=soft_undamped(),
    )  # fmt: skip
    final = advance(model, state, 60)
    limit = {"float32": 5e-5, "float64": 1e-11}[str(precision)]
    gate("position [m]", final.position[1] - np.array([1.0, 52.0 - GRAVITY / 2, 3.0]), limit)
    leaves = {"mass": model.mass[1:], "inertia": model.inertia[1:]}
    spin = [
        invariants(leaves, 0 * s.position[1:], s.orientation[1:], s.velocity[1:], s.angular_velocity[1:])[2]
        for s in (state, final)
    ]
    gate("angular momentum", spin[1] - spin[0], limit)


# Derivatives ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_derivatives_of_a_slide_to_rest(precision, gate):
    model, state = slab_on_plane(options=soft_undamped())
    values = {"speed": 2.0, "friction": 0.4, "mass": 1.0, "gravity": GRAVITY}
    values = {name: jnp.asarray(value) for name, value in values.items()}

    def place(values):
        return end_of_slide(values, model, state, 45)[0]

    reverse = jax.jit(jax.grad(place))(values)
    distance = 2.0**2 / (2 * 0.4 * GRAVITY)
    truth = {"speed": 2.0 / (0.4 * GRAVITY), "friction": -distance / 0.4, "gravity": -distance / GRAVITY}
    for name, value in truth.items():
        gate(f"d x / d {name} / truth - 1", float(reverse[name]) / value - 1, 0.01)
    if precision == "float64":
        forward = jax.jit(jax.jacfwd(place))(values)
        for name in truth:
            gate(f"forward against reverse, {name}", float(forward[name] / reverse[name]) - 1, 1e-9)


def test_derivatives_of_a_bounce(gate):
    value, slopes = bounce(
        height=1.0, velocity=0.0, restitution=0.8, gravity=GRAVITY, time=0.8, dt=1 / 240, solver="soft_step"
    )
    gate("height / truth - 1", value / 0.671884928 - 1, 1e-3)
    check(gate, slopes, UNDER_GRAVITY, 0.01)


@pytest.mark.slow
def test_gradient_through_the_broadphase(float64, gate):
    """Reverse mode through turns that are known only in the step, against forward mode and a difference quotient."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True)
    for index in range(3):
        builder.add_body(
            Sphere(0.1), mass=1.0, position=(0.19 * index, 0.099, 0.01 * index), velocity=(0.3 - index, 0, 0)
        )
    model, state = builder.build(soft_undamped(broadphase="all_pairs"))

    def loss(velocity):
        final = rollout(model, dataclasses.replace(state, velocity=velocity), 3)[0]
        return jnp.sum(final.position * jnp.arange(final.position.size).reshape(final.position.shape))

    gradient = jax.jit(jax.grad(loss))(state.velocity)
    direction = jnp.asarray(np.random.default_rng(0).normal(size=state.velocity.shape)).at[0].set(0)
    _, forward = jax.jit(lambda d: jax.jvp(loss, (state.velocity,), (d,)))(direction)
    value = jax.jit(loss)
    quotient = (value(state.velocity + 1e-6 * direction) - value(state.velocity - 1e-6 * direction)) / 2e-6
    along = jnp.sum(gradient * direction)
    gate("reverse / forward - 1", along / forward - 1, 1e-9)
    gate("reverse / difference quotient - 1", along / quotient - 1, 1e-4)


def test_a_stop_has_no_restitution(gate):
    """An arm that turns at 4 rad/s about its end runs into a stop, which takes all of its speed."""
    builder = SceneBuilder(gravity=(0.0, 0.0, 0.0))
    base = builder.add_body(Box((0.1, 0.1, 0.1)), static=True)
    arm = builder.add_body(
        Box((0.5, 0.05, 0.05)), mass=1.0, position=(0.5, 0, 0), velocity=(0, 2, 0), angular_velocity=(0, 0, 4)
    )
    builder.add_joint(Hinge(base, arm, (0, 0, 0), (0, 0, 1), limits=(-1.0, 1.0)))
    model, state = builder.build(soft_undamped(dt=1 / 240))
    _, trajectory = jax.jit(lambda m, s: rollout(m, s, 120))(model, state)
    gate("rebound / speed of impact", np.maximum(-np.asarray(trajectory.angular_velocity[:, 1, 2]), 0.0) / 4.0, 0.01)
