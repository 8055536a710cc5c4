"""Cylinders, cones and polyhedra in motion: rolling, sliding, standing, against closed forms and against boxes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Cone, Cylinder, Plane, Polyhedron, SceneBuilder, rollout
from tests.hulls import BOX_CORNERS
from tests.marks import QUICK_AND_SLOW_PRECISION, slow_but
from tests.scenes import DOWN, undamped

DT = 1 / 240
LYING = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)  # the axis along z


def on_plane(shape, *, height, orientation=(1, 0, 0, 0), velocity=(0, 0, 0), slope=0.0, friction=0.5, **options):
    gravity = (9.81 * np.sin(slope), -9.81 * np.cos(slope), 0.0)
    builder = SceneBuilder(gravity=gravity)
    builder.add_body(Plane((0, 1, 0)), static=True, friction=friction)
    builder.add_body(
        shape, mass=1.0, position=(0, height, 0), orientation=orientation, velocity=velocity, friction=friction
    )
    return builder.build(undamped(dt=DT, **options))


def run(model, state, steps):
    return jax.jit(rollout, static_argnums=2)(model, state, steps)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_cylinder_rolls_down_a_slope(precision, gate):
    """A solid cylinder that rolls without slipping accelerates with (2/3) g sin(slope)."""
    slope, steps = 0.2, 240
    model, state = on_plane(Cylinder(0.1, 0.15), height=0.1, orientation=LYING, slope=slope)
    final, _ = run(model, state, steps)
    acceleration = 2 / 3 * 9.81 * np.sin(slope)
    time = steps * DT
    gate("distance / truth - 1", final.position[1, 0] / (0.5 * acceleration * time**2) - 1, 1e-3)
    gate("no slip [m/s]", final.velocity[1, 0] + 0.1 * final.angular_velocity[1, 2], 1e-3)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_cube_as_polyhedron_slides_like_the_box(precision, gate):
    """The same cube in two descriptions; v^2 / (2 mu g) in both."""
    finals = []
    for shape in (Box((0.1, 0.1, 0.1)), Polyhedron(0.1 * BOX_CORNERS)):
        model, state = on_plane(shape, height=0.1, velocity=(2, 0, 0), friction=0.4)
        finals.append(run(model, state, 240)[0])
    gate("distance / truth - 1", finals[1].position[1, 0] / (4 / (2 * 0.4 * 9.81)) - 1, 1e-3)
    gate("polyhedron - box [m]", finals[1].position[1] - finals[0].position[1], 1e-4)


@pytest.mark.parametrize(
    ("shape", "height"),
    [(Cylinder(0.1, 0.1), 0.1), (Cone(0.1, 0.1), 0.05), (Polyhedron(0.1 * BOX_CORNERS), 0.1)],
    ids=["cylinder", "cone", "polyhedron"],
)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_stands_on_a_plane(precision, shape, height, gate):
    model, state = on_plane(shape, height=height)
    final, _ = run(model, state, 480)
    gate("sideways drift [m]", final.position[1, ::2], 1e-4)
    gate("sinking [m]", height - final.position[1, 1], 1e-3)
    gate("tilt", final.orientation[1, 1:], 1e-3)


@pytest.mark.parametrize("upper", slow_but(("cylinder",), ("cylinder", "cone", "polyhedron")))
def test_stands_on_another_one(upper, gate):
    """On a polyhedral plate, by the general manifold: neither tips over nor sinks."""
    shapes = {"cylinder": (Cylinder(0.1, 0.1), 0.1), "cone": (Cone(0.1, 0.1), 0.05),
              "polyhedron": (Polyhedron(0.1 * BOX_CORNERS), 0.1)}  # fmt: skip
    shape, height = shapes[upper]
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Polyhedron(BOX_CORNERS * [0.5, 0.1, 0.5]), static=True, position=(0, -0.1, 0))
    builder.add_body(shape, mass=1.0, position=(0.03, height, 0.02))
    model, state = builder.build(undamped(dt=DT))
    final, _ = run(model, state, 480)
    gate("sideways drift [m]", final.position[1, ::2] - jnp.array([0.03, 0.02]), 2e-3)
    gate("sinking [m]", height - final.position[1, 1], 1e-3)
    gate("tilt", final.orientation[1, 1:], 5e-3)


def test_gradient_of_the_slide_of_a_polyhedron(float64, gate):
    """d distance / d friction = -g t^2 / 2 while it slides, by a polyhedron that rests on its vertices."""
    steps = 100
    model, state = on_plane(Polyhedron(0.1 * BOX_CORNERS), height=0.1, velocity=(2, 0, 0), friction=0.4)

    def distance(friction):
        changed = dataclasses.replace(model, friction=jnp.full(2, friction))
        return rollout(changed, state, steps)[0].position[1, 0]

    gate("gradient / truth - 1", jax.jit(jax.grad(distance))(0.4) / (-0.5 * 9.81 * (steps * DT) ** 2) - 1, 1e-6)
