"""Shapes: validation and mass properties against quadrature that does not use their formulas."""

import itertools

import numpy as np
import pytest

from mathota_jax.geometry import SHAPES, Box, Capsule, Plane, Sphere

EXAMPLES = {
    "sphere": Sphere(0.7),
    "capsule": Capsule(0.3, 0.8),
    "box": Box((0.2, 0.5, 1.1)),
    "plane": Plane((0.0, 2.0, 0.0), 0.5),
}
SOLIDS = [kind for kind in SHAPES if kind != "plane"]


def _slices(shape, z):
    """Cross-section half widths of each solid at local y = z: radius of the disc, or the rectangle (x, z)."""
    if isinstance(shape, Sphere):
        return np.sqrt(np.clip(shape.radius**2 - z**2, 0, None))
    return np.sqrt(np.clip(shape.radius**2 - np.clip(np.abs(z) - shape.half_height, 0, None) ** 2, 0, None))


def _quadrature(shape):
    """Volume and unit moments by integrating discs (or rectangles) along local y with Gauss-Legendre panels."""
    if isinstance(shape, Box):
        reach, breaks = shape.half_extents[1], [-shape.half_extents[1], shape.half_extents[1]]
    elif isinstance(shape, Capsule):
        reach = shape.radius + shape.half_height
        breaks = [-reach, -shape.half_height, shape.half_height, reach]
    else:
        reach, breaks = shape.radius, [-shape.radius, shape.radius]
    nodes, weights = np.polynomial.legendre.leggauss(40)
    volume = about_y = about_x = about_z = 0.0
    for low, high in itertools.pairwise(breaks):
        y = 0.5 * (high + low) + 0.5 * (high - low) * nodes
        dy = 0.5 * (high - low) * weights
        if isinstance(shape, Box):
            hx, _, hz = shape.half_extents
            area = np.full_like(y, 4 * hx * hz)
            xx, zz = area * hx**2 / 3, area * hz**2 / 3
        else:
            r = _slices(shape, y)
            area = np.pi * r**2
            xx = zz = np.pi * r**4 / 4
        volume += (area * dy).sum()
        about_x += ((zz + area * y**2) * dy).sum()
        about_y += ((xx + zz) * dy).sum()
        about_z += ((xx + area * y**2) * dy).sum()
    return volume, np.array([about_x, about_y, about_z]) / volume


def test_registry_has_an_example_of_every_shape():
    assert set(EXAMPLES) == set(SHAPES)


@pytest.mark.parametrize("kind", SHAPES)
def test_kind_and_parameters(kind):
    shape = EXAMPLES[kind]
    assert type(shape) is SHAPES[kind]
    assert shape.kind == kind
    for name, value in shape.parameters().items():
        assert isinstance(value, np.ndarray)
        assert value.dtype == np.float64
        np.testing.assert_array_equal(value, getattr(shape, name))


@pytest.mark.parametrize("kind", SOLIDS)
def test_volume_and_inertia_match_quadrature(kind):
    shape = EXAMPLES[kind]
    volume, moments = _quadrature(shape)
    np.testing.assert_allclose(shape.volume(), volume, rtol=1e-12)
    np.testing.assert_allclose(shape.unit_inertia(), moments, rtol=1e-12)


def test_guide_examples():
    np.testing.assert_allclose(Sphere(0.5).unit_inertia(), 0.1)
    np.testing.assert_allclose(2 * Box((0.5, 1.0, 0.5)).unit_inertia(), [5 / 6, 1 / 3, 5 / 6])


def test_capsule_tends_to_sphere_and_to_rod():
    np.testing.assert_allclose(Capsule(0.5, 1e-9).unit_inertia(), Sphere(0.5).unit_inertia(), rtol=1e-7)
    np.testing.assert_allclose(Capsule(1e-6, 2.0).unit_inertia()[0], 4.0**2 / 12, rtol=1e-5)


@pytest.mark.parametrize("kind", SOLIDS)
def test_radii_bound_the_shape(kind):
    shape = EXAMPLES[kind]
    if kind == "box":
        farthest, nearest = np.linalg.norm(shape.half_extents), min(shape.half_extents)
    else:
        reach = shape.radius + getattr(shape, "half_height", 0.0)
        farthest, nearest = reach, shape.radius
    assert shape.bounding_radius() == pytest.approx(farthest)
    assert shape.inradius() == pytest.approx(nearest)


def test_plane_normalises_and_has_no_mass():
    plane = Plane((0.0, 3e-200, 4e-200), 2.0)
    np.testing.assert_allclose(plane.normal, [0, 0.6, 0.8], rtol=1e-14)
    for ask in (plane.volume, plane.unit_inertia):
        with pytest.raises(ValueError, match="static=True"):
            ask()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Sphere(-1.0), r"Sphere\.radius must be a positive finite number, got -1\.0"),
        (lambda: Sphere(0.0), r"Sphere\.radius"),
        (lambda: Sphere(float("nan")), r"Sphere\.radius"),
        (lambda: Sphere([1.0, 2.0]), r"Sphere\.radius"),
        (lambda: Sphere("big"), r"Sphere\.radius must be numeric"),
        (lambda: Sphere(None), r"Sphere\.radius"),
        (lambda: Capsule(0.1, -1.0), r"Capsule\.half_height"),
        (lambda: Capsule(float("inf"), 1.0), r"Capsule\.radius"),
        (lambda: Box((1.0, 2.0)), r"Box\.half_extents must be three finite numbers"),
        (lambda: Box(1.0), r"Box\.half_extents"),
        (lambda: Box((1.0, 0.0, 1.0)), r"Box\.half_extents must be positive"),
        (lambda: Box((1.0, float("nan"), 1.0)), r"Box\.half_extents"),
        (lambda: Plane((0.0, 0.0, 0.0)), r"Plane\.normal must not be the zero vector"),
        (lambda: Plane((0.0, 1.0)), r"Plane\.normal"),
        (lambda: Plane((0.0, 1.0, 0.0), float("inf")), r"Plane\.offset must be a finite number"),
    ],
)
def test_bad_arguments_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_shapes_do_not_alias_the_callers_array():
    half = np.array([1.0, 2.0, 3.0])
    box = Box(half)
    half[0] = 9.0
    box.parameters()["half_extents"][1] = 9.0
    np.testing.assert_array_equal(box.half_extents, [1.0, 2.0, 3.0])
