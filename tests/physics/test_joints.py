"""Hinge and slider against closed forms: pendulum period, slope, limits, damping, motors, closed gaps."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.special import ellipk

from mathota_jax import Box, Hinge, SceneBuilder, Slider, Sphere, joint_position, joint_velocity
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import (
    DOWN,
    GRAVITY,
    advance,
    axis_angle,
    invariants,
    motion,
    record_worlds,
    repeat,
    rotation_matrix,
    stack,
    tilted_gravity,
    undamped,
)

DT = 1 / 240
ROD = (0.05, 0.25, 0.04)
ARM, MASS = 0.3, 2.0
ROD_INERTIA_Z = MASS * (ROD[0] ** 2 + ROD[1] ** 2) / 3
PIVOT_INERTIA = ROD_INERTIA_Z + MASS * ARM**2


def with_joint_angle(model, state):
    return {**motion(model, state), "angle": joint_position(model, state), "rate": joint_velocity(model, state)}


def pendulum(angle=0.0, *, gravity=DOWN, arm=ARM, rate=0.0, motor=None, dt=DT, **joint):
    """A rod hung from a fixed point, turned by `angle` [rad] from hanging down about +Z."""
    down = np.array([np.sin(angle), -np.cos(angle), 0.0])
    builder = SceneBuilder(gravity=gravity)
    post = builder.add_body(Sphere(0.02), static=True)
    rod = builder.add_body(
        Box(ROD),
        mass=MASS,
        position=arm * down,
        orientation=axis_angle((0, 0, 1), angle),
        velocity=rate * arm * np.array([np.cos(angle), np.sin(angle), 0.0]),
        angular_velocity=(0.0, 0.0, rate),
    )
    hinge = builder.add_joint(Hinge(parent=post, child=rod, anchor=(0, 0, 0), axis=(0, 0, 1), **joint))
    if motor is not None:
        builder.add_motor(hinge, kind="torque", **motor)
    return builder.build(undamped(dt=dt))


def block_on_rail(*, axis=(1, 0, 0), gravity=DOWN, motor=None, **joint):
    builder = SceneBuilder(gravity=gravity)
    post = builder.add_body(Sphere(0.02), static=True, position=(0.0, 1.0, 0.0))
    block = builder.add_body(Box((0.1, 0.05, 0.08)), mass=MASS)
    slider = builder.add_joint(Slider(parent=post, child=block, anchor=(0, 0, 0), axis=axis, **joint))
    if motor is not None:
        builder.add_motor(slider, kind="torque", **motor)
    return builder.build(undamped(dt=DT))


def gap(record, arm=ARM):
    """Distance [m] of the rod's joint point from the fixed anchor."""
    rotation = rotation_matrix(record["orientation"][..., 1, :])
    return np.linalg.norm(np.asarray(record["position"], dtype=float)[..., 1, :] + arm * rotation[..., :, 1], axis=-1)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_pendulum_period_energy_and_gap(precision, gate):
    amplitudes = np.array([0.2, 1.0, 2.0])
    worlds = [pendulum(angle) for angle in amplitudes]
    models, states = stack([m for m, _ in worlds]), stack([s for _, s in worlds])
    _, record = record_worlds(models, states, 1200, with_joint_angle)
    # The coordinate of a hinge lies in (-pi, pi]; the swing of 4 rad does not.
    angle = np.unwrap(np.asarray(record["angle"], dtype=float)[:, :, 0], axis=0) + amplitudes
    time = DT * (1 + np.arange(len(angle)))
    for world, amplitude in enumerate(amplitudes):
        turn = angle[:, world]
        before = np.flatnonzero(turn[:-1] * turn[1:] < 0)
        crossing = time[before] - turn[before] * DT / (turn[before + 1] - turn[before])
        period = 2 * np.mean(np.diff(crossing))
        truth = 4 * np.sqrt(PIVOT_INERTIA / (MASS * GRAVITY * ARM)) * ellipk(np.sin(amplitude / 2) ** 2)
        gate(f"period / truth - 1, amplitude {amplitude} rad", period / truth - 1, 5e-3)
        gate(f"first crossing / quarter period - 1, amplitude {amplitude} rad", crossing[0] / (truth / 4) - 1, 5e-3)

    height = np.asarray(record["position"], dtype=float)[:, :, 1, 1] + ARM * np.cos(amplitudes)
    rod = {"mass": models.mass[0, 1:], "inertia": models.inertia[0, 1:]}
    moving = [record[key][:, :, 1:] for key in ("position", "orientation", "velocity", "angular_velocity")]
    energy = invariants(rod, *moving)[0] + MASS * GRAVITY * height
    scale = MASS * GRAVITY * ARM * (1 - np.cos(amplitudes))
    gate("energy drift over 5 s / swing energy", energy / scale, 0.02)
    gate("joint gap / arm", gap(record) / ARM, 1e-3)
    gate("out of plane [m]", np.asarray(record["position"])[:, :, 1, 2], 1e-5)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_joint_position_is_the_angle_of_the_child(precision, gate):
    """The sign is parent to child, right-handed about the axis, and the rate is its derivative."""
    model, state = pendulum(0.4, gravity=(0, 0, 0), rate=1.5)
    gate("angle at the build pose", joint_position(model, state), 1e-6)
    gate("rate at the build pose - 1.5", joint_velocity(model, state)[0] - 1.5, 1e-6)
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), 120, with_joint_angle)
    turned = 2 * np.arctan2(*(np.asarray(record["orientation"], dtype=float)[:, 0, 1, [3, 0]].T)) - 0.4
    gate("angle against the orientation [rad]", record["angle"][:, 0, 0] - turned, 1e-4)
    gate("angle at 0.5 s / truth - 1", record["angle"][-1, 0, 0] / 0.75 - 1, 5e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_free_turn_about_a_hinge_keeps_its_speed(precision, gate):
    """The centripetal force of the joint does no work, so an off-centre rod turns for ever."""
    model, state = pendulum(gravity=(0, 0, 0), rate=3.0)
    final = advance(model, state, 1200)
    gate("rate after 5 s / start - 1", joint_velocity(model, final)[0] / 3.0 - 1, 0.01)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_slider_on_a_slope_falls_as_g_sin_theta(precision, gate):
    slopes = [10.0, 30.0, 60.0]
    worlds = [block_on_rail(gravity=tilted_gravity(angle)) for angle in slopes]
    models, states = stack([m for m, _ in worlds]), stack([s for _, s in worlds])
    _, record = record_worlds(models, states, 240, with_joint_angle)
    truth = 0.5 * GRAVITY * np.sin(np.radians(slopes))
    gate("position after 1 s / truth - 1", record["angle"][-1, :, 0] / truth - 1, 1e-3)
    gate("velocity after 1 s / truth - 1", record["rate"][-1, :, 0] / (2 * truth) - 1, 1e-3)
    gate("movement across the rail [m]", record["position"][:, :, 1, 1:], 1e-4)
    gate("turn [rad]", record["orientation"][:, :, 1, 1:], 1e-4)


def test_slider_along_an_oblique_rail(float64, gate):
    axis = np.array([2.0, -1.0, 2.0]) / 3
    model, state = block_on_rail(axis=tuple(2 * axis))  # the axis need not be a unit vector
    final = advance(model, state, 240)
    truth = 0.5 * GRAVITY / 3
    gate("joint position / truth - 1", joint_position(model, final)[0] / truth - 1, 1e-3)
    gate("place [m]", final.position[1] - truth * axis, 2e-3)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_hinge_limits_hold(precision, side, gate):
    """The rod starts level and falls onto its stop; the stops are not symmetric."""
    limits = (-0.3, 0.5)
    model, state = pendulum(-side * np.pi / 2, limits=limits)
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), 480, with_joint_angle)
    angle = np.asarray(record["angle"], dtype=float)[:, 0, 0]
    stop = limits[1] if side > 0 else limits[0]
    gate("beyond the stop [rad]", max(0.0, (side * (angle - stop)).max()), 5e-3)
    gate("rests on the stop [rad]", angle[-1] - stop, 5e-3)
    gate("rate at rest [rad/s]", record["rate"][-1, 0], 1e-2)
    gate("joint gap / arm", gap(record) / ARM, 5e-3)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_slider_limits_hold(precision, side, gate):
    limits = (-0.2, 0.5)
    model, state = block_on_rail(gravity=(side * GRAVITY, 0.0, 0.0), limits=limits)
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), 480, with_joint_angle)
    place = np.asarray(record["angle"], dtype=float)[:, 0, 0]
    stop = limits[1] if side > 0 else limits[0]
    gate("beyond the stop [m]", max(0.0, (side * (place - stop)).max()), 5e-3)
    gate("rests on the stop [m]", place[-1] - stop, 5e-3)
    free = np.arange(1, 40) * DT
    gate("free fall before the stop [m]", side * place[:39] - 0.5 * GRAVITY * free**2, 1e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_damping_decays_at_its_rate(precision, gate):
    """Viscous joint damping c: the rate falls as exp(-c t / I), the sliding speed as exp(-c t / m)."""
    damping, time = 0.05, 1.0
    model, state = pendulum(gravity=(0, 0, 0), arm=0.0, rate=3.0, damping=damping)
    final = advance(model, state, round(time / DT))
    measured = -np.log(float(joint_velocity(model, final)[0]) / 3.0) / time
    gate("hinge: rate / (c / I) - 1", measured / (damping / ROD_INERTIA_Z) - 1, 1e-4)

    model, state = block_on_rail(gravity=(0, 0, 0), damping=3.0)
    state = dataclasses.replace(state, velocity=state.velocity.at[1, 0].set(2.0))
    final = advance(model, state, round(time / DT))
    measured = -np.log(float(joint_velocity(model, final)[0]) / 2.0) / time
    gate("slider: rate / (c / m) - 1", measured / (3.0 / MASS) - 1, 1e-4)


@pytest.mark.parametrize("damping", [0.01, 3.0, 400.0])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_damped_coordinate_under_a_constant_force(precision, damping, gate):
    """``m u' = f - c u``: the speed approaches f / c as 1 - exp(-c t / m), at any damping and step."""
    model, state = block_on_rail(gravity=(0, 0, 0), damping=damping, motor={"limit": 5.0})
    steps = 60
    final = advance(model, state, steps, np.array([3.0]))
    truth = 3.0 / damping * -np.expm1(-damping / MASS * steps * DT)
    limit = 1e-11 if precision == "float64" else 2e-5
    gate("speed / truth - 1", joint_velocity(model, final)[0] / truth - 1, limit)


@pytest.mark.parametrize(
    ("gear", "action", "torque"),
    [(1.0, 0.2, 0.2), (1.0, -0.2, -0.2), (3.0, 0.2, 0.6), (1.0, 9.0, 0.5), (3.0, -9.0, -1.5)],
)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_torque_motor(precision, gear, action, torque, gate):
    """The action is clipped to the limit, then multiplied by the gear; off-centre the rod turns about the pivot."""
    for arm, inertia in ((0.0, ROD_INERTIA_Z), (ARM, PIVOT_INERTIA)):
        model, state = pendulum(gravity=(0, 0, 0), arm=arm, motor={"limit": 0.5, "gear": gear})
        final = advance(model, state, 24, np.array([action]))
        gate(f"arm {arm}: rate / truth - 1", joint_velocity(model, final)[0] / (0.1 * torque / inertia) - 1, 1e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_force_motor(precision, gate):
    model, state = block_on_rail(gravity=(0, 0, 0), motor={"limit": 5.0})
    final = advance(model, state, 120, np.array([3.0]))
    gate("speed / truth - 1", joint_velocity(model, final)[0] / (3.0 * 0.5 / MASS) - 1, 1e-3)
    gate("place / truth - 1", joint_position(model, final)[0] / (0.5 * 3.0 / MASS * 0.25) - 1, 1e-2)


def two_free_bodies(joint, motor):
    builder = SceneBuilder(gravity=(0, 0, 0))
    left = builder.add_body(Box((0.2, 0.1, 0.15)), mass=1.0, position=(-0.3, 0, 0), angular_velocity=(0.5, 0.2, 0.0))
    right = builder.add_body(Box((0.25, 0.12, 0.1)), mass=3.0, position=(0.3, 0, 0), velocity=(0.0, 0.3, -0.2))
    handle = builder.add_joint(joint(parent=left, child=right, anchor=(0.0, 0.05, 0.0), axis=(0, 0, 1)))
    builder.add_motor(handle, kind=motor, limit=5.0)
    return builder.build(undamped(dt=DT))


@pytest.mark.slow
@pytest.mark.parametrize(("joint", "motor"), [(Hinge, "torque"), (Slider, "torque")])
def test_joint_and_motor_act_with_equal_reaction(precision, joint, motor, gate):
    model, state = two_free_bodies(joint, motor)
    final = advance(model, state, 120, np.array([0.5]))
    leaves = {"mass": model.mass, "inertia": model.inertia}
    arrays = [(s.position, s.orientation, s.velocity, s.angular_velocity) for s in (state, final)]
    (_, linear, angular), (_, linear_after, angular_after) = (invariants(leaves, *a) for a in arrays)
    gate("linear momentum [kg m/s]", linear_after - linear, {"float32": 2e-5, "float64": 1e-10}[str(precision)])
    gate("angular momentum [kg m^2/s]", angular_after - angular, 1e-3)
    assert abs(float(joint_velocity(model, final)[0])) > 0.1, "the motor does not move the joint"


@pytest.mark.slow
def test_double_pendulum_keeps_its_joints_closed(precision, gate):
    """Two links released level; the lower one is ten times as heavy."""
    builder = SceneBuilder(gravity=DOWN)
    post = builder.add_body(Sphere(0.02), static=True)
    upper = builder.add_body(Box((0.2, 0.03, 0.03)), mass=0.3, position=(0.2, 0, 0))
    lower = builder.add_body(Box((0.2, 0.04, 0.04)), mass=3.0, position=(0.6, 0, 0))
    builder.add_joint(Hinge(parent=post, child=upper, anchor=(0, 0, 0), axis=(0, 0, 1)))
    builder.add_joint(Hinge(parent=upper, child=lower, anchor=(0.4, 0, 0), axis=(0, 0, 1)))
    model, state = builder.build(undamped(dt=DT))
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), 720, motion)
    position = np.asarray(record["position"], dtype=float)[:, 0]
    along = rotation_matrix(record["orientation"][:, 0])[..., :, 0]
    first = position[:, 1] - 0.2 * along[:, 1]
    second = (position[:, 2] - 0.2 * along[:, 2]) - (position[:, 1] + 0.2 * along[:, 1])
    gate("upper gap / link", np.linalg.norm(first, axis=-1) / 0.4, 0.01)
    gate("lower gap / link", np.linalg.norm(second, axis=-1) / 0.4, 0.01)
    energy = invariants(
        {"mass": model.mass[1:], "inertia": model.inertia[1:]},
        *(record[key][:, 0, 1:] for key in ("position", "orientation", "velocity", "angular_velocity")),
    )[0] + GRAVITY * (position[:, 1:, 1] @ np.asarray(model.mass[1:], dtype=float))
    gate("energy gained / swing energy", max(0.0, energy.max()) / (3.0 * GRAVITY * 0.6), 0.02)


def test_jointed_bodies_do_not_collide(float64):
    """The rod overlaps the post it hangs from; the pair is not admissible."""
    model, state = pendulum(arm=0.1)
    final = jax.block_until_ready(advance(model, state, 60))
    assert float(np.abs(np.asarray(final.velocity)).max()) < 1e-9


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("lower", [-1.0, -3.0, -np.pi])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_stop_at_half_a_turn(precision, gate, lower, sign):
    """The arm that turns at 4 rad/s stops at pi, where the angle jumps by a full turn, and stays there."""
    limits = sorted((sign * lower, sign * np.pi))
    model, state = pendulum(gravity=(0.0, 0.0, 0.0), rate=4.0 * sign, limits=limits)
    _, recorded = record_worlds(repeat(model, 1), repeat(state, 1), 480, with_joint_angle)
    angle = np.unwrap(np.asarray(recorded["angle"], float)[:, 0, 0])
    gate("beyond the stop", np.maximum(sign * angle - np.pi, 0.0), 1e-3)
    gate("away from it in the last second", sign * angle[240:] - np.pi, 1e-3)
