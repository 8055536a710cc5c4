"""Steps that split at impacts (`Options.impact_events`): exact for every time step, whatever else is in the scene."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Plane, SceneBuilder, Sphere, step
from tests.marks import QUICK_IN_FLOAT64
from tests.scenes import (
    DOWN,
    GRAVITY,
    advance,
    advance_worlds,
    axis_angle,
    body_on_plane,
    motion,
    record_worlds,
    repeat,
    rotation_matrix,
    sphere_on_plane,
    undamped,
    with_dt,
)

DROP, BOUNCE = 0.5, 0.8


def bouncing(box):
    """Bodies: plane, ball dropped by `DROP`, ball that never touches anything, box at rest on the plane.

    `box` is where: None for no box, "beside" the ball, or "below" it, then on a plane from which nothing rebounds.
    """
    builder = SceneBuilder(gravity=DOWN)
    below = box == "below"
    builder.add_body(
        Plane(normal=(0, 1, 0), offset=0.0), static=True, restitution=0.0 if below else BOUNCE, friction=0.0
    )
    surface = {"mass": 1.0, "restitution": BOUNCE, "friction": 0.0}
    builder.add_body(Sphere(0.1), position=(0.0, (0.2 if below else 0.0) + 0.1 + DROP, 0.0), **surface)
    builder.add_body(Sphere(0.1), position=(5.0, 50.0, 0.0), **surface)
    if box:
        builder.add_body(Box((0.1, 0.1, 0.1)), position=(0.0 if below else 1.0, 0.1, 0.0), **surface)
    return builder.build(undamped(impact_events=3))


def height(time):
    """Gap [m] under a ball that was dropped by `DROP`."""
    fall = np.sqrt(2 * DROP / GRAVITY)
    if time <= fall:
        return DROP - GRAVITY * time**2 / 2
    time, speed = time - fall, BOUNCE * GRAVITY * fall
    while time > 2 * speed / GRAVITY:
        time, speed = time - 2 * speed / GRAVITY, BOUNCE * speed
    return speed * time - GRAVITY * time**2 / 2


@pytest.mark.parametrize("box", [None, *(pytest.param(box, marks=pytest.mark.slow) for box in ("beside", "below"))])
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_bounces_at_any_time_step(precision, box, gate):
    """Up to three bounces within a step; the box stays at rest and the other ball in free fall."""
    model, state = bouncing(box)
    round_off = {"float32": 4e-6, "float64": 1e-12}[str(precision)]
    # The bounces are at 0.32, 0.83, 1.24 and 1.57 s: the second step of 0.8 s and that of 1.3 s hold three.
    for dt, count in [(1 / 240, 300), (1 / 60, 60), (0.1, 15), (0.5, 2), (0.8, 2), (1.3, 1)]:
        final = advance(with_dt(model, dt), state, count)
        position, time = np.asarray(final.position, dtype=float), dt * count
        gap = position[1, 1] - 0.1 - (position[3, 1] + 0.1 if box == "below" else 0.0)
        # The box sinks by less than the slop, and the ball on it falls by as much further.
        limit = 5e-5 if box == "below" else round_off
        gate(f"gap after {count} steps of {dt:.4f} s [m]", gap - height(time), limit)
        gate("free fall, relative", (50.0 - position[2, 1]) / (GRAVITY * time**2 / 2) - 1, 2e-5)
        if box:
            gate("box [m]", position[3] - np.asarray(state.position, dtype=float)[3], 1e-4)
            gate("box [m/s]", final.velocity[3], 1e-3)
        assert final.flags == 0


@pytest.mark.parametrize("dt", [0.3, 0.7, 1.0, 2.0])
def test_more_bounces_than_events_lose_nothing(precision, dt, gate):
    """Up to nine bounces in a step of three events: the ordinary step takes the rest, and nothing passes the plane."""
    model, state = bouncing(None)
    gaps = []
    for _ in range(10):
        state = advance(with_dt(model, dt), state, 1)
        gaps.append(float(state.position[1, 1]) - 0.1)
    gate("below the plane [m]", min(*gaps, 0.0), 1e-3)
    gate("above the start [m]", max(max(gaps) - DROP, 0.0), 0.0)


def test_oblique_collision_at_any_time_step(float64, gate):
    """Benchmark A13a to the digits given: the normal is that of the time of impact."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"restitution": 0.9, "friction": 0.0}
    builder.add_body(Sphere(0.2), mass=1.0, velocity=(2.0, 0.0, 0.0), **surface)
    builder.add_body(Sphere(0.2), mass=2.0, position=(1.0, 0.2, 0.0), **surface)
    model, state = builder.build(undamped(impact_events=1))
    truth = np.array([[0.720910347, -0.738482756, 0.0], [1.639544827, 0.569241378, 0.0]])
    for count in (1, 3, 60, 240):
        final = advance(with_dt(model, 1 / count), state, count)
        gate(f"positions after 1 s in {count} steps [m]", final.position - truth, 2e-9)


