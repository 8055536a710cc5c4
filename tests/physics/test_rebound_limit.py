"""Rebounds that would gain energy give all of it back; any other bounce stays as it is.

A ball in a wedge hits one wall, which throws it back, while it slowly leaves the other, which does not. With outward normals
p and q, p.q = -0.8, and normal velocities -1 and 0.5 before the impact, Newton's restitution asks for 1 and 0 after it:
2.2 times the energy. Without rebound the ball stops, so that the share of the rebound that keeps the energy keeps the speed.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Distance, Fixed, Hinge, Plane, SceneBuilder, Sphere, contact_forces, energy, step
from mathota_jax.constraints import mechanism_layout
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.scenes import advance_worlds, repeat, rotation_matrix, undamped

BALL, DT, MASS = 2, 1 / 240, 2.0
BEFORE, FULL = np.array([-0.5, -1.0, 0.0]), np.array([4 / 3, 1.0, 0.0])
LIMITED = FULL * np.linalg.norm(BEFORE) / np.linalg.norm(FULL)
WALLS = (0.0, 1.0, 0.0), (0.6, -0.8, 0.0)


def wedge(solver="pgs", walls=WALLS, carried=(), roped=False, **options):
    """A ball; some of its mass is `carried` by balls in its centre, welded to it. If `roped`, others far away on a rope."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    for normal, restitution in zip(walls, (1.0, 0.0), strict=False):
        builder.add_body(Plane(normal=normal, offset=0.0), static=True, friction=0.0, restitution=restitution)
    place = (2.998, 0.999, 0)
    body = {"position": place, "velocity": BEFORE, "friction": 0.0, "restitution": 1.0}
    ball = builder.add_body(Sphere(1.0), mass=MASS - sum(carried), **body)
    for mass in carried:
        builder.add_joint(Fixed(ball, builder.add_body(Sphere(0.5), mass=mass, collides=False, **body), place))
    if options or roped:
        far = [builder.add_body(Sphere(1.0), mass=1.0, position=(place, place, 0)) for place in (100.0, 200.0)]
        if roped:
            builder.add_joint(Distance(*far, (100.0, 100.0, 0), lengths=(0.0, 500.0)))
    return builder.build(undamped(dt=DT, solver=solver, velocity_iterations=80, **options))


@pytest.mark.parametrize(
    ("solver", "carried", "options"),
    [
        ("pgs", (), {}),
        ("converged", (), {}),
        pytest.param("pgs", (1.98,), {}, marks=pytest.mark.slow),
        pytest.param("pgs", (0.4, 0.3, 0.3), {"broadphase": "all_pairs"}, marks=pytest.mark.slow),
        pytest.param("pgs", (0.4, 0.3, 0.3), {"roped": True}, marks=pytest.mark.slow),
    ],
    ids=["pgs", "converged", "welded", "welded, beside a broadphase", "welded and swept"],
)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.filterwarnings("ignore:build")
def test_energy_is_kept(precision, gate, solver, carried, options):
    model, state = wedge(solver, carried=carried, **options)
    assert mechanism_layout.takes_contacts(model.scene) == bool(carried and "roped" not in options)
    final = step(model, state)
    tolerance = 1e-4 if precision == "float32" else 1e-9
    gate("velocity after the impact [m/s]", np.asarray(final.velocity[BALL], float) - LIMITED, tolerance)
    push = np.asarray(contact_forces(model, final), float).sum(0) * DT
    gate("impulse [kg m/s]", push - MASS * (LIMITED - BEFORE), 2 * MASS * tolerance)


def test_other_worlds_bounce_as_ever():
    """To the bit; that ball leaves the first wall alone with its whole speed."""
    model, state = wedge()
    models, states = repeat(model, 2), repeat(state, 2)
    free = states.position.at[:, BALL, 0].set(10.0)
    alone = advance_worlds(models, dataclasses.replace(states, position=free), 1)
    beside = advance_worlds(models, dataclasses.replace(states, position=free.at[0].set(state.position)), 1)
    np.testing.assert_array_equal(np.asarray(alone.velocity[1, BALL]), [-0.5, 1.0, 0.0])
    for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(beside), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[1], np.asarray(b)[1])


