"""Queries about two shapes against closed forms: distances, contact points, times of impact, derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mathota_jax
from mathota_jax import (
    Box,
    Capsule,
    Cone,
    Cylinder,
    Geometry,
    Heightfield,
    Plane,
    Sphere,
    closest_points,
    manifold,
    signed_distance,
)
from mathota_jax.collision.pairs import CLOSED_FORM, PAIRS, SEPARATING_AXES
from mathota_jax.geometry import SHAPES
from tests.marks import QUICK_AND_SLOW_PRECISION
from tests.poses import UPRIGHT, at, turned

QUICK_METHODS = (CLOSED_FORM, SEPARATING_AXES)


def example(kind):
    points = Rotation.from_rotvec([0.3, 0.2, 0.1]).apply(np.random.default_rng(1).normal(size=(12, 3)))
    return {
        "plane": lambda: Plane((0.0, 1.0, 0.0), 0.2),
        "sphere": lambda: Sphere(0.4),
        "capsule": lambda: Capsule(0.2, 0.5),
        "box": lambda: Box((0.3, 0.4, 0.5)),
        "cylinder": lambda: mathota_jax.Cylinder(0.3, 0.4),
        "cone": lambda: mathota_jax.Cone(0.3, 0.4),
        "polyhedron": lambda: mathota_jax.Polyhedron(0.4 * points / np.linalg.norm(points, axis=1)[:, None]),
        "heightfield": lambda: mathota_jax.Heightfield(np.zeros((3, 3)), 1.0),
    }[kind]()


@pytest.mark.parametrize(
    ("shape_a", "pose_a", "shape_b", "pose_b", "separation", "normal"),
    [
        (Sphere(1.0), at(-1.5, 0, 0), Sphere(1.0), at(1.5, 0, 0), 1.0, (1, 0, 0)),
        (Sphere(3.0), at(-1, 0, 0), Sphere(3.0), at(3, 0, 0), -2.0, (1, 0, 0)),
        (Box((2.5, 2.5, 2.5)), at(-1, 0, 0), Box((1.0, 1.0, 1.0)), at(1.5, 0, 0), -1.0, (1, 0, 0)),
        (Box((2.0, 1.0, 1.0)), at(0, 0, 0), Box((2.0, 1.0, 1.0)), at(3.5, 0, 0), -0.5, (1, 0, 0)),
        (Sphere(0.5), at(0, 2, 0), Plane((0, 1, 0), 0.25), at(0, 0, 0), 1.25, (0, -1, 0)),
        (Plane((0, 1, 0), 0.0), at(0, 1, 0, orientation=turned((0, 0, 1), np.pi / 2)), Sphere(0.5), at(-2, 9, 9), 1.5,
         (-1, 0, 0)),
        (Capsule(0.1, 1.0), at(0, 0, 0), Capsule(0.2, 1.0), at(0, 0, 1, orientation=turned((0, 0, 1), np.pi / 2)), 0.7,
         (0, 0, 1)),
    ],
)  # fmt: skip
def test_closed_forms(precision, shape_a, pose_a, shape_b, pose_b, separation, normal, gate):
    limit = 1e-12 if precision == "float64" else 1e-6
    for sign, arguments in ((1, (shape_a, pose_a, shape_b, pose_b)), (-1, (shape_b, pose_b, shape_a, pose_a))):
        found = signed_distance(*arguments)
        gate("separation", found.separation - separation, limit)
        gate("normal", found.normal - sign * np.asarray(normal), limit)
        gate("between the points", found.point_b - found.point_a - separation * found.normal, 4 * limit)
        np.testing.assert_array_equal(closest_points(*arguments), (found.point_a, found.point_b))


@pytest.mark.parametrize(
    ("kind_a", "kind_b"),
    [pytest.param(*pair, marks=() if PAIRS[pair].method in QUICK_METHODS else pytest.mark.slow) for pair in PAIRS],
)
def test_every_pair_answers_with_finite_derivatives(float64, kind_a, kind_b):
    """The derivative by the position of B is the normal (envelope theorem), in either order of the arguments."""
    shape_a, shape_b = Geometry.of(example(kind_a)), Geometry.of(example(kind_b))
    if kind_b == "heightfield":
        shape_b = dataclasses.replace(shape_b, window=2)  # its sizes are traced below
    pose_a = at(0.1, 0.2, -0.1, orientation=turned((0.6, 0.8, 0.0), 0.4))
    pose_b = at(0.5, 1.3, 0.3, orientation=turned((0.0, 0.6, 0.8), 0.7))

    def gap(a, pose_a, b, pose_b):
        return signed_distance(a, pose_a, b, pose_b).separation

    found = signed_distance(shape_a, pose_a, shape_b, pose_b)
    value, gradient = jax.value_and_grad(gap, argnums=(0, 1, 2, 3))(shape_a, pose_a, shape_b, pose_b)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    np.testing.assert_allclose(gradient[3][0], found.normal, atol=1e-9)
    np.testing.assert_allclose(gradient[1][0], -found.normal, atol=1e-9)
    reverse = signed_distance(shape_b, pose_b, shape_a, pose_a)
    np.testing.assert_allclose(reverse.separation, value, atol=1e-12)
    np.testing.assert_allclose(reverse.normal, -found.normal, atol=1e-12)
    points = manifold(shape_a, pose_a, shape_b, pose_b)
    assert points.active[0]
    np.testing.assert_allclose(points.separation[points.active].min(), value, atol=1e-12)


def test_shapes_made_inside_of_jit_are_known():
    """How many cells of a heightfield a shape covers is decided by sizes that are not traced there."""

    def gap(height):
        pose = (jnp.array([0.1, 0.0, 0.2]).at[1].set(height), at(0, 0, 0)[1])
        return signed_distance(Heightfield(np.zeros((5, 5)), 0.5), at(0, 0, 0), Sphere(0.15), pose).separation

    np.testing.assert_allclose(jax.jit(gap)(0.4), 0.25, rtol=1e-6)


def test_derivatives_by_sizes(float64):
    """A radius or half extent that grows closes the gap at the same rate."""

    def gap(sphere, box):
        return signed_distance(sphere, at(0, 3, 0), box, at(0.2, 0, 0.1)).separation

    sphere, box = Geometry.of(Sphere(0.5)), Geometry.of(Box((1.0, 1.5, 2.0)))
    by_sphere, by_box = jax.grad(gap, argnums=(0, 1))(sphere, box)
    np.testing.assert_allclose(by_sphere.parameters["radius"], -1.0, atol=1e-12)
    np.testing.assert_allclose(by_box.parameters["half_extents"], [0.0, -1.0, 0.0], atol=1e-12)


def test_mapped_over_pairs_and_sizes(float64):
    radii = jnp.linspace(0.1, 0.9, 5)
    heights = jnp.linspace(1.0, 3.0, 5)

    def gap(radius, height):
        sphere = dataclasses.replace(Geometry.of(Sphere(1.0)), parameters={"radius": radius})
        return signed_distance(
            Plane((0, 1, 0)), at(0, 0, 0), sphere, (jnp.array([0.0, height, 0.0]), jnp.array(UPRIGHT))
        )

    found = jax.jit(jax.vmap(gap))(radii, heights)
    np.testing.assert_allclose(found.separation, heights - radii, atol=1e-12)
    assert found.point_b.shape == (5, 3)


def test_box_flat_on_a_box_has_four_contact_points():
    found = manifold(Box((1, 1, 1)), at(0, 0, 0), Box((0.5, 0.5, 0.5)), at(0, 1.45, 0))
    assert found.active.all() and found.position.shape == (4, 3)
    np.testing.assert_allclose(found.separation, -0.05, atol=1e-6)
    np.testing.assert_allclose(sorted(map(tuple, np.asarray(found.position)[:, [0, 2]].round(5).tolist())),
                               [(-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)])  # fmt: skip


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
@pytest.mark.parametrize(
    ("sizes", "pose_a", "pose_b"),
    [
        # Found by `tests.benchmarks.pose_classes`: points 3.4 and 1.8 mm below the surfaces, and 0.4 mm above the deepest.
        (
            (0.557, 0.4218, 0.6451, 0.215),
            (0.102, 0.0521, -0.0111, 0.1546, 0.2639, -0.5337, 0.7885),
            (0.6318, -0.6071, 0.5793, -0.5457, -0.0704, -0.0159, 0.8349),
        ),
        (
            (0.3794, 0.7855, 0.6488, 0.6618),
            (-0.004, 0.1346, -0.1042, 0.082, -0.5626, 0.728, -0.3831),
            (-1.0603, -0.4934, -1.5133, 0.0865, -0.3101, -0.8979, 0.3003),
        ),
        (
            (0.8557, 0.3606, 0.6449, 0.9224),
            (0.1157, -0.0353, -0.0195, 0.0761, 0.4921, 0.5822, -0.6427),
            (-0.1579, -1.0001, -1.042, -0.3433, 0.7468, -0.0543, 0.567),
        ),
    ],
)
def test_the_deepest_contact_point_is_at_the_distance(precision, sizes, pose_a, pose_b):
    """A steep face against a flat one: neither deeper (a phantom contact) nor shallower than the shapes are."""
    shapes = Cylinder(*sizes[:2]), Cone(*sizes[2:])
    poses = [at(*pose[:3], orientation=np.array(pose[3:]) / np.linalg.norm(pose[3:])) for pose in (pose_a, pose_b)]
    found = manifold(shapes[0], poses[0], shapes[1], poses[1])
    expected = signed_distance(shapes[0], poses[0], shapes[1], poses[1]).separation
    least = np.where(found.active, found.separation, np.inf).min()
    assert abs(least - expected) < (2e-5 if precision == np.float32 else 1e-6)


@pytest.mark.parametrize(
    ("radius", "half_height", "half_extents", "pose_a", "pose_b"),
    [
        # Steep capsules whose closest point lies beside a face: the part over the face is 48 and 13 mm higher.
        (
            0.9305, 0.6743, (0.996, 0.3936, 0.2852),
            (-0.1251, -0.0159, 0.0676, -0.1843, 0.7453, 0.4531, -0.453),
            (-1.3733, 1.2017, 0.8688, 0.4339, 0.7519, 0.4706, 0.1575),
        ),
        (
            0.7851, 0.2979, (0.6183, 0.2161, 0.7457),
            (0.1169, -0.0409, -0.1938, -0.6793, -0.1572, 0.7137, -0.0668),
            (0.4776, 1.3709, 0.4449, -0.8031, -0.2052, 0.5533, -0.0824),
        ),
    ],
)  # fmt: skip
def test_a_steep_capsule_beside_a_face(precision, radius, half_height, half_extents, pose_a, pose_b):
    shapes = Capsule(radius, half_height), Box(half_extents)
    poses = [at(*pose[:3], orientation=np.array(pose[3:]) / np.linalg.norm(pose[3:])) for pose in (pose_a, pose_b)]
    found = manifold(shapes[0], poses[0], shapes[1], poses[1])
    near = signed_distance(shapes[0], poses[0], shapes[1], poses[1])
    assert abs(np.where(found.active, found.separation, np.inf).min() - near.separation) < 2e-5
    np.testing.assert_allclose(found.normal, near.normal, atol=1e-5)


@pytest.mark.parametrize("depth", [1e-6, 1e-5, 1e-4])
def test_axes_of_capsules_that_all_but_meet(precision, depth):
    """The normal is across both axes, not the difference of the closest points, which is round-off."""
    turn = turned((0.36, 0.48, 0.8), 0.7)
    rotation = Rotation.from_quat(turn[[1, 2, 3, 0]])
    crossed = (rotation * Rotation.from_rotvec([0, 0, 1.1])).as_quat()[[3, 0, 1, 2]]
    place = np.array([0.3, -0.7, 0.2])
    shape = Capsule(0.4, 0.9)
    poses = at(*place, orientation=turn), at(*(place + rotation.apply([0, 0.1, depth])), orientation=crossed)
    found = signed_distance(shape, poses[0], shape, poses[1])
    np.testing.assert_allclose(found.separation, depth - 0.8, atol=1e-6)
    np.testing.assert_allclose(
        found.normal, rotation.apply([0, 0, 1.0]), atol=2e-6 if precision == np.float32 else 1e-12
    )


# ---- bad input ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("ball", at(0, 0, 0), Sphere(1), at(0, 0, 0)),
            "signed_distance: expected one of the shapes Plane, .* got 'ball'",
        ),
        ((Sphere(1), (np.zeros(2), np.ones(4)), Sphere(1), at(0, 0, 0)), r"pose_a must be \(position, orientation\)"),
        ((Sphere(1), at(0, 0, 0), Sphere(1), (np.zeros((5, 3)), np.ones((5, 4)))), "pose_b must be .* use jax.vmap"),
        ((Plane((0, 1, 0)), at(0, 0, 0), Plane((0, 1, 0)), at(0, 0, 0)), "no distance between a plane and a plane"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        signed_distance(*arguments)


def test_every_shape_has_an_example():
    assert all(example(kind).kind == kind for kind in SHAPES)
