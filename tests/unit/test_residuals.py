"""The four residuals of BENCHMARKS 0.4, overlaps and joint gaps against known truths."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import (
    Box,
    Hinge,
    Options,
    Plane,
    SceneBuilder,
    Slider,
    Sphere,
    joint_gaps,
    penetration,
    residuals,
    step,
)
from tests.scenes import DOWN, GRAVITY, advance, axis_angle, slab_on_plane, sphere_on_plane, undamped

DT = 1 / 64


def touching(force, velocity, spin=(0.0, 0.0, 0.0), height=0.0):
    """A sphere of 1 kg on the plane, with a force and a motion that no solver chose."""
    model, state = sphere_on_plane(height=height, friction=0.5, options=undamped(dt=DT))
    return model, dataclasses.replace(
        state,
        contact_force=jnp.asarray([force], state.position.dtype),
        contact_feature=step(model, state).contact_feature,
        velocity=state.velocity.at[1].set(jnp.asarray(velocity)),
        angular_velocity=state.angular_velocity.at[1].set(jnp.asarray(spin)),
    )


def test_a_contact_that_pushes_and_parts(precision, gate):
    found = residuals(*touching((0.0, 8.0, 0.0), (0.0, 0.25, 0.0)))
    gate("complementarity [J]", float(found.complementarity) - 8 * DT * 0.25, 1e-6)
    gate("others", [float(found.cone), float(found.penetration), float(found.dissipation)], 1e-6)


def test_friction_outside_its_cone(precision, gate):
    found = residuals(*touching((3.0, 4.0, 4.0), (0.0, 0.0, 0.0)))
    gate("cone [N s]", float(found.cone) - (5.0 - 0.5 * 4.0) * DT, 1e-6)


def test_friction_that_opposes_sliding_by_half(precision, gate):
    """The gap is mu n |v| - t |v|: 1 m/s along x against friction of 1 N, where it could be 2 N."""
    found = residuals(*touching((-1.0, 4.0, 0.0), (1.0, 0.0, 0.0)))
    gate("dissipation [J]", float(found.dissipation) - (2.0 - 1.0) * DT, 1e-6)
    gate("cone [N s]", float(found.cone), 1e-6)


def test_a_spinning_sphere_slides_at_its_lowest_point(precision, gate):
    """v = 1 and omega = -10 about z roll without slip; without the turn of the sphere it would slide."""
    rolling = residuals(*touching((0.0, 4.0, 0.0), (1.0, 0.0, 0.0), spin=(0.0, 0.0, -10.0)))
    gate("dissipation, rolling [J]", float(rolling.dissipation), 1e-6)
    spinning = residuals(*touching((0.0, 4.0, 0.0), (0.0, 0.0, 0.0), spin=(0.0, 0.0, -10.0)))
    gate("dissipation, spinning [J]", float(spinning.dissipation) - 2.0 * DT, 1e-6)


@pytest.mark.parametrize("depth", [0.0, 1e-3, 0.02])
def test_penetration_is_the_depth(precision, depth, gate):
    for height, truth in ((-depth, depth), (depth, 0.0)):
        model, state = sphere_on_plane(height=height)
        gate("overlap [m]", float(penetration(model, state)) - truth, 1e-7)
        gate("the same in the residuals [m]", float(residuals(model, state).penetration) - truth, 1e-7)


def test_penetration_of_close_pairs(precision, gate):
    """In a scene with a broadphase, the deepest of several pairs."""
    builder = SceneBuilder(gravity=DOWN)
    for x in (0.0, 0.19, 0.375, 5.0):
        builder.add_body(Sphere(0.1), mass=1.0, position=(x, 0.0, 0.0))
    model, state = builder.build(Options(broadphase="all_pairs"))
    gate("overlap [m]", float(penetration(model, state)) - 0.015, 1e-6)
    gate("slope", np.asarray(jax.grad(lambda p: penetration(model, dataclasses.replace(state, position=p)))(
        state.position))[:, 0] - [0, 1, -1, 0], 1e-5)  # fmt: skip


def test_a_sliding_block_has_no_residual(precision, gate):
    """All four are 0 for a block that slides on a plane: friction opposes it with mu m g."""
    model, state = slab_on_plane(velocity=(2.0, 0.0, 1.0), friction=0.4, options=undamped(dt=1 / 240))
    state = advance(model, state, 60)
    found = residuals(model, state)
    assert np.linalg.norm(state.velocity[1]) > 0.5
    scale = GRAVITY / 240
    limit = {"float32": 1e-4, "float64": 1e-9}[str(precision)]
    gate(
        "impulse", np.linalg.norm(np.asarray(state.contact_force, float).sum(0)) / GRAVITY / np.hypot(1, 0.4) - 1, 1e-3
    )
    for name in ("complementarity", "cone", "dissipation"):
        gate(f"{name} / impulse", float(getattr(found, name)) / scale, limit)


def test_residuals_of_a_standing_pile_with_a_broadphase(gate):
    """The forces are found again by pair: their order in the list may change."""
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
    for level in range(3):
        builder.add_body(Sphere(0.1), mass=1.0, position=(0.0, 0.1 + 0.2 * level, 0.0))
    model, state = builder.build(Options(dt=1 / 240, broadphase="all_pairs", velocity_iterations=100))
    state = advance(model, state, 120)
    found = residuals(model, state)
    scale = 3 * GRAVITY / 240
    for name in ("complementarity", "cone", "dissipation"):
        gate(f"{name} / impulse", float(getattr(found, name)) / scale, 1e-4)
    kicked = dataclasses.replace(state, velocity=state.velocity.at[3, 1].add(2.0))
    lifted = float(residuals(model, kicked).complementarity)
    gate("work on the ball that is lifted / truth", lifted / (GRAVITY / 240 * 2.0) - 1, 1e-3)


def test_a_scene_without_contacts_has_no_residual():
    builder = SceneBuilder()
    builder.add_body(Sphere(0.1), mass=1.0)
    model, state = builder.build()
    assert all(float(leaf) == 0 for leaf in jax.tree.leaves(residuals(model, state)))
    assert float(penetration(model, state)) == 0
    assert joint_gaps(model, state).translation.shape == (0,)


def test_residuals_refuse_another_scene():
    with pytest.raises(ValueError, match="residuals"):
        residuals(sphere_on_plane()[0], slab_on_plane()[1])


def joined(kind):
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=-10.0), static=True)
    post = builder.add_body(Box((0.1, 0.1, 0.1)), static=True)
    for name, x in (("first", 1.0), ("second", 3.0)):
        arm = builder.add_body(Box((0.5, 0.1, 0.1)), mass=1.0, position=(x, 0.0, 0.0), name=name)
        builder.add_joint(kind(parent=post, child=arm, anchor=(x - 0.5, 0.0, 0.0), axis=(0, 0, 1)))
    return builder.build(undamped())


@pytest.mark.parametrize("kind", [Hinge, Slider])
def test_gaps_of_an_opened_joint(precision, kind, gate):
    model, state = joined(kind)
    closed = joint_gaps(model, state)
    gate("as built", [*closed.translation, *closed.rotation], 1e-6)
    # Across the axis both joints hold; along it the slider is free.
    moved = joint_gaps(model, dataclasses.replace(state, position=state.position.at[3].add(jnp.array([0.3, 0.4, 1.2]))))
    gate("apart [m]", np.asarray(moved.translation) - [0.0, 1.3 if kind is Hinge else 0.5], 1e-6)
    gate("not turned", moved.rotation, 1e-6)
    turned = dataclasses.replace(state, orientation=state.orientation.at[3].set(axis_angle((0, 1, 0), 1e-2)))
    found = joint_gaps(model, turned)
    gate("turned [rad]", np.asarray(found.rotation) - [0.0, 1e-2], 1e-6)
    free = dataclasses.replace(
        state,
        orientation=state.orientation.at[3].set(axis_angle((0, 0, 1), 0.5)),
        position=state.position.at[3].set(jnp.array([2.5 + 0.5 * np.cos(0.5), 0.5 * np.sin(0.5), 0.0])),
    )
    if kind is Hinge:
        gate("turned about its axis", [*joint_gaps(model, free).translation, *joint_gaps(model, free).rotation], 1e-6)


def test_gaps_are_differentiable(float64):
    model, state = joined(Hinge)

    def gap(position):
        return joint_gaps(model, dataclasses.replace(state, position=position)).translation[1]

    closed = jax.grad(gap)(state.position)
    assert np.isfinite(closed).all() and not np.any(closed)
    opened = jax.grad(gap)(state.position.at[3, 1].add(0.1))
    np.testing.assert_allclose(opened[3], [0, 1, 0], atol=1e-9)
