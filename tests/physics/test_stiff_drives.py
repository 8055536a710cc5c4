"""Arms and robots whose springs and servos hold almost as joints do. Closed forms: statics, one rigid bar, small motion."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

from mathota_jax import (
    Box,
    Capsule,
    Hinge,
    Plane,
    SceneBuilder,
    contact_forces,
    energy,
    joint_position,
    joint_velocity,
    rollout,
    step,
)
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.scenes import DOWN, GRAVITY, add_driven_hinge, quadruped, stiffened, undamped

LINKS, LENGTH = 6, 0.2
CENTRES = LENGTH * (np.arange(LINKS) + 0.5)


def arm(drive, dt, gravity=DOWN):
    """Six bars of 1 kg in a row along x, hinged about z; the first to the ground."""
    builder = SceneBuilder(gravity=gravity)
    parent = builder.add_body(Box((0.1, 0.1, 0.1)), static=True, collides=False)
    for link in range(LINKS):
        place = (LENGTH * (link + 0.5), 0, 0)
        child = builder.add_body(Box((0.1, 0.02, 0.02)), mass=1.0, position=place, collides=False)
        add_driven_hinge(builder, drive, parent, child, (LENGTH * link, 0, 0))
        parent = child
    return builder.build(undamped(dt=dt))


def angles_at_rest(stiffness):
    """Angles of the joints at which springs bear the arm."""

    def excess(joints):
        along = np.cumsum(joints)
        ends = np.concatenate([[0.0], np.cumsum(LENGTH * np.cos(along))])
        centres = 0.5 * (ends[1:] + ends[:-1])
        return [stiffness * joints[k] + GRAVITY * (centres[k:] - ends[k]).sum() for k in range(LINKS)]

    return fsolve(excess, np.zeros(LINKS), xtol=1e-13)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize("dt", slow_but((1 / 60,), (1 / 60, 1 / 240)))
@pytest.mark.parametrize("drive", ["servo", pytest.param("spring", marks=pytest.mark.slow)])
def test_an_arm_bears_its_weight(precision, drive, dt, gate):
    """With ten sweeps the links moved by 46 m/s at 1/60 s and 1e4 N m/rad."""
    model, state = arm(drive, dt)

    @jax.jit
    def settle(stiffness):
        final, _ = rollout(stiffened(model, drive, stiffness, 0.01 * stiffness), state, round(3 / dt))
        return joint_position(model, final), jnp.abs(final.velocity).max()

    for stiffness in (1e4, 1e5, 1e6):
        angles, speed = settle(stiffness)
        truth = angles_at_rest(stiffness)
        limit = {"float64": 1e-6, "float32": 1e-3}[str(precision)]
        gate(
            f"angles at {stiffness:g} N m/rad / truth - 1",
            np.asarray(angles, float) / truth - 1,
            limit * stiffness / 1e4,
        )
        gate(f"speed at {stiffness:g} N m/rad [m/s]", speed, 1e-4)


def bar_with_a_weak_shoulder(seconds, torque):
    """Angle and rate of one rigid bar that starts level at rest, with a constant torque at its end."""
    moment = LINKS * (0.2**2 + 0.04**2) / 12 + (CENTRES**2).sum()

    def rates(_, y):
        return [y[1], (torque - GRAVITY * CENTRES.sum() * np.cos(y[0])) / moment]

    return solve_ivp(rates, (0, seconds), [0.0, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]


@pytest.mark.parametrize("dt", [1 / 60, pytest.param(1 / 240, marks=pytest.mark.slow)])
def test_what_a_servo_at_its_cap_does_not_carry_the_others_do_not_either(float64, dt, gate):
    """A shoulder that may exert 20 N m, of 35 that it would take, lets an arm of stiff elbows fall as one bar."""
    model, state = arm("servo", dt)
    model = stiffened(model, "servo", 1e6, 1e4)
    model = dataclasses.replace(model, motor_cap=model.motor_cap.at[0].set(20.0))
    steps = round(0.25 / dt)
    actions = jnp.tile(jnp.zeros(LINKS).at[0].set(1.0), (steps, 1))
    final, _ = jax.jit(rollout)(model, state, actions)
    angle, rate = bar_with_a_weak_shoulder(steps * dt, 20.0)
    gate("angle [rad]", float(joint_position(model, final)[0]) - angle, 5e-5)
    gate("rate / truth - 1", float(joint_velocity(model, final)[0]) / rate - 1, 1e-4)
    gate("elbows [rad]", joint_position(model, final)[1:], 5e-5)


@pytest.mark.slow
@pytest.mark.parametrize("dt", (1 / 60, 1 / 240))
def test_an_arm_of_springs_gains_no_energy(float64, dt, gate):
    """It starts level, turning as a whole by 2 rad/s; no damping."""
    model, state = arm("spring", dt)
    state = dataclasses.replace(
        state,
        angular_velocity=state.angular_velocity.at[1:, 2].set(2.0),
        velocity=state.velocity.at[1:, 1].set(2.0 * CENTRES),
    )

    @jax.jit
    def run(stiffness):
        stiff = stiffened(model, "spring", stiffness, 0.0)

        def advance(state, _):
            state = step(stiff, state)
            bent = 0.5 * stiffness * (joint_position(stiff, state) ** 2).sum()
            return state, energy(stiff, state) + bent

        return jax.lax.scan(advance, state, None, length=round(3 / dt))[1]

    scale = 0.5 * (CENTRES**2).sum() * 2.0**2 + GRAVITY * CENTRES.sum()
    for stiffness in (1e2, 1e3, 1e4):
        gained = (np.asarray(run(stiffness)) - float(energy(model, state))) / scale
        gate(f"gained at {stiffness:g} N m/rad / scale", np.maximum(gained.max(), 0.0), 1e-4)


def test_small_motion_is_that_of_the_modes(float64, gate):
    """Six links, no gravity: of second order in the step."""
    stiffness, seconds = 10.0, 0.25
    turns = np.tril(np.ones((LINKS, LINKS)))
    centres = LENGTH * (np.tril(np.ones((LINKS, LINKS)), -1) + 0.5 * np.eye(LINKS)) @ turns
    masses = centres.T @ centres + (0.2**2 + 0.04**2) / 12 * turns.T @ turns
    squares, modes = np.linalg.eig(stiffness * np.linalg.inv(masses))
    rates = 1e-3 * np.array([1.0, -2.0, 0.5, 1.5, -1.0, 2.0])
    frequencies = np.sqrt(squares)
    truth = modes @ (np.linalg.solve(modes, rates) * np.sin(frequencies * seconds) / frequencies)
    errors = []
    for dt in (1 / 240, 1 / 480):
        model, state = arm("spring", dt, gravity=(0, 0, 0))
        state = dataclasses.replace(
            state,
            angular_velocity=state.angular_velocity.at[1:, 2].set(turns @ rates),
            velocity=state.velocity.at[1:, 1].set(centres @ rates),
        )
        final, _ = jax.jit(rollout, static_argnums=2)(
            stiffened(model, "spring", stiffness, 0.0), state, round(seconds / dt)
        )
        errors.append(np.abs(np.asarray(joint_position(model, final)) - truth).max() / np.abs(truth).max())
    gate("error at 1/240 s", errors[0], 0.02)
    gate("error at half the step / a quarter - 1", 4 * errors[1] / errors[0] - 1, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivative_of_what_bears_the_arm(float64, mode, gate):
    """By the stiffness of the servos; the linear statics have -angle / stiffness."""
    model, state = arm("servo", 1 / 60)
    stiffness = 1e5

    def angles(stiffness):
        final, _ = rollout(stiffened(model, "servo", stiffness, 1e3), state, 120)
        return joint_position(model, final)

    slope = np.asarray(jax.jit(mode(angles))(stiffness))
    truth = (angles_at_rest(1.001 * stiffness) - angles_at_rest(0.999 * stiffness)) / (0.002 * stiffness)
    gate("slopes / truth - 1", slope / truth - 1, 1e-5)


THIGH, SHIN, CROUCH = 0.23, 0.25, 0.5


@functools.cache
def slope_of_a_crouch(mode):
    """Function of the angle of the hips and the stiffness."""
    model, state = quadruped("servo", undamped(dt=1 / 60))

    def height(hip, stiffness):
        knee = -(hip + jnp.arcsin(THIGH * jnp.sin(hip) / SHIN))
        targets = jnp.tile(jnp.stack([hip, knee]), (150, 4))
        return rollout(stiffened(model, "servo", stiffness, 0.05 * stiffness), state, targets)[0].position[1, 1]

    return jax.jit(mode(height))


@pytest.mark.slow
@pytest.mark.parametrize(("stiffness", "limit"), [(2e3, 0.025), (1e4, 0.01)])
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivative_of_a_crouch(float64, mode, stiffness, limit, gate):
    """Of the height by the angle of the hips, from the kinematics of the legs. By sweeps alone it had the wrong sign."""
    below = np.arcsin(THIGH * np.sin(CROUCH) / SHIN)
    truth = -THIGH * (np.sin(CROUCH) + np.tan(below) * np.cos(CROUCH))
    gate("slope / truth - 1", float(slope_of_a_crouch(mode)(CROUCH, stiffness)) / truth - 1, limit)


@pytest.mark.slow
@pytest.mark.parametrize("drive", ["servo", "spring"])
def test_a_robot_on_stiff_legs_stands_still(precision, drive, gate):
    """Ten sweeps alone, and forty at 2000 N m/rad, made it shiver by 0.2 m/s at 1/60 s."""
    model, state = quadruped(drive, undamped(dt=1 / 60))

    @jax.jit
    def run(stiffness):
        return rollout(stiffened(model, drive, stiffness, 0.01 * stiffness), state, 120)[0]

    for stiffness in (100.0, 300.0, 2000.0, 1e4):
        final = run(stiffness)
        gate(f"speed at {stiffness:g} N m/rad [m/s]", np.asarray(final.velocity), 1e-4)
        gate(f"moved at {stiffness:g} N m/rad [m]", np.asarray(final.position - state.position, float), 3e-4)
        borne = np.abs(np.asarray(contact_forces(model, final), float)[:, 1]).sum()
        gate(f"borne at {stiffness:g} N m/rad / weight - 1", borne / (22.4 * GRAVITY) - 1, 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("on_ground", [True, False])
def test_random_arms_gain_no_more_than_their_servos_give(precision, on_ground, gate):
    """Masses 1 : 1000, stiffnesses 1 to 1e6 and caps 0.1 to 1000 N m at random; stops and friction; targets that change."""
    worlds, steps = 64, 180
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0), -0.5), static=True, friction=0.8, collides=on_ground)
    parent, links = builder.add_body(Box((0.1, 0.1, 0.1)), static=True, collides=False), []
    for link in range(5):
        place = (LENGTH * (link + 0.5), 0, 0)
        child = builder.add_body(Capsule(0.02, 0.08), mass=1.0, position=place, orientation=(0.5**0.5, 0, 0, 0.5**0.5))
        axis = (0, 0.3 * (-1) ** link, 1)
        hinge = Hinge(
            parent=parent, child=child, anchor=(LENGTH * link, 0, 0), axis=axis, limits=(-0.7, 0.7), friction=0.1
        )
        builder.add_motor(builder.add_joint(hinge), kind="position", stiffness=1.0, damping=1.0, limit=3.0)
        links.append(child)
        parent = child
    builder.ignore_collisions(links)
    model, state = builder.build(undamped(dt=1 / 60))
    rng = np.random.default_rng(5)

    def powers_of_ten(low, high, like):
        return jnp.asarray(10 ** rng.uniform(low, high, (worlds, *like.shape)), like.dtype)

    mass, stiffness = powers_of_ten(-1.5, 1.5, model.mass), powers_of_ten(0, 6, model.motor_stiffness)
    models = dataclasses.replace(
        jax.tree.map(lambda x: jnp.broadcast_to(x, (worlds, *x.shape)), model),
        mass=mass,
        inertia=model.inertia * mass[..., None],
        motor_stiffness=stiffness,
        motor_damping=stiffness * powers_of_ten(-3, 0, model.motor_damping),
        motor_cap=powers_of_ten(-1, 3, model.motor_cap),
    )
    targets = jnp.asarray(rng.uniform(-2, 2, (worlds, 3, 5)), state.position.dtype)

    @jax.jit
    @jax.vmap
    def run(model, targets):
        def advance(carry, number):
            state, given = carry
            before = joint_position(model, state)
            state = step(model, state, targets[number // 60])
            given = given + (model.motor_cap * jnp.abs(joint_position(model, state) - before)).sum()
            return (state, given), energy(model, state) - given

        final, left = jax.lax.scan(advance, (state, 0.0), jnp.arange(steps))
        return left, energy(model, state), final[1]

    left, start, given = (np.asarray(values, float) for values in run(models, targets))
    scale = GRAVITY * np.asarray(mass[:, links], float).sum(1) + given
    gate(
        "energy - that given by servos, over the scale", np.maximum((left - start[:, None]) / scale[:, None], 0.0), 1e-3
    )