@pytest.mark.parametrize(
    ("carried", "differentiate"),
    [
        ((), jax.jacfwd),
        ((), jax.jacrev),
        pytest.param((1.0,), jax.jacfwd, marks=pytest.mark.slow),
        pytest.param((1.0,), jax.jacrev, marks=pytest.mark.slow),
    ],
    ids=["free-jacfwd", "free-jacrev", "welded-jacfwd", "welded-jacrev"],
)
def test_derivatives(float64, gate, differentiate, carried):
    """The speed stays, ``|v|``; the direction is that of the full rebound, ``F v``: both change with ``v``."""
    model, state = wedge(carried=carried)

    def after(velocity):
        moving = state.velocity.at[BALL:].set(velocity)
        return step(model, dataclasses.replace(state, velocity=moving)).velocity[BALL]

    full = np.array([[0.0, -4 / 3, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    speed, rebound = np.linalg.norm(BEFORE), np.linalg.norm(FULL)
    across = np.eye(3) - np.outer(FULL, FULL) / rebound**2
    truth = np.outer(FULL / rebound, BEFORE / speed) + speed / rebound * across @ full
    # Along the edge of the wedge nothing is cut.
    truth[2, 2] = 1.0
    gate("d velocity after / d velocity before", differentiate(after)(jnp.asarray(BEFORE)) - truth, 1e-6)


@pytest.mark.parametrize("restitution", [0.5, 1.0])
@pytest.mark.parametrize("friction", slow_but((0.5, 0.7), (0.0, 0.5, 0.7)))
def test_a_double_pendulum_strikes_the_ground(float64, gate, restitution, friction):
    """T. R. Kane, "A dynamics puzzle", Stanford Mechanics Alumni Club Newsletter, 1984: its energy must not grow.

    Two rods of 1 m and 1 kg, at 20 and 30 degrees, turning at -0.1 and -0.2 rad/s, their end on the ground. Without friction
    the impulse takes ``(1 - e^2) v^2 / (2 J M^-1 J^T)``, from the mass matrix in the two angles.
    """
    angles, rates = np.radians([20.0, 30.0]), np.array([-0.1, -0.2])
    builder = SceneBuilder(gravity=(0, 0, 0))
    ends = np.cumsum([[0.0, 0.0], *([np.sin(angle), -np.cos(angle)] for angle in angles)], axis=0)
    ground = builder.add_body(Plane((0, 1, 0), ends[2, 1]), static=True, friction=friction, restitution=restitution)
    speed, last = np.zeros(2), ground
    for rod, (angle, rate) in enumerate(zip(angles, rates, strict=True)):
        along = np.array([np.cos(angle), np.sin(angle)]) * rate
        place, turn = (ends[rod] + ends[rod + 1]) / 2, (np.cos(angle / 2), 0, 0, np.sin(angle / 2))
        motion = {"velocity": (*speed + along / 2, 0), "angular_velocity": (0, 0, rate)}
        body = builder.add_body(
            Box((1e-4, 0.5, 1e-4)), mass=1.0, position=(*place, 0), orientation=turn, friction=friction,
            restitution=restitution, collides=rod == 1, **motion,
        )  # fmt: skip
        builder.add_joint(Hinge(last, body, (*ends[rod], 0), (0, 0, 1)))
        speed, last = speed + along, body
    model, state = builder.build(undamped(dt=1e-5, velocity_iterations=400))
    assert mechanism_layout.takes_contacts(model.scene)
    after, before = (float(energy(model, of)) for of in (step(model, state), state))
    assert speed[1] < 0, "the end comes down"
    if friction:
        assert after <= before * (1 + 1e-6)
        if restitution == 1:
            gate("energy / before - 1", after / before - 1, 1e-4)
    else:
        coupling = np.cos(angles[0] - angles[1]) / 2
        response = np.linalg.inv([[4 / 3, coupling], [coupling, 1 / 3]])
        lift = np.sin(angles)
        truth = (1 - restitution**2) * speed[1] ** 2 / (2 * lift @ response @ lift)
        gate("energy lost / that before - truth", (before - after - truth) / before, 1e-3)


def test_a_cube_strikes_the_ground_with_a_corner(float64, gate):
    """One contact with friction: it rebounds by Newton's law, or where that would gain energy, keeps it."""
    count, half, friction = 200, 0.1, 1.0
    random = np.random.default_rng(0)
    turns = random.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    axes = np.array([rotation_matrix(turn) for turn in turns])
    arms = -half * np.sign(axes[:, 1, :])
    arms = np.einsum("nij,nj->ni", axes, arms)
    velocity, spin = random.normal(size=(2, count, 3)) * 3
    velocity[:, 1] = -np.abs(velocity[:, 1])
    builder = SceneBuilder(gravity=(0, 0, 0))
    builder.add_body(Plane((0, 1, 0)), static=True, friction=friction, restitution=0.9)
    builder.add_body(Box(3 * (half,)), mass=1.0, position=(0, 1, 0), friction=friction, restitution=0.9)
    model, state = builder.build(undamped(dt=1e-5, velocity_iterations=2000))

    states = repeat(state, count)
    begin = dataclasses.replace(
        states,
        position=states.position.at[:, 1, 1].set(-arms[:, 1] - 1e-9),
        orientation=states.orientation.at[:, 1].set(turns),
        velocity=states.velocity.at[:, 1].set(velocity),
        angular_velocity=states.angular_velocity.at[:, 1].set(spin),
    )
    end = advance_worlds(repeat(model, count), begin, 1)

    def energy_and_approach(of):
        linear, angular = np.asarray(of.velocity)[:, 1], np.asarray(of.angular_velocity)[:, 1]
        kinetic = (linear**2).sum(1) / 2 + (2 / 3 * half**2) * (angular**2).sum(1) / 2
        return kinetic, -(linear + np.cross(angular, arms))[:, 1]

    (before, approach), (after, left) = energy_and_approach(begin), energy_and_approach(end)
    strikes = approach > 0.1
    by_law = np.abs(left / approach + 0.9) < 1e-3
    gain = after / before - 1
    gate("gain of energy", gain[strikes].max(), 1e-9)
    gate("energy where the law does not hold / before - 1", gain[strikes & ~by_law], 1e-9)
    share = (strikes & ~by_law).sum() / strikes.sum()
    assert 0.02 < share < 0.3, f"{share} of the impacts are cut"


def test_only_where_rebounds_may_gain():
    assert wedge()[0].scene.rebounds_may_gain
    assert not wedge(walls=WALLS[:1])[0].scene.rebounds_may_gain
    assert wedge(walls=WALLS[:1], carried=(1.0,))[0].scene.rebounds_may_gain
