"""Derivatives of jointed motion against closed forms, and never NaN."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import (
    BallAndSocket,
    Box,
    Distance,
    Fixed,
    Hinge,
    SceneBuilder,
    Slider,
    Sphere,
    joint_forces,
    joint_position,
    step,
)
from tests.marks import slow_but
from tests.scenes import undamped

DT, STEPS = 1 / 240, 120
HALF, MASS = (0.05, 0.25, 0.04), 2.0
CENTRAL = MASS * (HALF[0] ** 2 + HALF[1] ** 2) / 3
ARM, STIFFNESS, DAMPING, REST = 0.1, 3.0, 0.2, 0.4
SERVO_STIFFNESS, SERVO_DAMPING, GEAR, ACTION = 5.0, 0.3, 0.5, 0.7
DURATION = DT * STEPS


def angle(stiffness, damping, rest, arm, central=CENTRAL, duration=DURATION):
    """Of a sprung pendulum in space at the end, from rest at 0."""
    inertia = central + MASS * arm**2
    half = damping / (2 * inertia)
    omega = np.sqrt(stiffness / inertia - half**2)
    phase = omega * duration
    return rest * (1 - np.exp(-half * duration) * (np.cos(phase) + half / omega * np.sin(phase)))


def derivatives(function, arguments):
    """Central differences of a closed form."""
    found = []
    for index, value in enumerate(arguments):
        shifted = [[*arguments[:index], value + sign * 1e-5, *arguments[index + 1 :]] for sign in (1, -1)]
        found.append((function(*shifted[0]) - function(*shifted[1])) / 2e-5)
    return found


@pytest.mark.parametrize("mode", slow_but((jax.jacfwd,), (jax.jacfwd, jax.jacrev)))
def test_pendulum_by_its_parameters(float64, gate, mode):
    """A pendulum on a spring and one on a servo: both angles at 0.5 s."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    for options in ({"stiffness": STIFFNESS, "damping": DAMPING, "rest": REST}, {}):
        rod = builder.add_body(Box(HALF), mass=MASS, position=(0, -ARM, 0), collides=False)
        joint = builder.add_joint(Hinge(post, rod, (0, 0, 0), (0, 0, 1), **options))
    builder.add_motor(joint, kind="position", stiffness=SERVO_STIFFNESS, damping=SERVO_DAMPING, gear=GEAR)
    model, state = builder.build(undamped(dt=DT, velocity_iterations=30))

    def final(sprung, servo, cap):
        """Angles by stiffness, damping, rest and arm of the one, by those and the gear of the other, and by its cap."""
        changed = dataclasses.replace(
            model,
            joint_stiffness=model.joint_stiffness.at[0].set(sprung[0]),
            joint_damping=model.joint_damping.at[0].set(sprung[1]),
            joint_rest=model.joint_rest.at[0].set(sprung[2]),
            joint_anchor_child=model.joint_anchor_child.at[:, 1].set(jnp.stack([sprung[3], servo[3]])),
            motor_stiffness=servo[:1],
            motor_damping=servo[1:2],
            motor_gear=servo[4:],
            motor_cap=cap,
        )
        # The bodies hang where their anchors are.
        start = dataclasses.replace(state, position=state.position.at[1:].set(-changed.joint_anchor_child))
        action = servo[2:3]
        last, _ = jax.lax.scan(lambda s, _: (step(changed, s, action), None), start, None, length=STEPS)
        return (joint_position(changed, last),) * 2

    on_spring = np.array([STIFFNESS, DAMPING, REST, ARM])
    on_servo = np.array([SERVO_STIFFNESS, SERVO_DAMPING, ACTION, ARM, GEAR])
    slopes = jax.jit(mode(final, (0, 1, 2), has_aux=True))
    (by_spring, by_servo, by_cap), angles = slopes(on_spring, on_servo, model.motor_cap)
    sprung, servo = (STIFFNESS, DAMPING, REST, ARM), (SERVO_STIFFNESS, SERVO_DAMPING, GEAR * ACTION, ARM)
    gate("angle on the spring / truth - 1", angles[0] / angle(*sprung) - 1, 1e-4)
    gate("angle on the servo / truth - 1", angles[1] / angle(*servo) - 1, 1e-4)
    to_gear = np.array([1, 1, 1 / GEAR, 1])  # the target is the action times the gear
    for place, arguments, found in (("spring", sprung, by_spring[0]), ("servo", servo, by_servo[1, :4] * to_gear)):
        truths = derivatives(angle, arguments)
        for name, value, slope, truth in zip(
            ("stiffness", "damping", "rest", "anchor"), arguments, found, truths, strict=True
        ):
            # Relative to the angle for a relative change of the parameter: some derivatives are nearly zero.
            gate(f"{place}: d angle / d {name}", (slope - truth) * value / angle(*arguments), 5e-4)
    gate("d angle / d action and gear agree", by_servo[1, 2] / GEAR - by_servo[1, 4] / ACTION, 1e-9)
    gate("the other pendulum", np.concatenate([by_spring[1], by_servo[0]]), 1e-12)
    assert not np.any(np.asarray(by_cap)), "the cap is far"


