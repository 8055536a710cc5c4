"""`energy`, `momentum`, `angular_momentum`, `contacts` and `contact_forces` against NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import (
    Box,
    Capsule,
    Plane,
    SceneBuilder,
    Sphere,
    angular_momentum,
    contact_forces,
    contacts,
    energy,
    momentum,
)
from tests.scenes import DOWN, GRAVITY, advance, invariants, slab_on_plane, sphere_on_plane, tilted_gravity, undamped


def moving_scene():
    builder = SceneBuilder(gravity=(0.5, -9.0, 1.0))
    builder.add_body(Plane(normal=(0, 1, 0), offset=-50.0), static=True)
    rng = np.random.default_rng(2)
    for index, shape in enumerate((Sphere(0.2), Box((0.1, 0.2, 0.3)), Capsule(0.1, 0.3))):
        turn = rng.normal(size=4)
        builder.add_body(
            shape,
            mass=1.0 + index,
            position=rng.normal(size=3) + np.array([5 * index, 0, 0]),
            orientation=turn / np.linalg.norm(turn),
            velocity=rng.normal(size=3),
            angular_velocity=rng.normal(size=3),
        )
    return builder.build(undamped())


def test_energy_and_momenta_against_numpy(precision, gate):
    model, state = moving_scene()
    leaves = {"mass": model.mass[1:], "inertia": model.inertia[1:]}
    moving = [leaf[1:] for leaf in (state.position, state.orientation, state.velocity, state.angular_velocity)]
    kinetic, linear, angular = invariants(leaves, *moving)
    mass, place = np.asarray(model.mass[1:], dtype=float), np.asarray(state.position[1:], dtype=float)
    potential = -np.sum(mass[:, None] * place * [0.5, -9.0, 1.0])
    limit = {"float32": 1e-5, "float64": 1e-12}[str(precision)]
    assert jnp.shape(energy(model, state)) == ()
    gate("energy / truth - 1", float(energy(model, state)) / (kinetic + potential) - 1, limit)
    gate("momentum", (np.asarray(momentum(model, state)) - linear) / np.abs(linear).max(), limit)
    gate("angular momentum", (np.asarray(angular_momentum(model, state)) - angular) / np.abs(angular).max(), limit)


def test_energy_and_momenta_under_vmap_and_grad(float64):
    model, state = moving_scene()
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    for function in (energy, momentum, angular_momentum):
        mapped = jax.vmap(function, in_axes=(None, 0))(model, batch)
        np.testing.assert_allclose(mapped[1], function(model, state), rtol=1e-12)
    slope = jax.grad(lambda v: energy(model, dataclasses.replace(state, velocity=v)))(state.velocity)
    np.testing.assert_allclose(slope[1:], np.asarray(model.mass)[1:, None] * np.asarray(state.velocity)[1:], rtol=1e-12)


def test_contact_of_a_sphere_with_the_plane(precision, gate):
    for height in (-0.02, 0.0, 0.3):
        model, state = sphere_on_plane(height=height)
        found = contacts(model, state)
        limit = {"float32": 1e-6, "float64": 1e-12}[str(precision)]
        gate(f"separation at {height} m", found.separation - height, limit)
        gate("normal, plane to sphere", found.normal - jnp.array([0.0, 1.0, 0.0]), limit)
        gate("point between the surfaces [m]", found.position - jnp.array([0.0, height / 2, 0.0]), limit)
        assert found.body_a.tolist() == [0] and found.body_b.tolist() == [1]


def test_sphere_between_two_bodies_has_unit_normals_from_a_to_b(float64):
    builder = SceneBuilder(gravity=DOWN)
    builder.add_body(Box((0.5, 0.5, 0.5)), static=True)
    builder.add_body(Sphere(0.2), mass=1.0, position=(0.1, 0.69, 0.0))
    builder.add_body(Sphere(0.2), mass=1.0, position=(0.1, 1.08, 0.0))
    model, state = builder.build(undamped())
    found = contacts(model, state)
    normal = np.asarray(found.normal)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, rtol=1e-12)
    centers = np.asarray(state.position)
    for slot in np.flatnonzero(np.asarray(found.active)):
        toward_b = centers[found.body_b[slot]] - centers[found.body_a[slot]]
        assert normal[slot] @ toward_b > 0
    np.testing.assert_allclose(np.asarray(found.separation)[np.asarray(found.active)].min(), -0.01, atol=1e-12)


def test_contact_forces_hold_the_weight_on_a_slope(precision, gate):
    """At rest the forces on B sum to minus the weight: m g cos normal to the slope, m g sin along it."""
    model, state = slab_on_plane(gravity=tilted_gravity(10.0), friction=0.5, options=undamped(dt=1 / 240))
    final = advance(model, state, 240)
    forces = np.asarray(contact_forces(model, final), dtype=float)
    found = contacts(model, final)
    sign = np.where(np.asarray(found.body_b) == 1, 1.0, -1.0)[:, None]
    gate("sum of forces / weight", ((sign * forces).sum(axis=0) + tilted_gravity(10.0)) / GRAVITY, 1e-3)
    moment = np.cross(np.asarray(found.position) - np.asarray(final.position)[1], sign * forces).sum(axis=0)
    gate("sum of moments / (weight x half width)", moment / (GRAVITY * 0.2), 1e-3)
    assert (sign * forces)[:, 1].min() >= -1e-6, "contacts never pull"


def test_contact_forces_of_a_separated_pair_are_zero():
    model, state = sphere_on_plane(height=1.0)
    final = advance(model, state, 5)
    np.testing.assert_array_equal(contact_forces(model, final), np.zeros_like(contact_forces(model, final)))
    assert not np.any(np.asarray(contacts(model, final).active) & (np.asarray(contacts(model, final).separation) < 0))
