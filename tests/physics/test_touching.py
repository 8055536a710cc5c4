"""Mechanisms whose possible contacts are more than a matrix holds: those that touch feel all that hangs on them, too.

Closed forms: statics, dynamics.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Compound, Fixed, Hinge, SceneBuilder, Sphere, contact_forces, rollout, step
from mathota_jax.constraints import mechanism_layout
from mathota_jax.state import Flag
from tests.physics.test_mechanism_contacts import LIGHT, carry_a_ball, derivatives_of_way, leg, on_ground, stand
from tests.scenes import DOWN, GRAVITY, humanoid, quadruped, stiffened, undamped


def close(**changes):
    """Every pair that can be is left to the broadphase."""
    return undamped(dt=1 / 60, broadphase="all_pairs", **changes)


def on_slab(friction=0.5):
    """Like the plane, but its contacts are found by the broadphase."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Box((3.0, 0.5, 3.0)), static=True, position=(0, -0.5, 0), friction=friction, name="slab")
    return builder


def takes_contacts(model):
    return model.scene.broadphase is not None and mechanism_layout.takes_contacts(model.scene)


@pytest.mark.slow
@pytest.mark.parametrize("ground", ["plane", "slab"])
def test_a_leg_carries_a_free_ball(precision, ground, gate):
    """Foot on the ground, ball on a plate: pairs of one moving body and of two, of one point and of four."""
    builder = {"plane": on_ground, "slab": on_slab}[ground]()
    model, final = carry_a_ball(builder, close(), gate)
    assert takes_contacts(model)
    assert not final.flags


