"""A step of a box that slides on its edge, and its derivatives, against the closed form.

The two points of the edge carry the same load, so that the truth is that of the plane: the normal speed of the edge becomes
0, and friction times that impulse acts against the slide, whatever the tangents do to the speed there. Friction turns the
body as the load does: it makes the same load stop more of the speed, or less.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Plane, SceneBuilder, step
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.scenes import DOWN, GRAVITY, HALVES_BY_PROPORTION, undamped

FRICTION, FALL, DT = 0.8, 0.2, 1 / 240


def on_its_edge(half, tilt):
    """A box turned by an angle about z, whose lower right edge touches the plane, and where that edge is from its centre."""
    turn = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
    corners = [turn @ np.array([x, y]) for x in (-half[0], half[0]) for y in (-half[1], half[1])]
    lowest = min(corners, key=lambda corner: corner[1])
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=FRICTION)
    builder.add_body(
        Box(half),
        mass=1.0,
        position=(0, -lowest[1], 0),
        orientation=(np.cos(tilt / 2), 0, 0, np.sin(tilt / 2)),
        friction=FRICTION,
    )
    return *builder.build(undamped(dt=DT)), lowest


def motion_of_step(parameters, model, state):
    """(x, y, spin) velocity after a step, of a box with those before, a friction and a mass; twice, for `has_aux`."""
    moving, friction, mass = parameters
    model = dataclasses.replace(
        model,
        friction=jnp.full_like(model.friction, friction),
        mass=model.mass.at[1].set(mass),
        inertia=model.inertia.at[1].multiply(mass),
    )
    state = dataclasses.replace(
        state,
        velocity=state.velocity.at[1, :2].set(moving[:2]),
        angular_velocity=state.angular_velocity.at[1, 2].set(moving[2]),
    )
    final = step(model, state)
    motion = jnp.stack([*final.velocity[1, :2], final.angular_velocity[1, 2]])
    return motion, motion


def truth(parameters, half, edge):
    (speed, fall, spin), friction, _ = parameters  # the mass changes nothing
    inertia = (half[0] ** 2 + half[1] ** 2) / 3
    fall = fall - GRAVITY * DT
    against = -jnp.sign(speed - spin * edge[1])
    pull, lever = against * friction, edge[0] - against * friction * edge[1]
    impulse = -(fall + spin * edge[0]) / (1 + edge[0] * lever / inertia)
    return jnp.stack([speed + pull * impulse, fall + impulse, spin + lever / inertia * impulse])


derivatives = {mode: jax.jit(getattr(jax, mode)(motion_of_step, has_aux=True)) for mode in ("jacfwd", "jacrev")}


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize("tilt", [0.02, 0.3])
@pytest.mark.parametrize("speed", [3.0, -3.0])
@pytest.mark.parametrize("name", slow_but(("slab", "brick", "tower"), HALVES_BY_PROPORTION))
def test_a_step(precision, name, speed, tilt, gate):
    """Sweeps that answered to friction as if it followed by itself swung: derivatives of the tower were 68 for 2."""
    model, state, edge = on_its_edge(HALVES_BY_PROPORTION[name], tilt)
    parameters = (
        jnp.asarray([speed, -FALL, 0.0], precision),
        jnp.asarray(FRICTION, precision),
        jnp.ones((), precision),
    )
    exact = truth(parameters, HALVES_BY_PROPORTION[name], edge)
    assert abs(float(exact[0] / speed) - 1) < 0.3, "it goes on sliding"
    slopes = jax.jacfwd(truth)(parameters, HALVES_BY_PROPORTION[name], edge)
    for mode, derivative in derivatives.items():
        found, value = derivative(parameters, model, state)
        gate("velocity / fall", (value - exact) / FALL, 0.02)
        for what, ours, true in zip(("velocity", "friction", "mass"), found, slopes, strict=True):
            gate(f"{mode} by {what}", ours - true, 1e-3 if what == "friction" else 1e-5)