@pytest.mark.parametrize("solver", slow_but(("pgs",), ("pgs", "converged")))
@pytest.mark.parametrize("mode", slow_but((jax.jacfwd,), (jax.jacfwd, jax.jacrev)))
def test_a_motor_at_its_cap(float64, gate, mode, solver):
    """The rate after a step from rest is ``cap dt / I``: by the cap it grows by ``dt / I``, by the step by ``cap / I``.

    No other row changes with a cap, and the row of a motor at its cap has no slope: the system took it for nothing.
    """
    cap, dt = 2.0, 1 / 100
    builder = SceneBuilder(gravity=(0, 0, 0))
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    joint = builder.add_joint(Hinge(post, builder.add_body(Box(HALF), mass=MASS, collides=False), (0, 0, 0), (0, 0, 1)))
    builder.add_motor(joint, kind="velocity", cap=cap, gear=50.0)
    model, state = builder.build(undamped(dt=dt, solver=solver))

    def rate(cap, dt):
        changed = dataclasses.replace(model, motor_cap=cap[None], dt=dt)
        return step(changed, state, jnp.ones(1)).angular_velocity[1, 2]

    by_cap, by_dt = jax.jit(mode(rate, (0, 1)))(jnp.asarray(cap), jnp.asarray(dt))
    gate("by the cap / truth - 1", by_cap / (dt / CENTRAL) - 1, 1e-8)
    gate("by the step / truth - 1", by_dt / (cap / CENTRAL) - 1, 1e-8)


def every_joint():
    """Each kind with all that it can have, at rest at its built pose: at stops, slack springs, coincident axes."""
    builder = SceneBuilder()
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    options = {"friction": 0.1, "damping": 0.2, "armature": 0.5}

    def body():
        return builder.add_body(Box(HALF), mass=MASS, position=(0.3, 0, 0), collides=False)

    hinge = builder.add_joint(Hinge(post, body(), (0, 0, 0), (0, 0, 1), limits=(0, 1), stiffness=1.0, **options))
    slider = builder.add_joint(Slider(post, body(), (0, 0, 0), (1, 0, 0), limits=(0, 1), **options))
    builder.add_joint(
        BallAndSocket(post, body(), (0, 0, 0), (0, 1, 0), swing=0.0, twist=(0, 1), friction=0.1, damping=0.1)
    )
    builder.add_joint(Fixed(post, body()))
    builder.add_joint(Distance(post, body(), (0, 0, 0)))
    rope = builder.add_joint(Distance(post, body(), (0.3, 0, 0), lengths=(0, 1), stiffness=2.0, **options))
    for joint in (hinge, slider, rope):
        builder.add_motor(joint, kind="velocity", cap=1.0)
        builder.add_motor(joint, kind="position", stiffness=4.0 * MASS * 60**2, damping=0.0)
    return builder.build()


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float32"], indirect=True)
def test_no_derivative_is_nan(precision):
    model, state = every_joint()

    def loss(model, state, action):
        after = step(model, step(model, state, action), action)
        force, torque = joint_forces(model, after)
        return sum(jnp.sum(x) for x in (after.position, after.orientation, after.velocity, force, torque))

    gradients = jax.jit(jax.grad(loss, argnums=(0, 1, 2), allow_int=True))(model, state, jnp.zeros(6))
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradients):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.all(np.isfinite(np.asarray(leaf))), jax.tree_util.keystr(path)
