"""Closed loops of joints against reduced coordinates, statics and conservation laws."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from mathota_jax import BallAndSocket, Box, Hinge, Plane, SceneBuilder, Sphere, joint_forces, joint_gaps, rollout, step
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import DOWN, GRAVITY, advance_worlds, axis_angle, invariants, motion, record_worlds, repeat, undamped

ACROSS = (0, 0, 1)
SOLVERS = ["pgs", *(pytest.param(solver, marks=pytest.mark.slow) for solver in ("converged", "soft_step"))]

# Crank, coupler, rocker and ground; never flat, and the crank goes round.
CRANK, COUPLER, ROCKER, BASE = 0.4, 0.9, 0.7, 1.0
WIDTH = 0.02


def corners(angle):
    """The two moving corners of the linkage, (2,) each."""
    first = CRANK * np.array([np.cos(angle), np.sin(angle)])
    across = np.array([BASE, 0.0]) - first
    far = np.linalg.norm(across)
    along = (COUPLER**2 - ROCKER**2 + far**2) / (2 * far)
    height = np.sqrt(COUPLER**2 - along**2)
    return first, first + (along * across + height * np.array([-across[1], across[0]])) / far


def poses(angle):
    """Centres (bar, 2) and angles (bar,)."""
    first, second = corners(angle)
    ends = np.array([[(0.0, 0.0), first], [first, second], [(BASE, 0.0), second]])
    along = ends[:, 1] - ends[:, 0]
    return ends.mean(1), np.arctan2(along[:, 1], along[:, 0])


def slopes(angle, step=1e-3):
    """Derivatives of the poses by the angle of the crank, to fourth order."""

    def difference(step):
        ahead, behind = poses(angle + step), poses(angle - step)
        turn = (ahead[1] - behind[1] + np.pi) % (2 * np.pi) - np.pi
        return (ahead[0] - behind[0]) / (2 * step), turn / (2 * step)

    return [(4 * near - far) / 3 for near, far in zip(difference(step), difference(2 * step), strict=True)]


def linkage(angle, rate, crank=None, **options):
    """Bars of 1 kg, the crank on body 0 by a hinge with what `crank` adds, and with a motor if it adds anything."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Sphere(0.02), static=True, collides=False)
    centre, turn = poses(angle)
    for place, bar_angle, length in zip(centre, turn, (CRANK, COUPLER, ROCKER), strict=True):
        builder.add_body(
            Box((length / 2, WIDTH, WIDTH)), mass=1.0, position=(*place, 0.0),
            orientation=axis_angle(ACROSS, bar_angle), collides=False,
        )  # fmt: skip
    first, second = corners(angle)
    for parent, child, place in ((0, 1, (0, 0)), (1, 2, first), (2, 3, second), (3, 0, (BASE, 0))):
        hinge = builder.add_joint(Hinge(parent, child, (*place, 0.0), ACROSS, **(crank or {} if child == 1 else {})))
        if crank and child == 1:
            builder.add_motor(hinge, kind="velocity", limit=100.0)
    model, state = builder.build(undamped(**options))
    by_centre, by_turn = slopes(angle)
    return model, dataclasses.replace(
        state,
        velocity=state.velocity.at[1:, :2].set(rate * by_centre),
        angular_velocity=state.angular_velocity.at[1:, 2].set(rate * by_turn),
    )


def inertia(angle):
    """That the angle of the crank feels."""
    by_centre, by_turn = slopes(angle)
    moments = ((np.array([CRANK, COUPLER, ROCKER]) / 2) ** 2 + WIDTH**2) / 3
    return (by_centre**2).sum() + (moments * by_turn**2).sum()