LENGTH = 0.4


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacrev, jax.jacfwd])
def test_derivatives_of_a_push(float64, gate, mode):
    """A motor of torque T on an arm of inertia I pushes a ball of mass m a distance L away: ``v = T L t / (I + m L^2)``.

    By the torque, the ball's mass and the arm's.
    """
    builder = SceneBuilder(gravity=(0, 0, 0))
    post = builder.add_body(Sphere(0.05), static=True, position=(0, 0, 0), collides=False)
    arm = builder.add_body(Box((0.02, LENGTH / 2, 0.02)), mass=0.2, position=(0, LENGTH / 2, 0), collides=False)
    tip = builder.add_body(Sphere(0.05), mass=0.01, position=(0, LENGTH, 0), friction=0.0)
    ball = builder.add_body(Sphere(0.05), mass=1.0, position=(0.1, LENGTH, 0), friction=0.0)
    builder.add_motor(builder.add_joint(Hinge(post, arm, anchor=(0, 0, 0), axis=(0, 0, -1))), kind="torque", limit=1.0)
    builder.add_joint(Fixed(arm, tip, (0, LENGTH, 0)))
    model, state = builder.build(undamped(dt=1 / 240, broadphase="all_pairs"))
    assert takes_contacts(model)
    steps, at = 24, jnp.asarray([0.01, 1.0, 0.2])

    def speed(values):
        torque, mass, arm_mass = values
        changed = dataclasses.replace(
            model,
            mass=model.mass.at[ball].set(mass).at[arm].set(arm_mass),
            inertia=model.inertia.at[arm].multiply(arm_mass / 0.2),
        )
        return rollout(changed, state, jnp.full((steps, 1), torque))[0].velocity[ball, 0]

    def truth(values):
        torque, mass, arm_mass = values
        inertia = arm_mass * (LENGTH**2 / 3 + 0.02**2 / 3) + 0.01 * (LENGTH**2 + 0.4 * 0.05**2)
        return torque * LENGTH * (steps / 240) / (inertia + mass * LENGTH**2)

    gate("derivatives / truth - 1", np.asarray(jax.jit(mode(speed))(at) / jax.grad(truth)(at)) - 1, 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_a_sled(float64, gate, mode):
    """``v t - mu g t^2 / 2`` by the speed, the coefficients of friction and gravity."""
    builder = on_slab(0.25)
    bodies = leg(builder, (0.2, 2.0, 5.0), (0.6, 0.02, 0.3), 2.0, 0.25)
    model, state = builder.build(close(velocity_iterations=40))
    assert takes_contacts(model)
    gate("derivatives / truth - 1", derivatives_of_way(model, state, bodies, 24 / 60, 24, mode) - 1, 1e-4)


def pincers(options):
    """Two arms on a pedestal whose round tips touch; on each hinge a motor, and a weak servo that keeps it where it is."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    base = builder.add_body(Box((0.1, 0.1, 0.1)), mass=50.0, position=(0, 0, 0), collides=False)
    post = builder.add_body(Sphere(0.05), static=True, position=(0, -1, 0), collides=False)
    builder.add_joint(Fixed(post, base, (0, -0.5, 0)))
    for side in (-1.0, 1.0):
        arm = builder.add_body(Box((0.02, 0.2, 0.02)), mass=0.2, position=(side * 0.05, 0.3, 0), collides=False)
        tip = builder.add_body(Sphere(0.05), mass=0.01, position=(side * 0.05, 0.5, 0), friction=0.3)
        hinge = builder.add_joint(Hinge(base, arm, anchor=(side * 0.05, 0.1, 0), axis=(0, 0, 1)))
        builder.add_joint(Fixed(arm, tip, (side * 0.05, 0.5, 0)))
        builder.add_motor(hinge, kind="torque", limit=10.0)
        builder.add_motor(hinge, kind="position", stiffness=10.0, damping=1.0, cap=1.0)
    return builder.build(options)


@pytest.mark.slow
def test_pincers_press_with_the_torque_of_their_motors(precision, gate):
    """Torques of 3 and -3 N m press tips 0.4 m from their hinges with 7.5 N; neither moves."""
    model, state = pincers(close())
    assert takes_contacts(model)
    # Torques about +z move the tips to -x: the left one is pressed to the right by a negative torque.
    actions = jnp.tile(jnp.asarray([-3.0, 0.0, 3.0, 0.0], state.position.dtype), (120, 1))
    final = jax.jit(lambda state: rollout(model, state, actions)[0])(state)
    pressed = np.abs(np.asarray(contact_forces(model, final), float)[:, 0]).max()
    gate("force / truth - 1", pressed / (3.0 / 0.4) - 1, 1e-3)
    gate("speed at the end [m/s]", np.asarray(final.velocity), 1e-4)
    gate("moved [m]", np.asarray(final.position - state.position, float), 1e-3)


def stand_still(model, state, mass, moved, gate):
    """For 120 steps, carried by the ground, without a flag."""
    final = stand(model, state)
    gate("moved [m]", np.asarray(final.position - state.position, float), moved)
    gate("speed at the end [m/s]", np.asarray(final.velocity), 1e-4)
    borne = np.abs(np.asarray(contact_forces(model, final), float)[:, 1]).sum()
    gate("borne by the ground / weight - 1", borne / (mass * GRAVITY) - 1, 1e-4)
    assert not final.flags


@pytest.mark.slow
@pytest.mark.parametrize("tiles", [0, 25])
def test_a_robot_that_may_touch_itself_stands(precision, tiles, gate):
    """It fell on its belly in a second: 36 pairs get a broadphase, where contacts were swept in turn with the joints."""
    model, state = quadruped("servo", undamped(dt=1 / 60), ignores_itself=tiles > 0, tiles=tiles)
    assert takes_contacts(model)
    stand_still(stiffened(model, "servo", 2000.0, 40.0), state, 22.4, 3e-4, gate)


@pytest.mark.slow
def test_a_humanoid_stands(precision, gate):
    """Rows for all of its 33 points on the plane leave too little room: swept in turn with its joints it sat down."""
    model, state = humanoid(undamped(dt=1 / 60))
    assert takes_contacts(model) and mechanism_layout.contact_places(model.scene).for_all
    stand_still(stiffened(model, "servo", 3000.0, 100.0), state, 52.4, 1e-4, gate)


def studded(options, friction=0.5, speed=0.0):
    """Blocks of 57 kg welded on a foot of 0.2 kg with 70 studs, of which the four at its corners touch the ground."""
    builder = on_ground(friction)
    turned = (1.0, 0.0, 0.0, 0.0)
    corners = [(x, 0.0, z) for x in (-0.6, 0.6) for z in (-0.3, 0.3)]
    inner = [(x, 0.01, z) for x in np.linspace(-0.5, 0.5, 11) for z in np.linspace(-0.25, 0.25, 6)]
    studs = Compound([(Sphere(0.02), (place, turned)) for place in (*corners, *inner)])
    bodies = leg(builder, LIGHT, (0.6, 0.02, 0.3), speed, friction, studs)
    return *builder.build(options), bodies


@pytest.mark.slow
def test_a_leg_stands_on_a_foot_of_many_points(precision, gate):
    """More rows than a matrix holds, without a broadphase. Where it has room for three points, a flag tells."""
    model, state, _ = studded(undamped(dt=1 / 60, broadphase="none", velocity_iterations=40))
    assert model.scene.broadphase is None and mechanism_layout.contact_places(model.scene).for_all
    final = stand(model, state)
    gate("moved [m]", np.asarray(final.position - state.position, float), 3e-4)  # all of it in the first steps
    gate("speed at the end [m/s]", np.asarray(final.velocity), 1e-5)
    borne = np.abs(np.asarray(contact_forces(model, final), float)[:, 1]).sum()
    gate("borne by the ground / weight - 1", borne / (57.2 * GRAVITY) - 1, 1e-5)
    assert not final.flags
    model, state, _ = studded(undamped(dt=1 / 60, broadphase="none", touching_capacity=3))
    assert mechanism_layout.contact_places(model.scene).count == 3
    assert stand(model, state).flags == Flag.CONTACT_OVERFLOW


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_a_sled_on_many_points(float64, gate, mode):
    model, state, bodies = studded(undamped(dt=1 / 60, broadphase="none", velocity_iterations=40), 0.25, 2.0)
    assert mechanism_layout.contact_places(model.scene).for_all
    gate("derivatives / truth - 1", derivatives_of_way(model, state, bodies, 24 / 60, 24, mode) - 1, 1e-4)


@pytest.mark.slow
def test_contacts_beyond_the_capacity_set_a_flag(gate):
    """Three balls on a plate without friction, of which two find a place: the deepest ones. World by world.

    Of four places a foot with four points takes two.
    """
    builder = on_slab(0.0)
    (foot,) = leg(builder, (0.2,), foot=(0.4, 0.02, 0.1), friction=0.0)
    plate = builder.add_body(Box((0.4, 0.02, 0.1)), mass=0.5, position=(0, 0.46, 0), friction=0.0)
    builder.add_joint(Fixed(foot, plate, (0, 0.44, 0)))
    balls = [builder.add_body(Sphere(0.1), mass=1.0, position=(x, 0.58, 0), friction=0.0) for x in (-0.3, 0.0, 0.3)]
    builder.ignore_collisions(plate, "slab")
    builder.ignore_collisions(balls)
    model, state = builder.build(close(touching_capacity=2))
    assert takes_contacts(model) and not model.scene.friction
    heights = jnp.asarray([[0.0, 0.0, 0.3], [-1e-4, -1e-5, -1e-4], [0.3, 0.3, 0.3], [0.3, 0.0, 0.0]])
    order = jnp.asarray([2, 0, 3, 1])
    lifted = jax.vmap(lambda h: dataclasses.replace(state, position=state.position.at[jnp.asarray(balls), 1].add(h)))
    run = jax.jit(jax.vmap(lambda state: step(model, state)))
    after, shuffled = run(lifted(heights)), run(lifted(heights[order]))
    np.testing.assert_array_equal(np.asarray(after.flags & Flag.CONTACT_OVERFLOW) > 0, [False, True, False, False])
    falling = np.asarray(after.velocity)[:, balls, 1] / (-GRAVITY / 60)
    gate("falls / truth", falling - [[0, 0, 1], [0, 1, 0], [1, 1, 1], [1, 0, 0]], 0.05)
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[order], y), after, shuffled)


def test_scenes_that_take_no_contacts_say_so():
    """Too many contacts may touch at a time for a dense matrix: they are swept, which a warning tells."""
    builder = on_ground()
    leg(builder, LIGHT)
    for number in range(20):
        builder.add_body(Box((0.1, 0.1, 0.1)), mass=1.0, position=(2.0 + number, 0.1, 0))
    with pytest.warns(UserWarning, match="the contacts of 'body1' to 'body4', 4 bodies with joints, are swept"):
        model, _ = builder.build(undamped())
    assert model.scene.broadphase is not None and not mechanism_layout.takes_contacts(model.scene)
