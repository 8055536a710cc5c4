"""Springs, dampers and rotors of joints whose axes turn with a carrier: their equations of motion, integrated otherwise.

On a carrier that turns at a constant rate w, a bead of mass m at distance r from the axis, on a slider along r with a rotor
A, spring k (slack at the start r0) and damper c, obeys ``(m + A) r'' = m w^2 r - k (r - r0) - c r'``. A box that is hinged
through its centre, about its x axis, across that of the carrier, obeys ``(I_x + A) a'' = w^2 (I_z - I_y) sin a cos a``.
"""

import functools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mathota_jax import Box, Hinge, SceneBuilder, Slider, Sphere, joint_position
from tests.marks import QUICK_IN_FLOAT64
from tests.scenes import advance, undamped, with_dt

TIME, STEPS = 0.5, (60, 120)
TURNING, MASS, REACH, TILT = 3.0, 1.0, 0.5, 0.5
HALF = (0.1, 0.05, 0.4)
MOMENTS = MASS / 3 * (np.sum(np.square(HALF)) - np.square(HALF))
CARRIER = 1e5
"""Mass [kg]: what moves on the carrier slows it by less than a part in a thousand."""

SLIDERS = {
    "free": {},
    "rotor": {"armature": MASS},
    "large rotor": {"armature": 4.0 * MASS},
    "spring": {"stiffness": 20.0 * MASS, "rest": 0.0},
    "damper": {"damping": 2.0 * MASS},
    "all three": {"armature": MASS, "stiffness": 40.0 * MASS, "damping": 4.0 * MASS, "rest": 0.0},
}
OTHER_SOLVERS = ("sweeps", "converged", "soft_step")
HINGES = {"flap": 0.0, "flap with rotor": MOMENTS[0], "flap with large rotor": 4.0 * MOMENTS[0]}


@functools.cache
def recorded(precision, solver):
    """Places (step size, joint) of all joints but the carrier's at the end."""
    del precision  # of the whole program, set by the fixture
    builder = SceneBuilder(gravity=(0, 0, 0))
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    spin = np.array([0, TURNING, 0])
    carrier = builder.add_body(Sphere(0.5), mass=CARRIER, angular_velocity=spin, collides=False)
    builder.add_joint(Hinge(post, carrier, (0, 0, 0), (0, 1, 0)))
    for number, options in enumerate(SLIDERS.values()):
        angle = 2 * np.pi * number / len(SLIDERS)
        axis = np.array([np.cos(angle), 0, np.sin(angle)])
        place = REACH * axis
        motion = {"velocity": np.cross(spin, place), "angular_velocity": spin}
        bead = builder.add_body(Sphere(0.05), mass=MASS, position=place, collides=False, **motion)
        builder.add_joint(Slider(carrier, bead, place, axis, **options))
    for armature in HINGES.values():
        turn = (np.cos(TILT / 2), np.sin(TILT / 2), 0, 0)
        flap = builder.add_body(Box(HALF), mass=MASS, orientation=turn, angular_velocity=spin, collides=False)
        builder.add_joint(Hinge(carrier, flap, (0, 0, 0), (1, 0, 0), armature=armature))
    options = {"exact_joints": False} if solver == "sweeps" else {"solver": solver}
    model, state = builder.build(undamped(dt=TIME / STEPS[0], **options))
    final = []
    for steps in STEPS:
        finer = with_dt(model, TIME / steps)
        final.append(np.asarray(joint_position(finer, advance(finer, state, steps)))[1:])
    return np.array(final, float)


def truth(name):
    """Displacement of a slider or angle of a hinge at the end."""
    if name in HINGES:
        inertia = MOMENTS[0] + HINGES[name]
        drive = TURNING**2 * (MOMENTS[2] - MOMENTS[1])

        def rates(_, y):
            return [y[1], drive * np.sin(TILT + y[0]) * np.cos(TILT + y[0]) / inertia]
    else:
        given = {"armature": 0.0, "stiffness": 0.0, "damping": 0.0, **SLIDERS[name]}

        def rates(_, y):
            force = MASS * TURNING**2 * (REACH + y[0]) - given["stiffness"] * y[0] - given["damping"] * y[1]
            return [y[1], force / (MASS + given["armature"])]

    return solve_ivp(rates, (0, TIME), [0.0, 0.0], rtol=1e-11, atol=1e-12).y[0, -1]


@pytest.mark.parametrize("name", [*SLIDERS, *HINGES])
@pytest.mark.parametrize("solver", ["pgs", *(pytest.param(s, marks=pytest.mark.slow) for s in OTHER_SOLVERS)])
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_motion_on_a_turning_carrier(precision, solver, name, gate):
    """The error falls with the step, to nothing."""
    right = truth(name)
    coarse, fine = recorded(str(precision), solver)[:, [*SLIDERS, *HINGES].index(name)]
    gate("place - truth, relative to it, at 1/240 s", (fine - right) / right, 0.01)
    gate("likewise, of the limit seen from both steps", (2 * fine - coarse - right) / right, 0.01)