def exact_linkage(angle, rate, duration):
    """Angle of the crank: Lagrange's equation of the one freedom."""

    def acceleration(_, state):
        angle, rate = state
        change = (inertia(angle + 1e-3) - inertia(angle - 1e-3)) / 2e-3
        weight = GRAVITY * slopes(angle)[0][:, 1].sum()
        return rate, -(0.5 * change * rate**2 + weight) / inertia(angle)

    return solve_ivp(acceleration, (0.0, duration), (angle, rate), method="DOP853", rtol=1e-10, atol=1e-10).y[0, -1]


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_four_bar_linkage(precision, solver, gate):
    """The crank goes round and swings; the hinges hold three rows too many."""
    angle, rate, dt = 2.0, 3.0, 1 / 240
    model, state = linkage(angle, rate, dt=dt, solver=solver)
    _, record = record_worlds(
        repeat(model, 1), repeat(state, 1), 240,
        lambda model, state: {**motion(model, state), "gap": joint_gaps(model, state).translation},
    )  # fmt: skip
    record = {name: np.asarray(values, float)[:, 0] for name, values in record.items()}
    crank = 2 * np.arctan2(record["orientation"][-1, 1, 3], record["orientation"][-1, 1, 0])
    error = (crank - exact_linkage(angle, rate, 1.0) + np.pi) % (2 * np.pi) - np.pi
    gate("angle of the crank after 1 s [rad]", error, 5e-3)
    gate("gap / crank", record["gap"] / CRANK, 1e-5)
    gate("out of plane [m]", record["position"][..., 2], 1e-5)
    leaves = {"mass": model.mass[1:], "inertia": model.inertia[1:]}
    parts = (record[name][:, 1:] for name in ("position", "orientation", "velocity", "angular_velocity"))
    energy = invariants(leaves, *parts)[0] + GRAVITY * record["position"][:, 1:, 1].sum(1)
    first = float(0.5 * inertia(angle) * rate**2 + GRAVITY * poses(angle)[0][:, 1].sum())
    gate("energy gained / that of the fall", max(0.0, energy.max() - first) / (GRAVITY * 3 * CRANK), 2e-3)
    gate("energy lost / that of the fall", max(0.0, first - energy.min()) / (GRAVITY * 3 * CRANK), 1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS[:2])
def test_a_driven_linkage_turns_as_told_and_stops_at_its_stop(solver, gate):
    """A motor drives the crank against gravity and dry friction, 0.3 rad to a stop."""
    angle, rate, stop, dt = 2.0, 1.0, 0.3, 1 / 240
    model, state = linkage(angle, rate, {"limits": (-1.0, stop), "friction": 1.0}, dt=dt, solver=solver)
    _, trajectory = rollout(model, state, jnp.full((120, 1), rate))
    turned = 2 * np.arctan2(trajectory.orientation[:, 1, 3], trajectory.orientation[:, 1, 0]) - angle
    told = np.minimum(rate * dt * np.arange(1, 121), stop)
    gate("angle of the crank [rad]", turned - told, 1e-4)
    gate("beyond the stop [rad]", np.maximum(turned - stop, 0.0), 1e-5)
    gap = jax.vmap(lambda state: joint_gaps(model, state).translation)(trajectory)
    gate("gap / crank", np.asarray(gap) / CRANK, 1e-5)
    assert not trajectory.flags.any()


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_a_frame_slides_over_a_plane(solver, gate):
    """Four hinged bars lie on a plane and slide until friction stops them: contacts beside a loop."""
    friction, speed, half = 0.4, 1.0, 0.05
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=friction)
    corners = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
    for place, (x, z) in enumerate(0.5 * (corners + np.roll(corners, -1, axis=0))):
        builder.add_body(
            Box((0.4, half, half)), mass=1.0, position=(x, half, z), friction=friction, velocity=(speed, 0, 0),
            orientation=axis_angle((0, 1, 0), place * np.pi / 2),
        )  # fmt: skip
    for place, (x, z) in enumerate(corners):
        builder.add_joint(Hinge((place - 1) % 4 + 1, place + 1, (x, half, z), (0, 1, 0)))
    model, state = builder.build(undamped(dt=1 / 240, solver=solver))
    final, trajectory = rollout(model, state, 96)
    moved = np.asarray(final.position[1:] - state.position[1:])
    gate("distance / v^2 / (2 mu g) - 1", moved[:, 0] / (speed**2 / (2 * friction * GRAVITY)) - 1, 1e-2)
    gate("sideways or down [m]", moved[:, 1:], 1e-3)
    gate("velocity at the end [m/s]", np.asarray(final.velocity), 1e-4)
    gap = jax.vmap(lambda state: joint_gaps(model, state).translation)(trajectory)
    gate("gap [m]", np.asarray(gap), 1e-4)
    assert not trajectory.flags.any()


