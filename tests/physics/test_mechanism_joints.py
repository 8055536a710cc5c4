"""Springs, friction, motors and stops on trees of joints. An arm welded of three blocks is one rigid body: closed forms.

Each block has ten times the mass of the one before it, so that what a joint sees of its two bodies says nothing of the arm.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mathota_jax import Box, Fixed, Hinge, SceneBuilder, Sphere, joint_gaps, joint_position, joint_velocity, rollout
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import DOWN, GRAVITY, advance, record_worlds, repeat, undamped

DT, STEPS = 1 / 240, 480
BLOCK, REACH = (0.15, 0.02, 0.03), 0.3
MASSES = (0.5, 5.0, 50.0)
PLACES = tuple(REACH * (k + 0.5) for k in range(3))
INERTIA = sum(m * ((BLOCK[0] ** 2 + BLOCK[1] ** 2) / 3 + x * x) for m, x in zip(MASSES, PLACES, strict=True))
FLAT_INERTIA = INERTIA + sum(m * (BLOCK[2] ** 2 - BLOCK[1] ** 2) / 3 for m in MASSES)
LOAD = GRAVITY * sum(m * x for m, x in zip(MASSES, PLACES, strict=True))
OMEGA = 2 * np.pi
STIFFNESS = FLAT_INERTIA * OMEGA**2
SLIP = 0.05  # [rad] dry friction over stiffness
ACROSS, UP = (0, 0, 1), (0, 1, 0)  # axes: gravity acts about the first

# name: axis, options of the hinge, motor with its action, initial rate.
ARMS = {
    "oscillator": (UP, {"stiffness": STIFFNESS, "rest": 1.0}, None, 0.0),
    "rubbing": (UP, {"stiffness": STIFFNESS, "rest": 1.0, "friction": SLIP * STIFFNESS}, None, 0.0),
    "viscous": (UP, {"damping": 2.0 * FLAT_INERTIA}, None, 1.0),
    "braked": (UP, {"friction": 0.8 * FLAT_INERTIA}, None, 1.0),
    "held by friction": (ACROSS, {"friction": 1.05 * LOAD}, None, 0.0),
    "driven": (UP, {}, ({"kind": "velocity", "cap": 0.5 * FLAT_INERTIA}, 0.6), 0.0),
    "servo": (UP, {}, ({"kind": "position", "stiffness": STIFFNESS}, 0.4), 0.0),
    "stopped": (UP, {"limits": (-0.5, 0.5)}, None, 1.0),
}


def welded_arm(builder, post, axis, options, motor, rate, masses=MASSES):
    """One arm along x; the handle of its hinge."""
    spin = rate * np.asarray(axis, float)
    last = hinge = post
    for k, mass in enumerate(masses):
        place = np.array([REACH * (k + 0.5), 0, 0])
        body = builder.add_body(
            Box(BLOCK), mass=mass, position=place, velocity=np.cross(spin, place), angular_velocity=spin, collides=False
        )
        if k:
            builder.add_joint(Fixed(last, body, (REACH * k, 0, 0)))
        else:
            hinge = builder.add_joint(Hinge(last, body, (0, 0, 0), axis, **options))
            if motor:
                builder.add_motor(hinge, limit=10.0, **motor)
        last = body
    return hinge


def observe(model, state):
    gaps = joint_gaps(model, state)
    return {
        "angle": joint_position(model, state),
        "rate": joint_velocity(model, state),
        "gap": jnp.maximum(gaps.translation.max(), gaps.rotation.max()),
    }


def all_arms():
    """Hinges by name, actions, model and state."""
    builder = SceneBuilder(gravity=DOWN)
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    hinges, actions = {}, []
    for name, (axis, options, motor, rate) in ARMS.items():
        hinges[name] = welded_arm(builder, post, axis, options, motor and motor[0], rate)
        actions += [motor[1]] if motor else []
    return hinges, actions, *builder.build(undamped(dt=DT))


@functools.cache
def recorded(precision):
    hinges, actions, model, state = all_arms()
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), STEPS, observe, jnp.asarray([actions]))
    return hinges, {name: np.asarray(values, float)[:, 0] for name, values in record.items()}


def of(precision, name):
    """Time after each step, angle and rate of one arm."""
    hinges, record = recorded(str(precision))
    return DT * np.arange(1, STEPS + 1), record["angle"][:, hinges[name]], record["rate"][:, hinges[name]]


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_joints_stay_closed(precision, gate):
    gate("gap [m, rad]", recorded(str(precision))[1]["gap"], {"float32": 5e-6, "float64": 1e-12}[str(precision)])


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_spring_swings_the_whole_arm(precision, gate):
    """``1 - cos(w t)`` with the moment of the arm: a spring that saw two bodies alone would damp it by a twentieth."""
    time, angle, _ = of(precision, "oscillator")
    gate("angle - truth [rad]", angle - (1 - np.cos(OMEGA * time)), 1e-3)
    gate("last peak - 2", angle[-240:].max() - 2.0, 1e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_dry_friction_takes_the_same_from_every_swing(precision, gate):
    """Each half cycle ends ``2 F / k`` short of where it would: the amplitude falls by ``4 F / k`` a cycle."""
    time, angle, _ = of(precision, "rubbing")
    half = np.floor(time * OMEGA / np.pi)
    sign, amplitude = np.where(half % 2 == 0, -1.0, 1.0), 1.0 - 2 * SLIP * half
    truth = 1 + sign * (SLIP + (amplitude - SLIP) * np.cos(OMEGA * time - half * np.pi))
    gate("angle - truth [rad]", angle - truth, 1e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_damper_stops_the_whole_arm(precision, gate):
    time, _, rate = of(precision, "viscous")
    gate("rate / truth - 1", rate / np.exp(-2.0 * time) - 1, 1e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_brake_stops_the_whole_arm(precision, gate):
    time, _, rate = of(precision, "braked")
    gate("rate - truth [rad/s]", rate - np.maximum(1.0 - 0.8 * time, 0.0), 1e-4)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_friction_above_the_load_holds(precision, gate):
    _, angle, _ = of(precision, "held by friction")
    gate("creep in 2 s [rad]", angle, {"float32": 1e-4, "float64": 1e-8}[str(precision)])


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_velocity_motor_turns_the_whole_arm(precision, gate):
    time, _, rate = of(precision, "driven")
    gate("rate - truth [rad/s]", rate - np.minimum(0.5 * time, 0.6), 1e-4)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_servo_swings_the_whole_arm(precision, gate):
    time, angle, _ = of(precision, "servo")
    gate("angle - truth [rad]", angle - 0.4 * (1 - np.cos(OMEGA * time)), 1e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_stop_without_restitution(precision, gate):
    """The arm arrives at 1 rad/s after 0.5 s and stays."""
    time, angle, rate = of(precision, "stopped")
    gate("beyond the stop [rad]", np.maximum(angle - 0.5, 0.0), 0.55 * DT)
    gate("rate after the stop [rad/s]", rate[time > 0.51], 1e-4)
    gate("angle at the end - stop [rad]", angle[-1] - 0.5, 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_by_what_acts_on_the_arms(float64, mode, gate):
    """All stiffnesses, dampings, frictions and caps times a factor: of angles and rates after 0.6 s, by the factor.

    What rubs before it turns back, at 0.4 s: friction reverses at the end of a step, whose number has no derivative.
    """
    hinges, actions, model, state = all_arms()
    time, before_turning = 0.6, 0.4

    def final(factor):
        names = ("joint_stiffness", "joint_damping", "joint_friction", "motor_stiffness", "motor_damping", "motor_cap")
        scaled = dataclasses.replace(model, **{name: factor * getattr(model, name) for name in names})
        steps = round(time / DT)
        last, path = rollout(scaled, state, jnp.broadcast_to(jnp.asarray(actions), (steps, len(actions))))
        before = jax.tree.map(lambda x: x[round(before_turning / DT) - 1], path)
        return joint_position(model, last), joint_velocity(model, last), joint_position(model, before)

    by_factor = jax.jit(mode(final))(jnp.asarray(1.0))
    phase = OMEGA * time
    of_angle = {
        "oscillator": np.sin(phase) * phase / 2,
        "servo": 0.4 * np.sin(phase) * phase / 2,
        "held by friction": 0.0,
        "stopped": 0.0,
    }
    of_rate = {"viscous": -2 * time * np.exp(-2 * time), "braked": -0.8 * time, "driven": 0.5 * time}
    phase = OMEGA * before_turning
    earlier = {"rubbing": (1 - SLIP) * np.sin(phase) * phase / 2}
    kinds = ("angle", "rate", "angle before it turns")
    for truths, found, kind in zip((of_angle, of_rate, earlier), by_factor, kinds, strict=True):
        for name, truth in truths.items():
            gate(f"{kind}, {name}: derivative - truth", float(found[hinges[name]]) - truth, 2e-3)


# Three hinges --------------------------------------------------------------------------------------------------------


def arm(options=None, gravity=DOWN, motor=None, ends=None, **hinge):
    """Three level links on hinges about z."""
    builder = SceneBuilder(gravity=gravity)
    last = builder.add_body(Sphere(0.02), static=True, collides=False)
    for k in range(3):
        body = builder.add_body(Box(BLOCK), mass=0.5, position=(PLACES[k], 0, 0), collides=False)
        joint = builder.add_joint(Hinge(last, body, (REACH * k, 0, 0), ACROSS, **hinge))
        if motor:
            builder.add_motor(joint, **motor)
        last = body
    return builder.build(options or undamped(dt=DT))


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_friction_holds_an_arm_of_three_hinges(precision, gate):
    """The load of the first hinge is ``0.5 g (0.15 + 0.45 + 0.75)``; 1.05 times that holds all three.

    From nothing; with the default 10 sweeps it slips by 1.3e-3 rad in the first steps, and then holds.
    """
    load = 0.5 * GRAVITY * sum(PLACES)
    model, state = arm(undamped(dt=DT, velocity_iterations=40), friction=1.05 * load)
    final = advance(model, state, STEPS)
    gate("creep in 2 s [rad]", np.asarray(joint_position(model, final)), 1e-4)


def test_arm_of_springs_and_dampers_is_that_of_mujoco(float64, gate):
    """Against MuJoCo's fourth-order integrator at a tenth of the step."""
    mujoco = pytest.importorskip("mujoco")
    stiffness, damping, dt = 8.0, 0.05, 1 / 960
    links = ""
    for _ in range(3):
        links += (
            f'<body pos="{REACH if links else 0} 0 0"><joint type="hinge" axis="0 0 1" stiffness="{stiffness}" '
            f'damping="{damping}"/><geom type="box" size="0.15 0.02 0.03" pos="0.15 0 0" mass="0.5" '
            'contype="0" conaffinity="0"/>'
        )
    text = (
        f'<mujoco><option timestep="{dt / 10}" integrator="RK4" gravity="0 {-GRAVITY} 0"/><worldbody>{links}'
        f"{'</body>' * 3}</worldbody></mujoco>"
    )
    peer = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(peer)
    truth = []
    for _ in range(960):
        mujoco.mj_step(peer, data, 10)
        truth.append(data.qpos.copy())
    model, state = arm(undamped(dt=dt), stiffness=stiffness, damping=damping)
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), 960, observe)
    angle = np.asarray(record["angle"], float)[:, 0]
    assert np.ptp(angle) > 0.5
    gate("angles - MuJoCo's [rad]", angle - np.array(truth), 5e-3)


