"""Shapes: validation, mass properties against quadrature that does not use their formulas, bounds against samples."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay
from scipy.spatial.transform import Rotation

from mathota_jax.geometry import (
    SHAPES,
    Box,
    Capsule,
    Compound,
    Cone,
    Cylinder,
    Heightfield,
    Plane,
    Polyhedron,
    Sphere,
)
from mathota_jax.geometry.bounds import aabb, bounding_radius
from mathota_jax.geometry.mass import combine, mass_properties
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, to_matrix
from mathota_jax.spatial.vector import Vec3
from tests.hulls import BOX_CORNERS

PRISM = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.5, 1.6, 0], [0, 1, 0]])  # a house, 5 corners
PRISM = np.concatenate([PRISM, PRISM + np.array([0.2, 0.1, 0.7])])
CLOUD = np.random.default_rng(3).normal(size=(40, 3)) * [1.0, 0.4, 0.2] + [2.0, -1.0, 0.5]
HILLS = 0.3 * np.random.default_rng(5).normal(size=(6, 4)) + 0.4

EXAMPLES = {
    "sphere": Sphere(0.7),
    "capsule": Capsule(0.3, 0.8),
    "box": Box((0.2, 0.5, 1.1)),
    "plane": Plane((0.0, 2.0, 0.0), 0.5),
    "cylinder": Cylinder(0.6, 0.25),
    "cone": Cone(0.5, 0.9),
    "polyhedron": Polyhedron(PRISM),
    "heightfield": Heightfield(HILLS, 0.5),
}
QUARTER = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
TURN = tuple(Rotation.from_rotvec([0.3, -0.8, 0.5]).as_quat()[[3, 0, 1, 2]])
SOLIDS = {
    **{kind: shape for kind, shape in EXAMPLES.items() if not shape.static_only},
    "flat cone": Cone(2.0, 0.2),
    "rod": Cylinder(0.01, 1.0),
    "cloud": Polyhedron(CLOUD),
    "plate": Polyhedron(BOX_CORNERS * [1.0, 1e-3, 1.0]),
    "hammer": Compound([(Cylinder(0.1, 0.6), ((0, 0, 0), QUARTER)), (Box((0.2, 0.3, 0.2)), ((0.8, 0.1, 0), TURN))]),
    "mixed": Compound(
        [
            (Sphere(0.2), ((1, 0, 0), (1, 0, 0, 0))),
            (Cone(0.3, 0.2), ((0, 1, 0), TURN)),
            (Polyhedron(CLOUD), ((-3, 1, 1), TURN)),
        ]
    ),
}


# ---- truth: points and weights that integrate every quadratic polynomial over the solid exactly ----------------------


def nodes(shape):
    if isinstance(shape, Compound):
        parts = [(part, *nodes(part.shape)) for part in shape.parts]
        turned = [Rotation.from_quat(part.orientation[[1, 2, 3, 0]]).apply(p) + part.position for part, p, _ in parts]
        return np.concatenate(turned), np.concatenate([weights for *_, weights in parts])
    if isinstance(shape, Box):
        return BOX_CORNERS / np.sqrt(3) * shape.half_extents, np.full(8, np.prod(shape.half_extents))
    if isinstance(shape, Polyhedron):
        # Tetrahedra of a Delaunay triangulation, each with the four-point rule of degree 2.
        tetrahedra = shape.vertices[Delaunay(shape.vertices).simplices]
        volume = np.abs(np.linalg.det(tetrahedra[:, 1:] - tetrahedra[:, :1])) / 6
        inner, outer = (5 - np.sqrt(5)) / 20, (5 + 3 * np.sqrt(5)) / 20
        points = np.einsum("ab,tbx->tax", inner + (outer - inner) * np.eye(4), tetrahedra)
        return points.reshape(-1, 3), np.repeat(volume / 4, 4)
    if isinstance(shape, Cone):
        breaks = [-0.5 * shape.half_height, 1.5 * shape.half_height]
    else:
        reach = getattr(shape, "half_height", 0.0) + (0.0 if isinstance(shape, Cylinder) else shape.radius)
        breaks = sorted({-reach, -getattr(shape, "half_height", -reach), getattr(shape, "half_height", reach), reach})
    x, w = np.polynomial.legendre.leggauss(40)
    points, weights = [], []
    for low, high in itertools.pairwise(breaks):
        y = 0.5 * (high + low) + 0.5 * (high - low) * x
        r = radius_at(shape, y)
        # A disc by four points on its radius of gyration.
        for cosine, sine in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            points.append(np.stack([cosine * r / np.sqrt(2), y, sine * r / np.sqrt(2)], axis=1))
            weights.append(np.pi * r**2 / 4 * 0.5 * (high - low) * w)
    return np.concatenate(points), np.concatenate(weights)


def radius_at(shape, y):
    if isinstance(shape, Cylinder):
        return np.full_like(y, shape.radius)
    if isinstance(shape, Cone):
        return shape.radius * (1.5 * shape.half_height - y) / (2 * shape.half_height)
    half_height = getattr(shape, "half_height", 0.0)
    return np.sqrt(np.clip(shape.radius**2 - np.clip(np.abs(y) - half_height, 0, None) ** 2, 0, None))


def integrated(shape):
    """Volume, centre and unit inertia tensor."""
    points, weights = nodes(shape)
    volume = weights.sum()
    center = weights @ points / volume
    arm = points - center
    second = np.einsum("n,nx,ny->xy", weights, arm, arm) / volume
    return volume, center, np.trace(second) * np.eye(3) - second


def surface(shape, count=400):
    """Dense points (n, 3) of the surface, extreme points included as far as the grid has them."""
    angle = np.linspace(0, 2 * np.pi, 2 * count, endpoint=False)
    if isinstance(shape, Box):
        return BOX_CORNERS * shape.half_extents
    if isinstance(shape, Polyhedron):
        return shape.vertices
    if isinstance(shape, Heightfield):
        rows, columns = shape.heights.shape
        x, z = np.meshgrid(np.arange(rows) - (rows - 1) / 2, np.arange(columns) - (columns - 1) / 2, indexing="ij")
        return np.stack([x * shape.cell_size, shape.heights, z * shape.cell_size], axis=-1).reshape(-1, 3)
    if isinstance(shape, Sphere | Capsule):
        height = getattr(shape, "half_height", 0.0)
        polar = np.linspace(0, np.pi, count)
        y = shape.radius * np.cos(polar)
        r, y = shape.radius * np.sin(polar), y + np.where(y >= 0, height, -height)
    else:
        low = -0.5 * shape.half_height if isinstance(shape, Cone) else -shape.half_height
        y = np.linspace(low, low + 2 * shape.half_height, 50)
        r = radius_at(shape, y)
    ring = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=-1)
    return (r[:, None, None] * ring + y[:, None, None] * np.array([0, 1.0, 0])).reshape(-1, 3)


# ---- classes ---------------------------------------------------------------------------------------------------------


def test_registry_has_an_example_of_every_shape():
    assert list(SHAPES) == ["plane", "sphere", "capsule", "box", "cylinder", "cone", "polyhedron", "heightfield"]
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


@pytest.mark.parametrize("name", SOLIDS)
def test_mass_properties_match_quadrature(name):
    shape = SOLIDS[name]
    volume, center, inertia = integrated(shape)
    size = np.sqrt(np.trace(inertia))
    np.testing.assert_allclose(shape.volume(), volume, rtol=1e-12)
    np.testing.assert_allclose(shape.center_of_mass(), center, rtol=0, atol=1e-12 * (size + np.abs(center).max()))
    np.testing.assert_allclose(shape.mass_properties().unit_inertia, inertia, rtol=0, atol=1e-12 * size**2)
    np.testing.assert_allclose(np.sort(shape.unit_inertia()), np.linalg.eigvalsh(inertia), rtol=1e-11)


def test_polyhedra_agree_with_trimesh():
    trimesh = pytest.importorskip("trimesh")
    for points in (PRISM, CLOUD, BOX_CORNERS * [1, 2, 3] + 10):
        shape, mesh = Polyhedron(points), trimesh.Trimesh(points).convex_hull
        mesh.density = 1.0 / mesh.volume
        np.testing.assert_allclose(shape.volume(), mesh.volume, rtol=1e-10)
        np.testing.assert_allclose(shape.center_of_mass(), mesh.center_mass, rtol=1e-10)
        np.testing.assert_allclose(shape.mass_properties().unit_inertia, mesh.moment_inertia, atol=1e-8)


def test_guide_examples():
    np.testing.assert_allclose(Sphere(0.5).unit_inertia(), 0.1)
    np.testing.assert_allclose(2 * Box((0.5, 1.0, 0.5)).unit_inertia(), [5 / 6, 1 / 3, 5 / 6])


def test_capsule_tends_to_sphere_and_to_rod():
    np.testing.assert_allclose(Capsule(0.5, 1e-9).unit_inertia(), Sphere(0.5).unit_inertia(), rtol=1e-7)
    np.testing.assert_allclose(Capsule(1e-6, 2.0).unit_inertia()[0], 4.0**2 / 12, rtol=1e-5)


def test_box_as_polyhedron_is_the_box():
    box = Box((0.2, 0.5, 1.1))
    hull = Polyhedron(BOX_CORNERS * box.half_extents)
    assert len(hull.faces) == 6
    np.testing.assert_allclose(hull.unit_inertia(), box.unit_inertia(), rtol=1e-13)
    assert hull.bounding_radius() == pytest.approx(box.bounding_radius(), rel=1e-14)
    assert hull.inradius() == pytest.approx(box.inradius(), rel=1e-14)


@pytest.mark.parametrize("name", SOLIDS)
def test_radii_bound_the_shape(name):
    """The farthest point of the surface, and the nearest plane that touches it, seen from origin and centre of mass."""
    shape = SOLIDS[name]
    if isinstance(shape, Compound):
        turned = [
            Rotation.from_quat(part.orientation[[1, 2, 3, 0]]).apply(surface(part.shape, 60)) + part.position
            for part in shape.parts
        ]
        assert shape.bounding_radius() >= np.linalg.norm(np.concatenate(turned), axis=1).max()
        assert shape.inradius() == min(part.shape.inradius() for part in shape.parts)
        return
    points = surface(shape)
    assert shape.bounding_radius() == pytest.approx(np.linalg.norm(points, axis=1).max(), rel=1e-4)
    hull = ConvexHull(surface(shape, 100))
    distance = -(hull.equations[:, :3] @ shape.center_of_mass() + hull.equations[:, 3])
    assert shape.inradius() == pytest.approx(distance.min(), rel=1e-3)


@pytest.mark.parametrize("shape", [EXAMPLES["plane"], EXAMPLES["heightfield"]], ids=["plane", "heightfield"])
def test_infinite_shapes_have_no_mass(shape):
    assert shape.inradius() == np.inf
    for ask in (shape.volume, shape.unit_inertia):
        with pytest.raises(ValueError, match="static=True"):
            ask()


def test_plane_normalises():
    plane = Plane((0.0, 3e-200, 4e-200), 2.0)
    np.testing.assert_allclose(plane.normal, [0, 0.6, 0.8], rtol=1e-14)
    assert plane.bounding_radius() == np.inf


# ---- hulls -----------------------------------------------------------------------------------------------------------

HULLS = {
    "cube": (BOX_CORNERS, 8, 6),
    "cube of many points": (np.array(list(itertools.product(np.linspace(-1, 1, 5), repeat=3))), 8, 6),
    "prism": (PRISM, 10, 7),
    "tetrahedron": (np.eye(4)[:, :3], 4, 4),
    "plate": (BOX_CORNERS * [1, 1e-3, 1], 8, 6),
    "needle": (BOX_CORNERS * [1e-3, 1, 1e-3], 8, 6),
    "sphere of 64": (np.random.default_rng(0).normal(size=(64, 3)), 64, 124),
}


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e5])
@pytest.mark.parametrize("name", HULLS)
def test_hull_faces_are_whole_and_turn_outwards(name, scale, turned):
    points, vertex_count, face_count = HULLS[name]
    if name.startswith("sphere"):
        points = points / np.linalg.norm(points, axis=1, keepdims=True)
    if turned:  # in float32, so that no face is flat to better than round-off
        points = Rotation.from_rotvec([0.4, 1.1, -0.7]).apply(points).astype(np.float32)
    shape = Polyhedron(points * scale)
    assert (len(shape.vertices), len(shape.faces)) == (vertex_count, face_count)
    center, edges = shape.vertices.mean(0), []
    for face in shape.faces:
        corners = shape.vertices[list(face)]
        for before, here, after in zip(np.roll(corners, 1, 0), corners, np.roll(corners, -1, 0), strict=True):
            normal = np.cross(here - before, after - here)
            assert normal @ (here - center) > 0  # convex corner, counter-clockwise seen from outside
            assert (normal / np.linalg.norm(normal) @ (shape.vertices - here).T).max() < 1e-5 * scale
        edges += zip(face, face[1:] + face[:1], strict=True)
    assert len(set(edges)) == len(edges)
    assert {(b, a) for a, b in edges} == set(edges)
    np.testing.assert_allclose(shape.volume(), ConvexHull(points * scale).volume, rtol=2e-5)


def test_hull_keeps_the_order_and_the_values_of_the_points():
    points = np.concatenate([np.zeros((1, 3)), BOX_CORNERS, BOX_CORNERS[::-1] * 0.5])
    np.testing.assert_array_equal(Polyhedron(points).vertices, BOX_CORNERS)


# ---- derivatives -----------------------------------------------------------------------------------------------------


def flat_mass(kind, parameters):
    volume, center, inertia = mass_properties(kind, parameters)
    return jnp.concatenate([volume[None], center, inertia.reshape(-1)])


def central(function, x, step=1e-6):
    x = np.asarray(x, float)
    columns = []
    for index in np.ndindex(x.shape):
        shift = np.zeros_like(x)
        shift[index] = step
        columns.append((np.asarray(function(x + shift)) - np.asarray(function(x - shift))) / (2 * step))
    return np.stack(columns, axis=-1).reshape(*columns[0].shape, *x.shape)


def mass_jacobian(shape):
    parameters = {key: jnp.asarray(value) for key, value in shape.parameters().items()}
    static = {"faces": shape.faces} if shape.kind == "polyhedron" else {}
    return jax.jacobian(lambda p: flat_mass(shape.kind, {**p, **static}))(parameters)


def integrated_flat(shape):
    volume, center, inertia = integrated(shape)
    return np.concatenate([[volume], center, inertia.reshape(-1)])


@pytest.mark.parametrize("name", ["sphere", "capsule", "box", "cylinder", "cone", "cloud", "plate"])
def test_mass_derivatives_match_central_differences_of_quadrature(name, float64):
    """The truth rebuilds the whole shape, hull included.

    A corner that leaves the plane of its face folds it, and the volume is differentiable to either side only: at the
    rectangles of the plate ours must be the mean of the two, which is what a central difference measures.
    """
    shape = SOLIDS[name]
    exact = mass_jacobian(shape)
    for key, value in shape.parameters().items():
        difference = central(
            lambda v, key=key: integrated_flat(type(shape)(*{**shape.parameters(), key: v}.values())),
            value,
            1e-7 if key == "vertices" else 1e-6,
        )
        tolerance = (2e-5 if key == "vertices" else 1e-7) * np.abs(difference).max()
        np.testing.assert_allclose(exact[key], difference, rtol=0, atol=tolerance)


def test_mass_derivatives_of_a_polyhedron_whose_faces_stay_flat(float64):
    """Linear maps keep the pentagons of a house flat, so the volume is smooth in them."""
    shape = EXAMPLES["polyhedron"]
    exact = np.einsum("ovx,vy->oxy", mass_jacobian(shape)["vertices"], shape.vertices)
    difference = central(lambda matrix: integrated_flat(Polyhedron(shape.vertices @ matrix.T)), np.eye(3), 1e-6)
    np.testing.assert_allclose(exact, difference, rtol=0, atol=1e-8 * np.abs(difference).max())


def test_compound_derivatives_by_parts_and_poses(float64):
    """d(inertia) / d(position of a part), by the parallel axis theorem against quadrature."""
    shape = SOLIDS["hammer"]

    def ours(position):
        parts = [
            (jax.tree.map(jnp.asarray, part.shape.mass_properties()), p, jnp.asarray(part.rotation))
            for part, p in zip(shape.parts, (position, jnp.asarray(shape.parts[1].position)), strict=True)
        ]
        return combine(parts).unit_inertia

    def truth(position):
        pairs = [(part.shape, (part.position, part.orientation)) for part in shape.parts]
        pairs[0] = (pairs[0][0], (position, pairs[0][1][1]))
        return integrated(Compound(pairs))[2]

    here = jnp.asarray(shape.parts[0].position)
    np.testing.assert_allclose(jax.jacobian(ours)(here), central(truth, here), atol=1e-8)


@pytest.mark.parametrize("kind", [kind for kind in SHAPES if not SHAPES[kind].static_only])
def test_mass_properties_run_in_float32_and_batches(kind):
    shape = EXAMPLES[kind]
    static = {"faces": shape.faces} if kind == "polyhedron" else {}
    batch = {key: jnp.stack([jnp.asarray(value, jnp.float32)] * 3) for key, value in shape.parameters().items()}
    volume, center, inertia = jax.vmap(lambda p: mass_properties(kind, {**p, **static}))(batch)
    assert volume.dtype == center.dtype == inertia.dtype == jnp.float32
    truth = integrated(shape)
    np.testing.assert_allclose(volume, np.full(3, truth[0]), rtol=1e-5)
    np.testing.assert_allclose(inertia[1], truth[2], atol=1e-6 * np.trace(truth[2]) * 10)


# ---- bounds ----------------------------------------------------------------------------------------------------------


def engine(kind, parameters, position, quaternion):
    """One element, one world."""

    def components(value):
        value = jnp.asarray(value)
        if value.shape == (3,) and kind in ("box", "plane"):
            return Vec3(*value[:, None, None])
        if kind == "polyhedron":
            return Vec3(*value.T[:, :, None, None])
        return value[..., None, None]

    pose = Pose(
        Vec3(*jnp.asarray(position)[:, None, None]), to_matrix(Quaternion(*jnp.asarray(quaternion)[:, None, None]))
    )
    return {key: components(value) for key, value in parameters.items()}, pose


def bounds(kind, parameters, position, quaternion):
    low, high = aabb(kind, *engine(kind, parameters, position, quaternion))
    shape = jnp.broadcast_shapes(*(c.shape for c in (*low, *high)))
    return jnp.stack([jnp.broadcast_to(c, shape)[0, 0] for c in (*low, *high)])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", SHAPES)
def test_bounds_are_tight(kind, seed, float64):
    shape = EXAMPLES[kind]
    position = np.random.default_rng(seed).normal(size=3)
    turns = Rotation.concatenate([Rotation.identity(), Rotation.from_euler("z", 90, degrees=True)])
    turn = turns[seed] if seed < 2 else Rotation.random(random_state=seed)
    found = np.asarray(bounds(kind, shape.parameters(), position, turn.as_quat()[[3, 0, 1, 2]]))
    if kind == "plane":
        np.testing.assert_array_equal(found, [-np.inf] * 3 + [np.inf] * 3)
        return
    points = turn.apply(surface(shape)) + position
    low, high = points.min(0), points.max(0)
    assert np.all(found[:3] <= low + 1e-12)
    assert np.all(found[3:] >= high - 1e-12)
    if kind != "heightfield" or seed < 2:
        np.testing.assert_allclose(found, np.concatenate([low, high]), atol=1e-4)


@pytest.mark.parametrize("kind", [kind for kind in SHAPES if kind != "plane"])
def test_derivatives_of_bounds_match_central_differences(kind, float64):
    shape = EXAMPLES[kind]
    arguments = ({key: jnp.asarray(v) for key, v in shape.parameters().items()}, jnp.array([0.3, -1.0, 2.0]))
    quaternion = jnp.asarray(TURN)
    exact = jax.jacobian(bounds, argnums=(1, 2, 3))(kind, *arguments, quaternion)
    for key, value in arguments[0].items():
        difference = central(lambda v, key=key: bounds(kind, {**arguments[0], key: v}, arguments[1], quaternion), value)
        np.testing.assert_allclose(exact[0][key], difference, atol=1e-7)
    np.testing.assert_allclose(
        exact[1], central(lambda p: bounds(kind, arguments[0], p, quaternion), arguments[1]), atol=1e-7
    )
    np.testing.assert_allclose(exact[2], central(lambda q: bounds(kind, *arguments, q), quaternion), atol=1e-7)


@pytest.mark.parametrize("kind", [kind for kind in SHAPES if kind != "plane"])
def test_upright_shapes_have_finite_derivatives_of_bounds(kind, float64):
    """Axes along the world's, where sines and maxima are singular."""
    parameters = {key: jnp.asarray(v) for key, v in EXAMPLES[kind].parameters().items()}
    for quaternion in ((1.0, 0, 0, 0), QUARTER):
        jacobians = jax.jacobian(bounds, argnums=(1, 2, 3))(kind, parameters, jnp.zeros(3), jnp.asarray(quaternion))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(jacobians))