def hanging(count, span, **options):
    """Links of 1 m and 1 kg at rest between two points of one height: a discrete catenary; also its horizontal tension.

    Half of what hangs below the middle of a link over the horizontal tension is its slope.
    """
    loads = GRAVITY * (np.arange(count) - 0.5 * (count - 1))
    tension = brentq(lambda tension: np.cos(np.arctan(loads / tension)).sum() - span, 1e-3, 1e6)
    angles = np.arctan(loads / tension)
    along = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ends = np.concatenate([np.zeros((1, 2)), np.cumsum(along, axis=0)])
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Sphere(0.02), static=True, collides=False)
    for link in range(count):
        builder.add_body(
            Box((0.5, 0.03, 0.03)), mass=1.0, position=(*ends[link : link + 2].mean(0), 0.0),
            orientation=axis_angle(ACROSS, angles[link]), collides=False,
        )  # fmt: skip
    for link in range(count):
        builder.add_joint(Hinge(link, link + 1, (*ends[link], 0.0), ACROSS))
    builder.add_joint(Hinge(count, 0, (*ends[-1], 0.0), ACROSS))
    return *builder.build(undamped(**options)), tension


@pytest.mark.slow
def test_catenary(precision, gate):
    """A chain that hangs at rest between two points stays, with the tension of statics."""
    count = 10
    model, state, tension = hanging(count, 8.0, dt=1 / 60)
    final = advance_worlds(repeat(model, 1), repeat(state, 1), 60)
    gate("moved / link", np.asarray(final.position[0] - state.position), 1e-4)
    force = joint_forces(model, step(model, state))[0]
    gate("horizontal tension / truth - 1", np.abs(np.asarray(force[:, 0], float)) / tension - 1, 2e-3)
    # On its last child, the ground, the chain pulls with half its weight.
    gate("weight on a support / truth - 1", -float(force[-1, 1]) / (0.5 * count * GRAVITY) - 1, 2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("joint", [Hinge, BallAndSocket])
def test_a_free_ring_keeps_its_momenta(precision, joint, gate):
    """Six bars in a ring, spinning and changing shape in space."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    radius, half = 1.0, 0.5 * np.sin(np.pi / 6) * 2
    angles = np.arange(6) * np.pi / 3
    middle = radius * np.cos(np.pi / 6)
    for angle in angles:
        place = middle * np.array([np.cos(angle + np.pi / 6), np.sin(angle + np.pi / 6), 0.0])
        builder.add_body(
            Box((half, 0.03, 0.03)), mass=1.0, position=place, orientation=axis_angle(ACROSS, angle + 2 * np.pi / 3),
            collides=False,
        )  # fmt: skip
    for place, angle in enumerate(angles):
        anchor = (radius * np.cos(angle), radius * np.sin(angle), 0.0)
        ends = ((place - 1) % 6, place)
        builder.add_joint(Hinge(*ends, anchor, ACROSS) if joint is Hinge else joint(*ends, anchor))
    model, state = builder.build(undamped(dt=1 / 240))
    generator = np.random.default_rng(0)
    noise = 0.5 * generator.normal(size=(2, 6, 3)) * ((1, 1, 0) if joint is Hinge else (1, 1, 1))
    if joint is Hinge:
        noise[1] = 0.5 * generator.normal(size=(6, 1)) * np.array(ACROSS)
    place = np.asarray(state.position, float)
    state = dataclasses.replace(
        state,
        velocity=jnp.asarray(noise[0] + np.cross((0, 0, 2.0), place), state.velocity.dtype),
        angular_velocity=jnp.asarray(noise[1] + (0, 0, 2.0), state.velocity.dtype),
    )
    # The first step takes what the joints do not allow.
    states = advance_worlds(repeat(model, 1), repeat(state, 1), 1)
    final, record = record_worlds(
        repeat(model, 1), states, 240, lambda model, state: {"gap": joint_gaps(model, state).translation}
    )
    leaves = {"mass": model.mass, "inertia": model.inertia}
    order = ("position", "orientation", "velocity", "angular_velocity")
    before, after = (
        invariants(leaves, *(np.asarray(getattr(states, name), float) for name in order)) for states in (states, final)
    )
    assert np.asarray(final.flags).tolist() == [0]
    gate("gap / bar", np.asarray(record["gap"]) / (2 * half), 1e-5)
    gate("energy / that at the start - 1", np.asarray(after[0]) / np.asarray(before[0]) - 1, 1e-2)
    scale = np.abs(np.asarray(before[2])).max()
    gate("angular momentum, change / size", (np.asarray(after[2]) - np.asarray(before[2])) / scale, 1e-3)
    gate("momentum, change / size", (np.asarray(after[1]) - np.asarray(before[1])) / scale, 1e-4)