@pytest.mark.slow
def test_derivatives_of_both_modes_agree(float64, gate):
    """By the masses, through stops, friction and motors at work: friction that holds and a stop may say the same."""
    model, state = arm(
        friction=0.2, limits=(-0.3, 0.3), motor={"kind": "velocity", "cap": 0.5}, options=undamped(dt=1 / 60)
    )
    action = jnp.array([0.3, -0.2, 0.1])

    def final(mass, effort):
        changed = dataclasses.replace(model, mass=mass)
        return rollout(changed, state, jnp.broadcast_to(effort, (20, 3)))[0].angular_velocity[1:]

    forward = jax.jacfwd(final, (0, 1))(model.mass, action)
    reverse = jax.jacrev(final, (0, 1))(model.mass, action)
    for a, b in zip(forward, reverse, strict=True):
        assert np.isfinite(a).all()
        gate("forward - reverse, relative", np.asarray(a - b) / np.abs(b).max(), 1e-9)


@pytest.mark.slow
def test_derivative_of_a_pendulum_in_forward_mode(float64, gate):
    """A welded arm swings from level; the angle after 0.8 s by gravity, from the variational equation."""

    def pendulum(_, y):
        angle, rate, by_g, rate_by_g = y
        lever = LOAD / GRAVITY / INERTIA
        return [
            rate,
            -GRAVITY * lever * np.cos(angle),
            rate_by_g,
            -lever * np.cos(angle) + GRAVITY * lever * np.sin(angle) * by_g,
        ]

    truth = solve_ivp(pendulum, (0, 0.8), np.zeros(4), method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    builder = SceneBuilder(gravity=DOWN)
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    welded_arm(builder, post, ACROSS, {}, None, 0.0)
    model, state = builder.build(undamped(dt=1 / 240))

    def angle(gravity):
        changed = dataclasses.replace(model, gravity=model.gravity * gravity / GRAVITY)
        return joint_position(changed, rollout(changed, state, 192)[0])[0]

    value, slope = jax.jit(lambda g: jax.jvp(angle, (g,), (jnp.ones_like(g),)))(jnp.asarray(GRAVITY))
    gate("angle / truth - 1", float(value) / truth[0] - 1, 1e-3)
    gate("slope / truth - 1", float(slope) / truth[2] - 1, 1e-3)
