"""Motors and servos that drive into the stops of their joints, against statics: none yields to the other."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Hinge, Plane, SceneBuilder, Sphere, joint_forces, joint_position, joint_velocity, rollout
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.scenes import DOWN, GRAVITY, stiffened, undamped

LENGTH, HALF, MASS, STOP, DT = 0.4, 0.02, 1.0, 0.3, 1 / 240


def arms(solver, cap):
    """An arm of two links that is driven up, and one of a single link driven down; also the ways of the joints.

    Weights pull the one off its stops and press the other into its.
    """
    builder = SceneBuilder(gravity=DOWN)
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    for count, limits in ((2, (-1.0, STOP)), (1, (-STOP, 1.0))):
        last = post
        for link in range(count):
            centre = (LENGTH * (link + 0.5), 0, 0)
            body = builder.add_body(Box((LENGTH / 2, HALF, HALF)), mass=MASS, position=centre, collides=False)
            joint = builder.add_joint(Hinge(last, body, (LENGTH * link, 0, 0), (0, 0, 1), limits=limits))
            builder.add_motor(joint, kind="velocity", cap=cap)
            last = body
    model, state = builder.build(undamped(dt=DT, solver=solver))
    return model, state, np.array([1.0, 1.0, -1.0])


@pytest.mark.parametrize("cap", [None, 100.0])
@pytest.mark.parametrize("solver", slow_but(("pgs",), ("pgs", "soft_step", "converged")))
def test_a_motor_holds_its_joint_at_the_stop_and_leaves_it_as_told(solver, cap, gate):
    model, state, ways = arms(solver, cap)
    actions = np.repeat([ways, -ways], [720, 60], axis=0)
    _, record = rollout(model, state, jnp.asarray(actions))

    def observe(state):
        return joint_position(model, state), joint_velocity(model, state), joint_forces(model, state)[0]

    place, rate, force = (np.asarray(found) for found in jax.vmap(observe)(record))
    told = np.minimum(np.arange(1, 721) * DT, STOP)[:, None] * ways
    gate("on the way [rad]", place[:720] - told, 1.5 * DT)
    gate("at the stop [rad]", place[240:720] - STOP * ways, 2e-5)
    gate("rate at the stop [rad/s]", rate[240:720], 1e-3)
    weights = MASS * GRAVITY * np.array([2.0, 1.0, 1.0])
    gate("force on the hinges / weight - 1", force[240:720, :, 1] / weights - 1, 1e-3)
    left = STOP * ways - np.arange(1, 61)[:, None] * DT * ways
    gate("on the way back [rad]", place[720:] - left, 1.5 * DT)
    assert not record.flags.any()


def critical(stiffness, mass):
    """Damping of a lone link about its end [N m s/rad]."""
    return 2 * np.sqrt(stiffness * mass * LENGTH**2 / 3)


def servo_arm(solver, links, stiffness, contacts=False):
    """Links of 1 kg in a row along x, whose critically damped servos want 1 rad, beyond their stops."""
    builder = SceneBuilder(gravity=DOWN)
    last = builder.add_body(Sphere(0.02), static=True, collides=False)
    if contacts:
        builder.add_body(Plane((0, 1, 0)), static=True, position=(0, -5, 0))
        builder.add_body(Sphere(0.1), mass=1.0, position=(0, -4.9, 0))
    for link in range(links):
        place = (LENGTH * (link + 0.5), 0, 0)
        body = builder.add_body(Box((LENGTH / 2, HALF, HALF)), mass=MASS, position=place, collides=False)
        joint = builder.add_joint(Hinge(last, body, (LENGTH * link, 0, 0), (0, 0, 1), limits=(-1.0, STOP)))
        builder.add_motor(joint, kind="position", stiffness=stiffness, damping=critical(stiffness, MASS))
        last = body
    return builder.build(undamped(dt=1 / 60, solver=solver))


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize("links", slow_but((2,), (1, 2, 3)))
@pytest.mark.parametrize("solver", slow_but(("pgs",), ("pgs", "soft_step", "converged")))
def test_stiff_servos_rest_against_stops(precision, solver, links, gate):
    """Swept, two links of 0.1 kg with 1e4 N m/rad went round at 1e6 rad/s (default), and `soft_step` gave NaN."""
    check_rest(precision, solver, links, gate, contacts=False)


@pytest.mark.slow
@pytest.mark.parametrize("links", (1, 2, 3))
def test_stiff_servos_rest_against_stops_beside_contacts(precision, links, gate):
    check_rest(precision, "pgs", links, gate, contacts=True)


def check_rest(precision, solver, links, gate, contacts):
    built, state = servo_arm(solver, links, 1e2, contacts)
    for mass, stiffness in ((1.0, 1e2), (1.0, 1e4), (0.1, 1e4)):
        model = stiffened(built, "servo", stiffness, critical(stiffness, mass))
        model = dataclasses.replace(model, mass=mass * built.mass, inertia=mass * built.inertia)
        _, record = rollout(model, state, jnp.ones((240, links)))
        last = jax.tree.map(lambda leaf: leaf[-30:], record)
        place = jax.vmap(joint_position, (None, 0))(model, last)
        rate = jax.vmap(joint_velocity, (None, 0))(model, last)
        name = f"{mass:g} kg, {stiffness:g} N m/rad"
        gate(f"{name}: at the stop [rad]", np.asarray(place, float) - STOP, 1e-4)
        # Servo and stop push against each other; what rounds off of that turns a link.
        pressed = stiffness * (1.0 - STOP) / 60 / (mass * LENGTH**2 / 3)
        exact = {"float32": 5e-4, "float64": 1e-6}[str(precision)]
        gate(f"{name}: rate [rad/s]", rate, exact + 20 * np.finfo(precision).eps * pressed)


def test_build_warns_of_drives_too_stiff_for_small_steps():
    with pytest.warns(UserWarning, match=r"spring or servo of 'joint0' \(2 such joints\) is too stiff for small steps"):
        servo_arm("soft_step", 2, 1e4, contacts=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        servo_arm("soft_step", 2, 1e2, contacts=True)
        servo_arm("soft_step", 1, 1e4, contacts=True)
        servo_arm("soft_step", 2, 1e4)
