"""Springs, rotors, dry friction, motors and reaction forces of joints against closed forms.

Every mechanism is a body of its own on a static post; all share one world, and two worlds differ in their time step.
"""

import functools

import numpy as np
import pytest

from mathota_jax import (
    Box,
    Distance,
    Fixed,
    Hinge,
    SceneBuilder,
    Slider,
    Sphere,
    joint_forces,
    joint_position,
    joint_velocity,
)
from tests.marks import QUICK_IN_FLOAT64
from tests.scenes import DOWN, GRAVITY, record_worlds, stack, undamped, with_dt

STEPS, STEP_SIZES = 480, (1 / 240, 1 / 120)
MASS, HALF, REST = 2.0, (0.1, 0.15, 0.2), 0.3
INERTIA = MASS * (HALF[0] ** 2 + HALF[2] ** 2) / 3  # about the y axis
WEIGHT = MASS * GRAVITY
ACROSS, UP = (1, 0, 0), (0, 1, 0)
LENGTH, RELEASE, LEVER = 0.5, np.radians(60), 0.4

# name: axis, options of the joint, motor with its action, initial rate. Sliders move along x or y, hinges turn about y.
SLIDERS = {
    "spring": (ACROSS, {"stiffness": 50.0, "rest": REST}, None, 0.0),
    "damped": (ACROSS, {"stiffness": 50.0, "damping": 3.0, "rest": REST}, None, 0.0),
    "overdamped": (ACROSS, {"stiffness": 200.0, "damping": 400.0, "rest": REST}, None, 0.0),
    "critical": (ACROSS, {"stiffness": 200.0, "damping": 40.0, "rest": REST}, None, 0.0),
    "rigid": (ACROSS, {"stiffness": 1e9, "rest": REST}, None, 0.0),
    "rigid and damped": (ACROSS, {"stiffness": 1e9, "damping": 1e7, "rest": REST}, None, 0.0),
    "geared": (ACROSS, {"stiffness": 50.0, "armature": 6.0, "rest": REST}, None, 0.0),
    "loaded": (UP, {"stiffness": 400.0, "damping": 40.0}, None, 0.0),
    "brake": (ACROSS, {"friction": 4.0}, None, 1.5),
    "slips": (UP, {"friction": 5.0}, None, 0.0),
    "sticks": (UP, {"friction": 30.0}, None, 0.0),
    "stalls": (UP, {}, ({"kind": "velocity", "cap": 10.0}, 0.5), 0.0),
    "lifts": (UP, {}, ({"kind": "velocity", "cap": 30.0}, 0.5), 0.0),
    "servo": (UP, {}, ({"kind": "position", "stiffness": 400.0, "damping": 40.0}, 0.2), 0.0),
    "weak servo": (UP, {}, ({"kind": "position", "stiffness": 4e5, "damping": 40.0, "cap": 10.0}, 0.2), 0.0),
    "rigid servo": (UP, {}, ({"kind": "position", "stiffness": 1e9, "damping": 1e7}, 0.2), 0.0),
}
HINGES = {
    "torsion": (UP, {"stiffness": 2.0, "armature": 0.1, "rest": 0.5}, None, 0.0),
    "wheel": (UP, {"friction": 0.05}, None, 2.0),
    "drive": (UP, {}, ({"kind": "velocity", "cap": 0.04, "gear": 2.0}, 1.0), 0.0),
    "geared drive": (UP, {"armature": INERTIA}, ({"kind": "velocity", "cap": 0.04, "gear": 2.0}, 1.0), 0.0),
    "far servo": (UP, {}, ({"kind": "position", "stiffness": 2.0, "damping": 0.5, "limit": 4.0}, 3.5), 0.0),
}


