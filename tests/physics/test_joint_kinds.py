"""Ball and socket, fixed and distance joints, and gaps that close, against closed forms; the mechanisms share a world."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mathota_jax import (
    BallAndSocket,
    Box,
    Compound,
    Distance,
    Fixed,
    Hinge,
    SceneBuilder,
    Slider,
    Sphere,
    joint_position,
)
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.scenes import (
    DOWN,
    GRAVITY,
    angle_between,
    axis_angle,
    invariants,
    motion,
    record_worlds,
    repeat,
    rotation_matrix,
    undamped,
)

DT, STEPS = 1 / 240, 480
TIME = DT * (1 + np.arange(STEPS))
ROD, CONE = 0.5, np.radians(40)
CONICAL_RATE = np.sqrt(GRAVITY / (ROD * np.cos(CONE)))
ROPE, THROW = 1.0, np.array([1.5, 2.0, 0.5])
SWING, TWIST = 0.6, (-0.4, 0.7)
SPIN, DRIFT = np.array([1.0, -2.0, 1.5]), np.array([0.3, 0.5, -0.2])
HALF_A, HALF_B = (0.1, 0.2, 0.15), (0.2, 0.1, 0.25)


def two_boxes():
    """Positions relative to the common centre of mass, and masses, of two boxes of density 100."""
    volumes = 8 * np.array([np.prod(HALF_A), np.prod(HALF_B)])
    place = np.array([[0.0, 0.0, 0.0], [0.35, 0.1, -0.05]])
    return place - volumes @ place / volumes.sum(), 100 * volumes


def pendulums(builder):
    """Conical pendulum, rod, rope, and balls that swing and twist onto their stops, all about the origin."""
    bodies = {}

    post = builder.add_body(Sphere(0.02), static=True, collides=False)

    def ball(name, place, shape=None, **motion):
        bodies[name] = builder.add_body(shape or Sphere(0.05), mass=1.3, position=place, collides=False, **motion)
        return bodies[name]

    arm = ROD * np.array([np.sin(CONE), -np.cos(CONE), 0.0])
    turning = {"velocity": np.cross((0, CONICAL_RATE, 0), arm), "angular_velocity": (0, CONICAL_RATE, 0)}
    builder.add_joint(BallAndSocket(post, ball("cone", arm, Sphere(0.25), **turning), (0, 0, 0)), name="cone")
    builder.add_joint(Distance(post, ball("rod", (ROD, 0, 0)), (0, 0, 0)), name="rod")
    builder.add_joint(
        Distance(post, ball("rope", (0.1, 0, 0), velocity=THROW), (0, 0, 0), lengths=(0.0, ROPE)), name="rope"
    )
    for name, options, spin in (
        ("swing", {"swing": SWING}, (0, 0, 3.5)),
        ("twist", {"twist": TWIST}, (0, 3.0, 0)),
        ("dry", {"friction": 0.05}, (0, 2.0, 0)),
        ("viscous", {"damping": 0.05}, (0, 2.0, 0)),
    ):
        child = ball(name, (0, -ROD, 0), Box((0.2, 0.2, 0.2)), **{"angular_velocity": spin} | _swinging(spin))
        builder.add_joint(BallAndSocket(post, child, (0, 0, 0), axis=(0, -1, 0), **options), name=name)
    return bodies


def _swinging(spin):
    return {"velocity": np.cross(spin, (0, -ROD, 0))}


@functools.cache
def recorded(precision):
    """The motion of the mechanisms under gravity, for 2 s."""
    builder = SceneBuilder(gravity=DOWN)
    bodies = pendulums(builder)
    model, state = builder.build(undamped(dt=DT, velocity_iterations=40))

    def observe(model, state):
        return {**motion(model, state), "coordinate": joint_position(model, state)}

    _, record = record_worlds(repeat(model, 1), repeat(state, 1), STEPS, observe)
    record = {name: np.asarray(values, dtype=float)[:, 0] for name, values in record.items()}
    return model, bodies, record


def of_body(precision, name):
    model, bodies, record = recorded(str(precision))
    body, joint = bodies[name], model.scene.joint_names.index(name)
    leaves = {"mass": model.mass[body : body + 1], "inertia": model.inertia[body : body + 1]}
    moving = [record[key][:, body : body + 1] for key in ("position", "orientation", "velocity", "angular_velocity")]
    energy = invariants(leaves, *moving)[0] + float(model.mass[body]) * GRAVITY * moving[0][:, 0, 1]
    return {
        "place": moving[0][:, 0],
        "rotation": rotation_matrix(moving[1][:, 0]),
        "velocity": moving[2][:, 0],
        "spin": moving[3][:, 0],
        "coordinate": record["coordinate"][:, joint],
        "energy": energy,
        "inertia": np.asarray(model.inertia, dtype=float)[body],
    }


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_conical_pendulum(precision, gate):
    """It turns at ``sqrt(g / (l cos a))`` and keeps its height."""
    found = of_body(precision, "cone")
    angle = np.unwrap(np.arctan2(-found["place"][:, 2], found["place"][:, 0]))
    gate("angle after 2 s / truth - 1", angle[-1] / (CONICAL_RATE * TIME[-1]) - 1, 1e-3)
    gate("height / truth - 1", found["place"][:, 1] / (-ROD * np.cos(CONE)) - 1, 1e-3)
    gate("length / truth - 1", np.linalg.norm(found["place"], axis=1) / ROD - 1, 1e-4)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_rod_is_a_mathematical_pendulum(precision, gate):
    """The ball on a rod does not turn: ``a'' = -(g / l) sin a`` from a quarter turn."""
    found = of_body(precision, "rod")
    angle = np.unwrap(np.arctan2(found["place"][:, 0], -found["place"][:, 1]))
    truth = solve_ivp(
        lambda t, y: [y[1], -GRAVITY / ROD * np.sin(y[0])],
        (0, TIME[-1]),
        [np.pi / 2, 0],
        rtol=1e-10,
        atol=1e-10,
        t_eval=TIME,
    ).y[0]
    gate("angle [rad]", angle - truth, 5e-3)
    gate("length / truth - 1", found["coordinate"] / ROD - 1, 1e-4)
    gate("spin [rad/s]", found["spin"], 1e-6)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_rope_is_slack_then_taut(precision, gate):
    """A parabola until the rope is taut; then it takes the speed along itself, once, and is never longer."""
    found = of_body(precision, "rope")
    flight = np.array([0.1, 0, 0]) + THROW * TIME[:, None] + 0.5 * np.array(DOWN) * TIME[:, None] ** 2
    taut = int(np.argmax(np.linalg.norm(flight, axis=1) > ROPE))
    assert 20 < taut < 200
    limit = {"float64": 1e-12, "float32": 2e-5}[str(precision)]
    gate("off the parabola while slack [m]", (found["place"] - flight)[: taut - 1], limit)
    gate("longest length / rope - 1, if positive", max(0.0, found["coordinate"].max() / ROPE - 1), 1e-4)
    assert found["coordinate"][taut + 10] > 0.9 * ROPE

    low, high = TIME[taut] - DT, TIME[taut]
    for _ in range(60):
        middle = 0.5 * (low + high)
        place = np.array([0.1, 0, 0]) + THROW * middle + 0.5 * np.array(DOWN) * middle**2
        low, high = (middle, high) if np.linalg.norm(place) < ROPE else (low, middle)
    velocity = THROW + np.array(DOWN) * middle
    loss = 0.5 * 1.3 * (velocity @ place / ROPE) ** 2
    gate("energy before / start - 1", found["energy"][taut - 2] / found["energy"][0] - 1, 1e-4)
    gate("energy taken / truth - 1", (found["energy"][taut - 2] - found["energy"][taut + 1]) / loss - 1, 0.02)
    gate("energy gained at any step / loss", max(0.0, np.diff(found["energy"]).max()) / loss, 2e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_swing_limit_holds(precision, gate):
    found = of_body(precision, "swing")
    swing = np.arccos(np.clip(found["rotation"][:, 1, 1], -1, 1))
    assert swing.max() > 0.99 * SWING, "it never reaches the cone"
    gate("beyond the cone [rad]", max(0.0, swing.max() - SWING), 1e-3)
    gate("energy gained at any step / start's kinetic", max(0.0, np.diff(found["energy"]).max()) / 2.0, 1e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_twist_limits_hold(precision, gate):
    """The box turns about the vertical; at the stop it stays, since stops have no restitution."""
    found = of_body(precision, "twist")
    twist = np.arctan2(found["rotation"][:, 0, 2], found["rotation"][:, 0, 0])
    # The axis of the joint points down: a turn of +3 rad/s about the vertical is a twist of -3.
    gate("coordinate + angle about the vertical", found["coordinate"] + twist, 1e-4)
    gate("at the stop at the end [rad]", found["coordinate"][-1] - TWIST[0], 1e-4)
    gate("beyond the stop [rad]", max(0.0, TWIST[0] - found["coordinate"].min()), 1e-4)
    gate("spin at the end [rad/s]", found["spin"][-1], 1e-3)
    early = TIME < 0.12
    gate("free until the stop [rad]", (found["coordinate"] + 3.0 * TIME)[early], 1e-4)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_friction_of_a_ball_stops_its_spin(precision, gate):
    """A constant torque: ``w = w0 - F t / I`` until it stops."""
    found = of_body(precision, "dry")
    rate = 0.05 / found["inertia"][1]
    truth = np.maximum(2.0 - rate * TIME, 0.0)
    assert 0 < np.argmax(truth == 0) < STEPS
    gate("spin [rad/s]", found["spin"][:, 1] - truth, 1e-4)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_damping_of_a_ball_decays_its_spin(precision, gate):
    found = of_body(precision, "viscous")
    truth = 2.0 * np.exp(-0.05 / found["inertia"][1] * TIME)
    gate("spin / truth - 1", found["spin"][:, 1] / truth - 1, 1e-4)


@pytest.mark.slow
def test_boxes_joined_fly_as_one_body(float64, gate):
    """A tumbling pair against one compound body of the same density, which is integrated on its own."""
    offset, mass = two_boxes()
    builder = SceneBuilder(gravity=(0, 0, 0))
    halves = (HALF_A, HALF_B)
    pair = [
        builder.add_body(
            Box(half), mass=m, position=at, velocity=DRIFT + np.cross(SPIN, at), angular_velocity=SPIN, collides=False
        )
        for half, m, at in zip(halves, mass, offset, strict=True)
    ]
    builder.add_joint(Fixed(*pair))
    upright = (1.0, 0.0, 0.0, 0.0)
    builder.add_body(
        Compound([(Box(half), (tuple(at), upright)) for half, at in zip(halves, offset, strict=True)]),
        density=100.0,
        velocity=DRIFT,
        angular_velocity=SPIN,
        collides=False,
    )
    model, state = builder.build(undamped(dt=DT, velocity_iterations=40))
    _, record = record_worlds(repeat(model, 1), repeat(state, 1), STEPS, motion)
    record = {key: np.asarray(value)[:, 0] for key, value in record.items()}
    leaves = {"mass": model.mass[:2], "inertia": model.inertia[:2]}
    order = ("position", "orientation", "velocity", "angular_velocity")
    energy, linear, angular = invariants(leaves, *(record[key][:, :2] for key in order))
    center = mass @ record["position"][:, :2].swapaxes(0, 1).reshape(2, -1) / mass.sum()
    gate("centre of mass [m]", center.reshape(-1, 3) - DRIFT * TIME[:, None], 1e-10)
    gate("linear momentum / truth - 1", linear / (mass.sum() * DRIFT) - 1, 1e-10)
    gate("angular momentum, relative", (angular - angular[0]) / np.linalg.norm(angular[0]), 1e-3)
    gate("energy / start - 1", energy / energy[0] - 1, 1e-3)
    size = np.linalg.norm(offset[1] - offset[0])
    turned = rotation_matrix(record["orientation"])
    gap = record["position"][:, 1] - record["position"][:, 0] - turned[:, 0] @ (offset[1] - offset[0])
    gate("gap / distance", gap / size, 1e-4)
    gate("angle between the boxes [rad]", angle_between(record["orientation"][:, 0], record["orientation"][:, 1]), 1e-4)
    gate("angle to the compound [rad]", angle_between(record["orientation"][:, 0], record["orientation"][:, 2]), 5e-3)


GAPS = {
    "ball": lambda a, b, at: BallAndSocket(a, b, at),
    "hinge": lambda a, b, at: Hinge(a, b, at, (0, 0, 1)),
    "slider": lambda a, b, at: Slider(a, b, at, (1, 0, 0)),
    "fixed": lambda a, b, at: Fixed(a, b, at),
    "rod": lambda a, b, at: Distance(a, b, at, lengths=0.2),
    "rope": lambda a, b, at: Distance(a, b, at, lengths=(0.0, 0.1)),
    "stop": lambda a, b, at: Slider(a, b, at, (0, 1, 0), limits=(0.0, 0.02)),
}


@functools.cache
def gaps_closed(precision):
    """Pairs at rest in space, pulled apart by 0.1 m and turned by 0.1 rad after they were joined; 2 s."""
    builder = SceneBuilder(gravity=(0, 0, 0))
    shifts, turns = [np.zeros((0, 3))], []
    for number, make in enumerate(GAPS.values()):
        first = builder.add_body(Box((0.2, 0.05, 0.1)), mass=1.0, position=(3 * number, 0, 0), collides=False)
        second = builder.add_body(Box((0.1, 0.1, 0.2)), mass=2.0, position=(3 * number + 0.3, 0, 0), collides=False)
        builder.add_joint(make(first, second, (3 * number + 0.2, 0, 0)))
        shifts.append(np.array([[0, 0, 0], [0.0, 0.1, 0.0]]))
        turns += [(1.0, 0.0, 0.0, 0.0), axis_angle((1, 1, 1), 0.1)]
    model, state = builder.build(undamped(dt=1 / 60))
    gap = state.position + jnp.asarray(np.concatenate(shifts), state.position.dtype)
    state = dataclasses.replace(state, position=gap, orientation=jnp.asarray(np.stack(turns), state.orientation.dtype))

    def observe(model, state):
        return {**motion(model, state), "coordinate": joint_position(model, state)}

    _, record = record_worlds(repeat(model, 1), repeat(state, 1), 120, observe)
    return model, {name: np.asarray(values, dtype=float)[:, 0] for name, values in record.items()}


@pytest.mark.parametrize("name", GAPS)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_gap_closes_without_gaining_energy(precision, name, gate):
    """The speed of the correction is gone when the gap is: nothing is left of it, in no direction."""
    model, record = gaps_closed(str(precision))
    number = list(GAPS).index(name)
    pair = slice(2 * number, 2 * number + 2)
    leaves = {"mass": model.mass[pair], "inertia": model.inertia[pair]}
    order = ("position", "orientation", "velocity", "angular_velocity")
    energy, linear, _ = invariants(leaves, *(record[key][:, pair] for key in order))
    (near, far), rotation = record["position"][-1, pair], rotation_matrix(record["orientation"][-1, pair])
    apart = (far - rotation[1] @ (0.1, 0, 0)) - (near + rotation[0] @ (0.2, 0, 0))
    coordinate = record["coordinate"][-1, number]
    left = {
        "slider": rotation[0].T[1:] @ apart,
        "rod": coordinate - 0.2,
        "rope": max(coordinate - 0.1, 0.0),
        "stop": max(coordinate - 0.02, 0.0),
    }.get(name, apart)
    gate("gap left / gap", np.linalg.norm(left) / 0.1, 1e-3)
    if name in ("slider", "fixed", "stop"):
        gate("turn left / turn", angle_between(*record["orientation"][-1, pair]) / 0.1, 1e-3)
    # The energy to close the gap by its own speed in a tenth of a second, the time that the correction takes.
    scale = 0.5 * (1 * 2 / 3) * (0.1 / 0.1) ** 2
    gate("kinetic energy left / energy of the motion that closed it", energy[-1] / scale, 1e-2)
    gate("linear momentum [kg m/s]", linear, 1e-5)
