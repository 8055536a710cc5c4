"""Bodies whose centre of mass is not the origin of their shape, or whose principal axes are not its axes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mathota_jax import (
    Box,
    Capsule,
    Compound,
    Cylinder,
    Heightfield,
    Hinge,
    Plane,
    Polyhedron,
    SceneBuilder,
    Sphere,
    contacts,
    step,
)
from mathota_jax.bodies import unpack
from mathota_jax.collision.placement import shape_parameters, shape_poses
from mathota_jax.geometry.bounds import aabb
from tests.hulls import BOX_CORNERS
from tests.scenes import rotation_matrix, undamped

UNIT = (1.0, 0.0, 0.0, 0.0)
WEDGE = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 0.7], [2, 0, 0.7], [0, 1, 0.7]])


def quaternion(*rotation_vector):
    return Rotation.from_rotvec(rotation_vector).as_quat()[[3, 0, 1, 2]]


TURN, OTHER = quaternion(0.3, -0.8, 0.5), quaternion(1.0, 0.2, -0.4)


def single(shape, **body):
    builder = SceneBuilder()
    handle = builder.add_body(shape, **{"mass": 2.0, **body})
    model, state = builder.build(undamped())
    return model, state, handle


def world_vertices(model, state):
    turned = rotation_matrix(state.orientation[0])
    return np.asarray(model.shapes["polyhedron"]["vertices"][0]) @ turned.T + np.asarray(state.position[0])


def test_position_is_the_centre_of_mass_and_orientation_the_users(float64):
    shape = Polyhedron(WEDGE)
    model, state, _ = single(shape, position=(5, 6, 7), orientation=TURN)
    center = rotation_matrix(TURN) @ shape.center_of_mass() + (5, 6, 7)
    np.testing.assert_allclose(state.position[0], center, rtol=1e-14)
    np.testing.assert_allclose(state.orientation[0], TURN, rtol=1e-14)
    np.testing.assert_allclose(world_vertices(model, state), WEDGE @ rotation_matrix(TURN).T + (5, 6, 7), rtol=1e-12)


def test_static_bodies_are_placed_alike(float64):
    shape = Polyhedron(WEDGE)
    model, state, _ = single(shape, mass=None, static=True, position=(5, 6, 7), orientation=TURN)
    np.testing.assert_allclose(world_vertices(model, state), WEDGE @ rotation_matrix(TURN).T + (5, 6, 7), rtol=1e-12)


def test_inertia_and_its_frame_make_the_tensor(float64):
    shape = Compound([(Box((0.1, 0.4, 0.2)), ((0.3, 0, 0), TURN)), (Sphere(0.2), ((0, 0.5, 0), UNIT))])
    model, _, _ = single(shape, mass=None, density=700.0)
    properties = shape.mass_properties()
    axes = rotation_matrix(model.inertia_frame[0])
    tensor = axes @ np.diag(model.inertia[0]) @ axes.T
    mass = 700.0 * properties.volume
    np.testing.assert_allclose(model.mass[0], mass, rtol=1e-14)
    np.testing.assert_allclose(tensor, mass * properties.unit_inertia, atol=1e-13 * mass)
    assert np.trace(axes) > 1.0  # no more turned than need be: less than a right angle


def test_what_no_body_needs_is_absent():
    for shape in (
        Box((1, 2, 3)),
        Cylinder(1.0, 2.0),
        Polyhedron(BOX_CORNERS * [1, 2, 3] + [7, 0, 0]),
        Compound([(Box((1, 2, 3)), ((0, 0, 0), UNIT))]),
        Compound([(Sphere(1.0), ((4, 5, 6), TURN))]),  # around its centre of mass the sphere is at the origin
    ):
        model, _, _ = single(shape)
        assert model.inertia_frame is None
        assert not any(name.startswith("local") for named in model.shapes.values() for name in named)


def test_a_cube_of_points_is_spherical():
    model, _, _ = single(Polyhedron(BOX_CORNERS))
    assert model.scene.spherical == (True,)


def test_compound_is_flattened():
    shape = Compound(
        [(Sphere(0.1), ((1, 0, 0), UNIT)), (Capsule(0.1, 0.2), ((-1, 0, 0), UNIT)), (Sphere(0.1), ((0, 1, 0), UNIT))]
    )
    model, _, _ = single(shape)
    assert [(entry.kind, entry.body, entry.index) for entry in model.scene.shapes] == [
        ("sphere", 0, 0), ("capsule", 0, 0), ("sphere", 0, 1),
    ]  # fmt: skip
    assert model.shapes["sphere"]["local_position"].shape == (2, 3)
    assert "local_orientation" not in model.shapes["sphere"]
    assert "local_orientation" not in model.shapes["capsule"]
    assert not model.scene.pair_groups  # parts of one body do not collide


def floor_contacts(shape, **body):
    builder = SceneBuilder()
    builder.add_body(Plane((0, 1, 0), 0.0), static=True)
    builder.add_body(shape, mass=1.0, **body)
    found = contacts(*builder.build(undamped()))
    order = np.lexsort(np.round(np.asarray(found.position).T, 9))
    return np.asarray(found.position)[order], np.asarray(found.separation)[order]


@pytest.mark.parametrize("shape", [Box((0.3, 0.5, 0.7)), Sphere(0.4), Capsule(0.2, 0.6)], ids=lambda shape: shape.kind)
def test_contacts_of_a_part_are_those_of_the_shape_at_its_place(shape, float64):
    """A compound of one shape in a turned and shifted pose, against the shape itself."""
    offset, position = np.array([0.4, -0.2, 0.9]), np.array([1.0, 0.8, -2.0])
    whole = Rotation.from_quat(TURN[[1, 2, 3, 0]])
    turned = (whole * Rotation.from_quat(OTHER[[1, 2, 3, 0]])).as_quat()[[3, 0, 1, 2]]
    direct = floor_contacts(shape, position=position + whole.apply(offset), orientation=turned)
    ballast = (Sphere(0.1), ((0.0, 5.0, 0.0), UNIT))  # moves the centre of mass away from the part
    alone = floor_contacts(Compound([(shape, (offset, OTHER))]), position=position, orientation=TURN)
    both = floor_contacts(Compound([(shape, (offset, OTHER)), ballast]), position=position, orientation=TURN)
    np.testing.assert_allclose(alone[0], direct[0], atol=1e-12)
    np.testing.assert_allclose(alone[1], direct[1], atol=1e-12)
    for point, separation in zip(*direct, strict=True):
        row = np.argmin(np.linalg.norm(both[0] - point, axis=1))
        np.testing.assert_allclose(both[0][row], point, atol=1e-12)
        np.testing.assert_allclose(both[1][row], separation, atol=1e-12)


def test_contacts_are_differentiable_in_the_place_of_a_part(float64):
    builder = SceneBuilder()
    builder.add_body(Plane((0, 1, 0), 0.0), static=True)
    parts = [(Sphere(0.1), ((0.5, 0.0, 0.0), UNIT)), (Sphere(0.1), ((-0.5, 0.0, 0.0), UNIT))]
    builder.add_body(Compound(parts), mass=1.0, position=(0, 1, 0), orientation=TURN)
    model, state = builder.build(undamped())

    def separation(local):
        shapes = {**model.shapes, "sphere": {**model.shapes["sphere"], "local_position": local}}
        return contacts(dataclasses.replace(model, shapes=shapes), state).separation

    jacobian = jax.jacobian(separation)(model.shapes["sphere"]["local_position"])
    up = rotation_matrix(TURN)[1]  # the world's vertical in the body frame
    np.testing.assert_allclose(jacobian, np.eye(2)[:, :, None] * up, atol=1e-12)


def test_pairs_without_a_function_are_a_clear_error():
    builder = SceneBuilder()
    builder.add_body(Heightfield(np.zeros((3, 3)), 1.0), static=True, name="hills")
    with pytest.raises(ValueError, match="pass static=True"):
        builder.add_body(Heightfield(np.zeros((3, 3)), 1.0), mass=1.0)
    builder.add_body(Heightfield(np.zeros((3, 4)), 1.0), static=True, name="dunes")
    with pytest.raises(ValueError, match=r"'hills' has \(3, 3\) and 'dunes' has \(3, 4\); resample"):
        builder.build()


def test_polyhedra_of_different_size_share_one_array():
    builder = SceneBuilder()
    builder.add_body(Polyhedron(BOX_CORNERS), mass=1.0, collides=False)
    builder.add_body(Polyhedron(WEDGE), mass=1.0, collides=False)
    model, _ = builder.build()
    vertices = np.asarray(model.shapes["polyhedron"]["vertices"])
    assert vertices.shape == (2, 8, 3)
    np.testing.assert_array_equal(vertices[1, 6:], vertices[1, [0, 0]])
    assert [len(faces) for faces in model.scene.faces] == [6, 5]
    hash(model.scene)


def test_placed_shapes_have_the_layout_of_pair_functions(float64):
    """Vertices first, faces alike; every face of every pair outside of its polyhedron; bounds around the corners."""
    wedge, cube = Polyhedron(WEDGE), Polyhedron(BOX_CORNERS)
    builder = SceneBuilder()
    hills = Heightfield(np.arange(12.0).reshape(3, 4), 0.5)
    builder.add_body(hills, static=True, collides=False)
    for shape in (cube, wedge, Compound([(wedge, ((0, 3, 0), OTHER)), (cube, ((0, -3, 0), TURN))])):
        builder.add_body(shape, mass=1.0, position=(1, 2, 3), orientation=TURN, collides=False)
    model, state = builder.build()
    shapes = jax.tree.map(lambda x: x[..., None], model.shapes)
    bodies = unpack(jax.tree.map(lambda x: x[..., None], state))
    rows, owners = (0, 2, 1, 3, 2), (1, 3, 2, 3, 3)
    found = shape_parameters(model.scene, shapes, "polyhedron", rows)
    pose = shape_poses(shapes, "polyhedron", rows, owners, bodies.position, bodies.orientation)
    vertices = np.stack([np.asarray(component)[..., 0] for component in found["vertices"]], axis=-1)
    assert vertices.shape == (8, 5, 3)
    assert found["faces"].dtype == np.int32
    assert found["faces"].shape == (5, 6, 4)
    low, high = (np.stack([np.asarray(c)[:, 0] for c in corner], -1) for corner in aabb("polyhedron", found, pose))
    for pair, (shape, local, turn) in enumerate(
        [
            (cube, 0, UNIT),
            (wedge, (0, 3, 0), OTHER),
            (wedge, 0, UNIT),
            (cube, (0, -3, 0), TURN),
            (wedge, (0, 3, 0), OTHER),
        ]
    ):
        truth = shape.vertices @ rotation_matrix(turn).T + local
        truth = truth @ rotation_matrix(TURN).T + (1, 2, 3)
        np.testing.assert_allclose(np.stack([low[pair], high[pair]]), [truth.min(0), truth.max(0)], rtol=1e-12)
        corners = vertices[found["faces"][pair], pair]
        assert {tuple(face) for face in found["faces"][pair]} == {f + f[-1:] * (4 - len(f)) for f in shape.faces}
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
        inside = vertices[:, pair].mean(0)
        assert np.all(np.einsum("fx,fx->f", normal, corners[:, 0] - inside) > 0)
    field = shape_parameters(model.scene, shapes, "heightfield", (0,))
    assert field["heights"].shape == (3, 4, 1, 1)
    assert shape_parameters(model.scene, shapes, "polyhedron", (1, 1, 1))["faces"].shape == (1, 5, 4)


def test_joint_anchors_are_seen_from_the_centre_of_mass(float64):
    """A wedge on a hinge starts to swing like a physical pendulum: alpha = torque / (I + m d^2)."""
    shape = Polyhedron(WEDGE)
    builder = SceneBuilder(gravity=(0, -9.8, 0))
    post = builder.add_body(Sphere(0.1), static=True, collides=False)
    wedge = builder.add_body(shape, mass=3.0, position=(1.0, 2.0, 3.0))
    pivot = np.array([1.5, 2.2, 3.3])
    builder.add_joint(Hinge(parent=post, child=wedge, anchor=pivot, axis=(0, 0, 1)))
    dt = 1e-4
    model, state = builder.build(undamped(dt=dt, velocity_iterations=200))
    arm = np.asarray(state.position[wedge]) - pivot
    tensor = shape.mass_properties().unit_inertia
    expected = -9.8 * arm[0] / (tensor[2, 2] + arm[0] ** 2 + arm[1] ** 2)
    spin = np.asarray(step(model, state).angular_velocity[wedge]) / dt
    np.testing.assert_allclose(spin, [0, 0, expected], atol=2e-4 * abs(expected))


def test_parameters_of_a_scene_run_in_a_batch():
    model, state, _ = single(
        Compound([(Box((0.1, 0.4, 0.2)), ((0.3, 0, 0), TURN)), (Sphere(0.2), ((0, 0.5, 0), UNIT))])
    )
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    many = jax.vmap(step, in_axes=(None, 0))(model, batch)
    np.testing.assert_allclose(many.orientation[1], step(model, state).orientation, atol=1e-6)