@functools.cache
def recorded(precision, solver="pgs"):
    builder = SceneBuilder(gravity=DOWN)
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    actions = []
    for kind, mechanisms in ((Slider, SLIDERS), (Hinge, HINGES)):
        for name, (axis, options, motor, rate) in mechanisms.items():
            motion = "velocity" if kind is Slider else "angular_velocity"
            body = builder.add_body(Box(HALF), mass=MASS, collides=False, **{motion: rate * np.asarray(axis)})
            joint = builder.add_joint(kind(post, body, (0, 0, 0), axis, **options), name=name)
            if motor:
                builder.add_motor(joint, **motor[0])
                actions.append(motor[1])
    ball = LENGTH * np.array([np.sin(RELEASE), -np.cos(RELEASE), 0.0])
    bob = builder.add_body(Sphere(0.05), mass=MASS, position=ball, collides=False)
    builder.add_joint(Distance(post, bob, (0, 0, 0)), name="tension")
    beam = builder.add_body(Box(HALF), mass=MASS, position=(LEVER, 0, 0), collides=False)
    builder.add_joint(Fixed(post, beam, (0, 0, 0)), name="cantilever")
    model, state = builder.build(undamped(dt=STEP_SIZES[0], velocity_iterations=40, solver=solver))

    def observe(model, state):
        force, torque = joint_forces(model, state)
        return {
            "place": joint_position(model, state),
            "rate": joint_velocity(model, state),
            "force": force,
            "torque": torque,
            "bob": state.position[bob],
        }

    models = stack([with_dt(model, dt) for dt in STEP_SIZES])
    start = observe(model, state)
    _, record = record_worlds(models, stack([state, state]), STEPS, observe, np.tile(actions, (2, 1)))
    names = model.scene.joint_names
    return names, {key: np.asarray(v, float) for key, v in record.items()}, {k: np.asarray(v) for k, v in start.items()}


def of(precision, name, world=0, solver="pgs"):
    """Time, and everything of one joint: (step,) or (step, 3)."""
    names, record, _ = recorded(str(precision), solver)
    joint = names.index(name)
    time = STEP_SIZES[world] * (1 + np.arange(STEPS))
    return time, {key: record[key][:, world, joint] for key in ("place", "rate", "force", "torque")}


def oscillator(time, stiffness, damping, inertia, rest=REST):
    """From rest at 0: ``x = rest (1 - e^(-g t) (cos w t + g / w sin w t))``."""
    half = damping / (2 * inertia)
    omega = np.sqrt(stiffness / inertia - half**2 + 0j)
    if abs(omega) < 1e-6:
        return rest * (1 - np.exp(-half * time) * (1 + half * time))
    return rest * (1 - np.exp(-half * time) * (np.cos(omega * time) + half / omega * np.sin(omega * time))).real


@pytest.mark.parametrize(
    ("name", "stiffness", "inertia", "rest"),
    [("spring", 50.0, MASS, REST), ("geared", 50.0, MASS + 6.0, REST), ("torsion", 2.0, INERTIA + 0.1, 0.5)],
)
@pytest.mark.parametrize("world", [0, 1])
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_undamped_spring_is_exact(precision, name, stiffness, inertia, rest, world, gate):
    """Frequency ``sqrt(k / (m + armature))``, amplitude and phase, at any step."""
    time, found = of(precision, name, world)
    limit = {"float64": 1e-9, "float32": 2e-3}[str(precision)]
    if name != "spring":  # the rotor is seen apart from the body: exact to fourth order
        limit = max(limit, 1e-5)
    truth = oscillator(time, stiffness, 0.0, inertia, rest)
    gate("place - truth, relative to the amplitude", (found["place"] - truth) / rest, limit)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "stiffness", "damping"), [("damped", 50.0, 3.0), ("overdamped", 200.0, 400.0), ("critical", 200.0, 40.0)]
)
def test_damped_spring_is_of_second_order(float64, name, stiffness, damping, gate):
    errors = []
    for world in (0, 1):
        time, found = of(float64, name, world)
        errors.append(np.abs(found["place"] - oscillator(time, stiffness, damping, MASS)).max() / REST)
    gate("place - truth, relative to the amplitude", errors[0], 2e-3)
    if name != "overdamped":  # whose fast root is not resolved
        assert errors[1] / errors[0] > 3.5, errors


@pytest.mark.parametrize("name", ["rigid", "rigid and damped"])
@pytest.mark.parametrize("world", [0, 1])
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_spring_of_any_stiffness_comes_to_rest(precision, name, world, gate):
    _, found = of(precision, name, world)
    gate("place at the end / rest - 1", found["place"][-1] / REST - 1, 1e-5)
    gate("farthest place / rest", found["place"] / REST, 2.0)
    gate("after sixty steps / rest - 1", found["place"][60:] / REST - 1, 1e-4)


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_spring_carries_its_load(precision, gate):
    _, found = of(precision, "loaded")
    gate("sag / (m g / k) - 1", found["place"][-1] / (-WEIGHT / 400.0) - 1, 1e-4)


