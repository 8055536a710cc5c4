"""Rows of a joint made independent: products, reaction forces and the one sweep that solves a joint, by linear algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Fixed, Hinge, SceneBuilder, Sphere, joint_gaps, step
from mathota_jax.constraints.assembly import Side
from mathota_jax.constraints.decoupling import decouple
from mathota_jax.constraints.joint_layout import joint_tables
from mathota_jax.spatial.vector import Vec3
from tests.scenes import DOWN, undamped


def mixed_scene(**options):
    """Different joints in one table: a hinge with stops and friction, a weld; a hinge with stops of one moving body."""
    builder = SceneBuilder(gravity=DOWN)
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    bodies = [
        builder.add_body(Box((0.2, 0.1, 0.05)), mass=m, position=(x, 0, 0), collides=False)
        for m, x in ((1.0, 0.3), (2.0, 0.9), (0.5, 2.0), (3.0, 2.6))
    ]
    builder.add_joint(Hinge(post, bodies[0], (0, 0, 0), (0, 0, 1), limits=(-0.1, 0.1)))
    builder.add_joint(Hinge(bodies[0], bodies[1], (0.6, 0, 0), (0, 0, 1), limits=(-0.3, 0.2), friction=0.1))
    builder.add_joint(Fixed(bodies[2], bodies[3], (2.3, 0, 0)))
    return builder.build(undamped(**options))


@pytest.mark.parametrize("number", [0, 1])
def test_rows_that_hold_feel_no_others(float64, number, gate):
    """Against the products of the rows one by one, and the impulses there and back."""
    model, _ = mixed_scene()
    table = joint_tables(model.scene)[number]
    rng = np.random.default_rng(number)
    count = len(table.order)

    def random_side():
        return Side(*(Vec3(*(jnp.asarray(rng.normal(size=(count, 2))) for _ in range(3))) for _ in range(2)))

    jacobians = [random_side() for _ in table.blocks]
    weights = [[1.0, 1.0, 1.0, 5.0, 0.5, 50.0], [2.0, 2.0, 2.0, 1.0, 7.0, 0.1]]
    responses = []
    for side, weight in zip(jacobians, weights, strict=False):
        parts = [x * w for x, w in zip(jax.tree.leaves(side), weight, strict=True)]
        responses.append(Side(Vec3(*parts[:3]), Vec3(*parts[3:])))
    found = decouple(model.scene, table, jacobians, responses)
    new, moved = found.sides(jacobians), found.sides(responses)
    layout = found.layout

    def stacked(sides):
        return np.array([layout.by_joint(part) for side in sides for part in jax.tree.leaves(side)])

    products = np.einsum("ckjw,cljw->kljw", stacked(new), stacked(moved))
    exists = layout.places < count
    for joint in range(exists.shape[1]):
        for row in np.flatnonzero(layout.holding[:, joint]):
            others = [k for k in np.flatnonzero(exists[:, joint]) if k != row]
            gate("product with a row that holds", products[row, others, joint], 1e-9)
    own = np.einsum("kkjw->kjw", products)
    gate("own response / product - 1", np.array(layout.by_joint(found.mass))[exists] / own[exists] - 1, 1e-9)
    impulse = jnp.asarray(rng.normal(size=(count, 2)))
    gate("there and back", (found.original_impulses(found.impulses(impulse)) - impulse)[table.order >= 0], 1e-9)
    push = np.einsum("ckjw,kjw->cjw", stacked(new), layout.by_joint(found.impulses(impulse)))
    same = np.einsum("ckjw,kjw->cjw", stacked(jacobians), layout.by_joint(impulse))
    gate("what the impulses do", push - same, 1e-9)


def test_one_sweep_solves_a_joint_that_stands_alone(float64, gate):
    """A rod that falls on the stop of its hinge."""
    builder = SceneBuilder(gravity=DOWN)
    post = builder.add_body(Sphere(0.02), static=True, collides=False)
    rod = builder.add_body(Box((0.3, 0.02, 0.02)), mass=2.0, position=(0.3, 0, 0), collides=False)
    builder.add_joint(Hinge(post, rod, (0, 0, 0), (0, 0, 1), limits=(-0.2, 0.2)))
    model, state = builder.build(undamped(dt=1 / 240, velocity_iterations=1, position_iterations=1))
    gaps = []
    for _ in range(120):
        state = step(model, state)
        gaps.append(float(joint_gaps(model, state).translation.max()))
    gate("gap [m]", max(gaps), 2e-5)
    gate("rate at rest [rad/s]", state.angular_velocity[1], 1e-9)