@pytest.mark.parametrize("kind", SHAPES)
def test_bounding_radius_of_the_engine_is_that_of_the_class(kind, float64):
    shape = EXAMPLES[kind]
    parameters, _ = engine(kind, shape.parameters(), np.zeros(3), (1.0, 0, 0, 0))
    found = np.asarray(bounding_radius(kind, parameters))
    np.testing.assert_allclose(found.reshape(()), shape.bounding_radius(), rtol=1e-14)
    if kind != "plane":
        assert shape.bounding_radius() == pytest.approx(np.linalg.norm(surface(shape), axis=1).max(), rel=1e-4)


# ---- bad input -------------------------------------------------------------------------------------------------------


def holed(value):
    heights = np.zeros((3, 3))
    heights[1, 2] = value
    return heights


UNIT = (1, 0, 0, 0)


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
        (lambda: Cylinder(0.0, 1.0), r"Cylinder\.radius"),
        (lambda: Cylinder(1.0, -1.0), r"Cylinder\.half_height"),
        (lambda: Cone(float("nan"), 1.0), r"Cone\.radius"),
        (lambda: Cone(1.0, 0.0), r"Cone\.half_height"),
        (lambda: Box((1.0, 2.0)), r"Box\.half_extents must be three finite numbers"),
        (lambda: Box(1.0), r"Box\.half_extents"),
        (lambda: Box((1.0, 0.0, 1.0)), r"Box\.half_extents must be positive"),
        (lambda: Box((1.0, float("nan"), 1.0)), r"Box\.half_extents"),
        (lambda: Plane((0.0, 0.0, 0.0)), r"Plane\.normal must not be the zero vector"),
        (lambda: Plane((0.0, 1.0)), r"Plane\.normal"),
        (lambda: Plane((0.0, 1.0, 0.0), float("inf")), r"Plane\.offset must be a finite number"),
        (lambda: Polyhedron(np.zeros((8, 3))), r"Polyhedron\.points must hold at least 4 different .* add points"),
        (lambda: Polyhedron(BOX_CORNERS[:3]), r"Polyhedron\.points must hold at least 4 different points, got 3"),
        (
            lambda: Polyhedron(BOX_CORNERS[[0, 1, 2, 2]]),
            r"Polyhedron\.points must hold at least 4 different points, got 3",
        ),
        (lambda: Polyhedron(BOX_CORNERS[:4]), r"Polyhedron\.points must span a volume.*thickness"),
        (lambda: Polyhedron(BOX_CORNERS * [1, 1, 1e-9]), r"Polyhedron\.points must span a volume"),
        (lambda: Polyhedron(np.outer(np.arange(6.0), [1, 2, 3])), r"Polyhedron\.points must span a volume"),
        (lambda: Polyhedron(BOX_CORNERS * [1, np.nan, 1]), r"Polyhedron\.points must be finite, got nan at \(0, 1\)"),
        (lambda: Polyhedron(BOX_CORNERS.T), r"Polyhedron\.points must have shape \(points, 3\), got \(3, 8\)"),
        (lambda: Polyhedron([]), r"Polyhedron\.points must have shape"),
        (lambda: Polyhedron("cube"), r"Polyhedron\.points must be numeric"),
        (lambda: Polyhedron(surface(Sphere(1.0), 12)), r"Polyhedron\.points .* at most 64 .* simplify"),
        (lambda: Heightfield(np.zeros((1, 5)), 1.0), r"Heightfield\.heights must have shape .* got \(1, 5\)"),
        (lambda: Heightfield(np.zeros(5), 1.0), r"Heightfield\.heights must have shape"),
        (lambda: Heightfield(holed(np.nan), 1.0), r"Heightfield\.heights must be finite, got nan at \(1, 2\)"),
        (lambda: Heightfield(holed(np.inf), 1.0), r"Heightfield\.heights must be finite, got inf at \(1, 2\)"),
        (lambda: Heightfield(holed(0.0), 0.0), r"Heightfield\.cell_size"),
        (lambda: Compound([]), r"Compound\.parts must hold at least one"),
        (lambda: Compound([Sphere(1.0)]), r"Compound\.parts must be pairs"),
        (lambda: Compound([(Sphere(1.0), (0, 0, 0))]), r"Compound\.parts must be pairs"),
        (lambda: Compound([(Sphere(1.0), ((0, 0), UNIT))]), r"Compound\.parts\[0\]: position"),
        (lambda: Compound([(Sphere(1.0), ((0, 0, 0), (0, 0, 0, 0)))]), r"Compound\.parts\[0\]: quaternion"),
        (lambda: Compound([(EXAMPLES["plane"], ((0, 0, 0), UNIT))]), r"Compound\.parts\[0\]: shape must be a convex"),
        (lambda: Compound([(SOLIDS["hammer"], ((0, 0, 0), UNIT))]), r"Compound\.parts\[0\]: .* flatten"),
        (lambda: Compound([("ball", ((0, 0, 0), UNIT))]), r"Compound\.parts\[0\]: shape"),
        (lambda: mass_properties("torus", {}), r"no shape is of kind 'torus'"),
    ],
)
def test_bad_arguments_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_shapes_do_not_alias_the_callers_array():
    half, points, heights = np.array([1.0, 2.0, 3.0]), BOX_CORNERS.copy(), np.zeros((3, 3))
    for array, shape, name in (
        (half, Box(half), "half_extents"),
        (points, Polyhedron(points), "vertices"),
        (heights, Heightfield(heights, 1.0), "heights"),
    ):
        before = array.copy()
        array[0] = 9.0
        shape.parameters()[name][1] = 9.0
        np.testing.assert_array_equal(getattr(shape, name), before)