@pytest.mark.parametrize(
    ("name", "rate", "friction", "inertia"), [("brake", 1.5, 4.0, MASS), ("wheel", 2.0, 0.05, INERTIA)]
)
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_dry_friction_stops_a_wheel(precision, name, rate, friction, inertia, gate):
    """``w0 - F t / I`` until ``t = I w0 / F``, then rest."""
    time, found = of(precision, name)
    truth = np.maximum(rate - friction / inertia * time, 0.0)
    assert 10 < np.argmax(truth == 0) < STEPS
    gate("rate", found["rate"] - truth, {"float64": 1e-9, "float32": 1e-4}[str(precision)])
    gate("way / (I w0^2 / 2 F) - 1", found["place"][-1] / (inertia * rate**2 / (2 * friction)) - 1, 1e-3)


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_dry_friction_under_load(precision, gate):
    time, slips = of(precision, "slips")
    gate("slipping / truth - 1", slips["rate"] / (-(WEIGHT - 5.0) / MASS * time) - 1, 1e-4)
    gate("creep while sticking [m]", of(precision, "sticks")[1]["place"], 1e-6)


@pytest.mark.parametrize(("name", "inertia"), [("drive", INERTIA), ("geared drive", 2 * INERTIA)])
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_velocity_motor_reaches_its_target_with_its_cap(precision, name, inertia, gate):
    """The action 1 times the gear 2 is reached at ``t = 2 I / cap``."""
    time, found = of(precision, name)
    truth = np.minimum(0.04 / inertia * time, 2.0)
    gate("rate", found["rate"] - truth, {"float64": 1e-6, "float32": 1e-4}[str(precision)])


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_velocity_motor_under_load(precision, gate):
    time, stalls = of(precision, "stalls")
    gate("overloaded: rate / truth - 1", stalls["rate"] / (-(WEIGHT - 10.0) / MASS * time) - 1, 1e-4)
    gate("overloaded: force - cap [N]", stalls["force"][:, 1] - 10.0, 1e-4)
    _, lifts = of(precision, "lifts")
    gate("lifting: rate - target", lifts["rate"][60:] - 0.5, 1e-5)
    gate("lifting: force / weight - 1", lifts["force"][60:, 1] / WEIGHT - 1, 1e-3)


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_position_servo_under_load(precision, gate):
    """``k (q - q*)`` is the load; capped, the load wins."""
    gate("error / (m g / k) - 1", (of(precision, "servo")[1]["place"][-1] - 0.2) / (-WEIGHT / 400.0) - 1, 1e-4)
    time, weak = of(precision, "weak servo")
    gate("capped: rate / truth - 1", weak["rate"] / (-(WEIGHT - 10.0) / MASS * time) - 1, 1e-4)
    _, rigid = of(precision, "rigid servo")
    gate("rigid: place / target - 1", rigid["place"][60:] / 0.2 - 1, 1e-4)


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_servo_turns_the_short_way(precision, gate):
    """A target of 3.5 rad is -2.78 rad round the other way."""
    _, found = of(precision, "far servo")
    gate("place at the end [rad]", found["place"][-1] - (3.5 - 2 * np.pi), 1e-3)


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_tension_of_a_pendulum(precision, gate):
    """``m g (3 cos a - 2 cos a0)`` along the rod, at the middle of the step."""
    _, found = of(precision, "tension")
    _, record, start = recorded(str(precision))
    bob = np.concatenate([start["bob"][None], record["bob"][:, 0]])
    middle = 0.5 * (bob[1:] + bob[:-1])
    along = -middle / np.linalg.norm(middle, axis=1, keepdims=True)
    truth = WEIGHT * (3 * along[:, 1] - 2 * np.cos(RELEASE))
    gate("tension / weight - truth", (np.einsum("ti,ti->t", found["force"], along) - truth) / WEIGHT, 1e-3)
    gate("across the rod / weight", np.cross(found["force"], along) / WEIGHT, 1e-3)
    gate("torque [N m]", found["torque"], 1e-6)


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_cantilever(precision, gate):
    """The weld carries ``m g`` and ``m g l`` about its anchor."""
    _, found = of(precision, "cantilever")
    gate("force / weight", found["force"][-1] / WEIGHT - np.array([0, 1, 0]), 1e-4)
    gate("torque / (weight times arm)", found["torque"][-1] / (WEIGHT * LEVER) - np.array([0, 0, 1]), 1e-4)


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_reactions_of_idle_joints(precision, gate):
    """A slider along x carries the weight; what sticks is held by the friction alone."""
    gate("slider: force / weight", of(precision, "brake")[1]["force"][-1] / WEIGHT - np.array([0, 1, 0]), 1e-4)
    gate("friction: force / weight", of(precision, "sticks")[1]["force"][-1] / WEIGHT - np.array([0, 1, 0]), 1e-4)
    gate("drive at its cap: torque", of(precision, "drive")[1]["torque"][5] - np.array([0, 0.04, 0]), 5e-5)