HALF, TURN = np.array([0.2, 0.1, 0.15]), axis_angle((1.0, 2.0, -0.5), 0.8)


def spinning_box(gap, restitution):
    """A box that flies and spins, its lowest corner `gap` above the plane; no gravity, no friction."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF
    placed = corners @ rotation_matrix(TURN).T
    arm = placed[placed[:, 1].argmin()]
    model, state = body_on_plane(
        Box(tuple(HALF)),
        gravity=(0, 0, 0),
        friction=0.0,
        restitution=restitution,
        mass=2.0,
        position=(0.3, gap - arm[1], 0.1),
        orientation=tuple(TURN),
        velocity=(0.4, -1.5, -0.2),
        angular_velocity=(1.0, -2.0, 0.7),
        options=undamped(dt=1 / 100, impact_events=3),
    )
    return model, state, arm


def angular_momentum(model, state):
    """Of body 1 about its centre of mass, world frame."""
    rotation = rotation_matrix(state.orientation[1])
    return rotation @ (np.asarray(model.inertia[1]) * (rotation.T @ np.asarray(state.angular_velocity[1])))


def test_corner_of_a_spinning_box(float64, gate):
    """The impulse of a frictionless impact in one point: (1 + e) u / (1/m + n.(I^-1 (r x n) x r))."""
    model, state, arm = spinning_box(gap=0.0, restitution=0.7)
    final = advance(with_dt(model, 1 / 400), state, 1)  # 4 ms later the next corner lands
    mass, normal = 2.0, np.array([0.0, 1.0, 0.0])
    rotation = rotation_matrix(TURN)
    inverse = rotation @ np.diag(1 / np.asarray(model.inertia[1])) @ rotation.T
    before = np.array([0.4, -1.5, -0.2]) + np.cross([1.0, -2.0, 0.7], arm)
    around = np.cross(arm, normal)
    impulse = -(1 + 0.7) * before[1] / (1 / mass + around @ inverse @ around)
    gate("velocity [m/s]", final.velocity[1] - (np.array([0.4, -1.5, -0.2]) + impulse / mass * normal), 1e-9)
    change = angular_momentum(model, final) - angular_momentum(model, state)
    gate("change of the angular momentum", change - impulse * around, 1e-9)

    model, state, _ = spinning_box(gap=0.011, restitution=1.0)
    # The impact keeps the energy; the turns before and after it, of fourth order, change it a little.
    for count, limit in ((5, 4e-9), (50, 1e-12)):
        final = advance(with_dt(model, 0.05 / count), state, count)
        assert final.velocity[1, 1] > -1.0, "no impact: the test says nothing"
        kinetic = [
            np.asarray(s.velocity[1]) @ np.asarray(s.velocity[1]) * mass
            + np.asarray(s.angular_velocity[1]) @ angular_momentum(model, s)
            for s in (state, final)
        ]
        gate(f"energy / start - 1, {count} steps", kinetic[1] / kinetic[0] - 1, limit)
        gate("horizontal velocity [m/s]", (final.velocity - state.velocity)[1, ::2], 1e-12)
        gate("vertical angular momentum", angular_momentum(model, final)[1] - angular_momentum(model, state)[1], 1e-12)


@pytest.mark.slow
def test_a_ball_that_leaves_out_of_an_overlap(float64, gate):
    """Thrown up from inside of the plane it returns to the surface, or, where it never gets there, to where it was.

    Positions are not corrected, so that the closed form is that of a thrown ball; with derivatives by overlap, speed, step.
    """
    model, state = sphere_on_plane(
        restitution=1.0, friction=0.0, options=undamped(impact_events=8, position_iterations=0)
    )

    def stepped(overlap, speed, dt):
        position, velocity = state.position.at[1, 1].add(-overlap), state.velocity.at[1, 1].set(speed)
        start = dataclasses.replace(state, position=position, velocity=velocity)
        final = step(dataclasses.replace(model, dt=dt), start)
        return jnp.stack([final.position[1, 1] - 0.1, final.velocity[1, 1]])

    def known(overlap, speed, dt):
        left = speed**2 - 2 * GRAVITY * overlap  # squared speed at the surface
        floor, rebound = jnp.where(left > 0, 0.0, -overlap), jnp.sqrt(jnp.where(left > 0, left, speed**2))
        since = dt - (speed + rebound) / GRAVITY
        since = since - 2 * rebound / GRAVITY * jnp.floor(since * GRAVITY / (2 * rebound))
        return jnp.stack([floor + rebound * since - GRAVITY * since**2 / 2, rebound - GRAVITY * since])

    throws = [(d, *throw) for throw in ((1.0, 0.25), (0.2, 0.1)) for d in (0.0, 1e-6, 1e-4, 1e-3, 5e-3, 0.01, 0.02)]
    arguments = tuple(jnp.asarray(throws).T)
    found, truth = (
        jax.jit(jax.vmap(lambda *x, f=f: (f(*x), jax.jacrev(f, argnums=(0, 1, 2))(*x))))(*arguments)
        for f in (stepped, known)
    )
    gate("height and velocity", found[0] - truth[0], 1e-12)
    for name, by, exactly in zip(("overlap", "speed", "time step"), found[1], truth[1], strict=True):
        gate(f"by the {name} / largest", (by - exactly) / np.abs(exactly).max(), 1e-7)


def test_without_restitution_the_option_changes_nothing(float64):
    model, state = body_on_plane(Sphere(0.1), position=(0.0, 0.3, 0.0), options=undamped(impact_events=3))
    plain, _ = body_on_plane(Sphere(0.1), position=(0.0, 0.3, 0.0), options=undamped())
    split, ordinary = advance(model, state, 30), advance(plain, state, 30)
    assert (split.position == ordinary.position).all()
    zero_gap = dataclasses.replace(state, position=jnp.asarray(state.position).at[1, 1].set(0.1))
    assert (advance(model, zero_gap, 3).position == advance(plain, zero_gap, 3).position).all()


@pytest.mark.parametrize(("dt", "restitution"), [(0.5, 0.5), (1 / 30, 0.8), (1 / 60, 0.8)])
def test_a_ball_dropped_by_little_gains_no_energy(float64, gate, dt, restitution):
    """Drops of micrometres to decimetres, with more bounces in a step than it is split at."""
    model, state = sphere_on_plane(restitution=restitution, options=undamped(impact_events=1))
    heights = np.geomspace(1e-6, 0.3, 40)
    states = repeat(state, len(heights))
    states = dataclasses.replace(states, position=states.position.at[:, 1, 1].set(0.1 + heights))
    _, record = record_worlds(with_dt(repeat(model, len(heights)), dt), states, 6, motion)
    energy = GRAVITY * (record["position"][:, :, 1, 1] - 0.1) + record["velocity"][:, :, 1, 1] ** 2 / 2
    energy = np.concatenate([GRAVITY * heights[None], energy])
    gate("gain of energy in a step, share of the first", np.maximum(np.diff(energy, axis=0), 0) / energy[0], 1e-3)


@pytest.mark.slow
def test_boxes_that_strike_twice_in_a_step(float64, gate):
    """Two spinning boxes in free fall: other corners than those that met first, of which no contact tells beforehand.

    At 1/120 s and at 1/960 s they move alike; one in ten ended a step inside each other, by up to a third of their size.
    """
    builder = SceneBuilder(gravity=(0, 0, 0))
    surface = {"friction": 0.0, "restitution": 1.0}
    builder.add_body(Box((0.2, 0.15, 0.1)), mass=1.0, position=(0, 0, 0), **surface)
    builder.add_body(Box((0.2, 0.2, 0.1)), mass=4.0, position=(0.7, 0.1, 0), **surface)
    model, state = builder.build(undamped(impact_events=3))
    worlds, random = 256, np.random.default_rng(3)
    states = repeat(state, worlds)
    position = np.asarray(states.position)
    apart = position - position.mean(1, keepdims=True)
    velocity = -apart * random.uniform(1, 6, (worlds, 1, 1)) + 0.3 * random.normal(size=position.shape)
    turn = random.normal(size=(worlds, 2, 4))
    states = dataclasses.replace(
        states,
        velocity=jnp.asarray(velocity),
        angular_velocity=jnp.asarray(3 * random.normal(size=position.shape)),
        orientation=jnp.asarray(turn / np.linalg.norm(turn, axis=-1, keepdims=True)),
    )
    models = repeat(model, worlds)
    coarse = advance_worlds(with_dt(models, 1 / 120), states, 30)
    fine = advance_worlds(with_dt(models, 1 / 960), states, 240)
    struck = np.abs(np.asarray(fine.velocity) - velocity).max((1, 2)) > 1e-3
    assert struck.sum() > 0.8 * worlds
    off = np.abs(np.asarray(coarse.velocity - fine.velocity)).max((1, 2))
    gate("share of worlds that differ by more than 1 mm/s", (off > 1e-3).mean(), 0.02)
    momentum = [np.einsum("b,wbk->wk", np.asarray(model.mass), np.asarray(x.velocity)) for x in (states, coarse)]
    gate("momentum lost [kg m/s]", momentum[1] - momentum[0], 1e-12)
