"""The ray caster against pinhole geometry worked out in NumPy: silhouettes, occlusion, ground, shadow, framing."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from mathota_envs.camera import Camera, default_camera
from mathota_envs.render import _render, render, render_rgb
from mathota_jax import Box, Capsule, Compound, Cone, Cylinder, Heightfield, Plane, Polyhedron, SceneBuilder, Sphere

WIDTH, HEIGHT = 160, 120
FIELD_OF_VIEW = math.radians(50.0)
FLOOR = Plane(normal=(0, 1, 0), offset=0.0)
SHAPES = {
    "sphere": Sphere(0.4),
    "box": Box((0.5, 0.3, 0.2)),
    "capsule": Capsule(0.2, 0.5),
    "cylinder": Cylinder(0.3, 0.4),
    "cone": Cone(0.4, 0.4),
    "polyhedron": Polyhedron(np.random.default_rng(2).uniform(-0.5, 0.5, (12, 3))),
}


def build(*bodies, gravity=(0, -9.8, 0)):
    builder = SceneBuilder(gravity=gravity)
    for shape, place in bodies:
        if isinstance(shape, Plane):
            builder.add_body(shape, static=True)
        else:
            builder.add_body(shape, mass=1.0, **place)
    return builder.build()


def moved(state, body, position):
    return dataclasses.replace(state, position=state.position.at[body].set(np.asarray(position, np.float32)))


def axes(camera):
    forward = np.subtract(camera.target, camera.position)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward), forward


def focal_length(camera, height=HEIGHT):
    return 0.5 * height / math.tan(0.5 * camera.vertical_field_of_view)


def project(camera, points, width=WIDTH, height=HEIGHT):
    """Column and row (pixel centres at whole numbers) of world points."""
    right, above, forward = axes(camera)
    offset = np.atleast_2d(points) - camera.position
    depth = offset @ forward
    focal = focal_length(camera, height)
    column = 0.5 * (width - 1) + focal * (offset @ right) / depth
    row = 0.5 * (height - 1) - focal * (offset @ above) / depth
    return np.stack([column, row], axis=-1)


def pixel_directions(camera):
    right, above, forward = axes(camera)
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    x = (column - 0.5 * (WIDTH - 1)) / focal_length(camera)
    y = (0.5 * (HEIGHT - 1) - row) / focal_length(camera)
    direction = forward + x[..., None] * right + y[..., None] * above
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def silhouette(model, state, camera, body):
    """Pixels that change when the body leaves the scene."""
    _, _, forward = axes(camera)
    gone = moved(state, body, camera.position - 50.0 * forward)
    image, empty = (render_rgb(model, s, WIDTH, HEIGHT, camera).astype(int) for s in (state, gone))
    return np.abs(image - empty).sum(-1) > 0


def corners_of(shape):
    """Points whose hull is the shape, to a thousandth of a pixel; None for balls and rows of balls."""
    angle = np.linspace(0, 2 * np.pi, 2000)
    circle = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    match shape:
        case Box():
            signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            return signs * shape.half_extents
        case Cylinder():
            return np.concatenate([shape.radius * circle + [0, y, 0] for y in (-shape.half_height, shape.half_height)])
        case Cone():
            h = shape.half_height
            return np.concatenate([shape.radius * circle - [0, 0.5 * h, 0], [[0, 1.5 * h, 0]]])
        case Polyhedron():
            return shape.vertices - shape.mass_properties().center_of_mass
    return None


def expected_silhouette(kind, position, quaternion, camera):
    position = np.asarray(position)
    rotation = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    corners = corners_of(SHAPES[kind])
    if corners is not None:
        hull = ConvexHull(project(camera, position + corners @ rotation.T))
        row, column = np.mgrid[:HEIGHT, :WIDTH]
        sides = hull.equations[:, :2] @ np.stack([column.ravel(), row.ravel()]) + hull.equations[:, 2:]
        return (sides < 0).all(0).reshape(HEIGHT, WIDTH)
    # A ball is seen within the angle asin(r / distance) of its centre; a capsule is a row of balls.
    radius = SHAPES[kind].radius
    reach = SHAPES[kind].half_height if kind == "capsule" else 0.0
    direction = pixel_directions(camera)
    seen = np.zeros((HEIGHT, WIDTH), bool)
    for height in np.linspace(-reach, reach, 400 if reach else 1):
        to_centre = position + rotation[:, 1] * height - camera.position
        distance = np.linalg.norm(to_centre)
        seen |= direction @ (to_centre / distance) > math.cos(math.asin(radius / distance))
    return seen


@pytest.mark.parametrize("kind", SHAPES)
def test_silhouettes_are_the_pinhole_projections(kind):
    random = np.random.default_rng(3)
    model, state = build((SHAPES[kind], {}))
    for _ in range(6):
        quaternion = random.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        position = random.uniform(-0.4, 0.4, 3)
        eye = random.normal(size=3)
        eye *= random.uniform(2.5, 6.0) / np.linalg.norm(eye)
        camera = Camera(eye, random.uniform(-0.2, 0.2, 3), random.normal(size=3), FIELD_OF_VIEW)
        pose = dataclasses.replace(
            moved(state, 0, position), orientation=state.orientation.at[0].set(quaternion.astype(np.float32))
        )
        truth = expected_silhouette(kind, position, quaternion, camera)
        seen = silhouette(model, pose, camera, 0)
        assert truth.sum() > 100
        # float32 may decide a pixel differently only where the edge passes through its centre.
        assert (seen != truth).sum() <= 2


def test_terrain_is_seen_as_its_triangles():
    """From above all slopes a surface covers the projections of its triangles, and hides nothing of itself."""
    heights = np.random.default_rng(4).uniform(-0.2, 0.2, (4, 5))
    builder = SceneBuilder(gravity=(0, -9.8, 0))
    builder.add_body(Heightfield(heights, 0.4), static=True, position=(0.1, 0.3, -0.2))
    builder.add_body(Sphere(0.1), mass=1.0, position=(0, -60, 0))
    model, state = builder.build()
    camera = Camera((0.6, 5.0, 0.3), (0.0, 0.3, 0.0), (0, 0, 1), FIELD_OF_VIEW)
    i, j = np.mgrid[:4, :5]
    points = np.stack([(i - 1.5) * 0.4 + 0.1, heights + 0.3, (j - 2) * 0.4 - 0.2], -1)
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    truth = np.zeros((HEIGHT, WIDTH), bool)
    for cell in np.ndindex(3, 4):
        low, high = np.array(cell), np.array(cell) + 1
        for other in ((cell[0], high[1]), (high[0], cell[1])):
            corners = project(camera, [points[tuple(low)], points[other], points[tuple(high)]])
            sides = ConvexHull(corners).equations
            truth |= (
                (sides[:, :2] @ np.stack([column.ravel(), row.ravel()]) + sides[:, 2:] <= 1e-9)
                .all(0)
                .reshape(HEIGHT, WIDTH)
            )
    seen = silhouette(model, state, camera, 0)
    assert truth.sum() > 1000
    assert (seen != truth).sum() <= 4


def test_a_compound_looks_like_its_shapes_each_at_its_place():
    """A box and a capsule on one body, against the same two shapes as separate bodies."""
    offset = {"box": np.array([0.6, 0.2, -0.1]), "capsule": np.array([-0.3, 0.5, 0.4])}
    turn = {"box": np.array([0.8, 0.6, 0.0, 0.0]), "capsule": np.array([0.6, 0.0, 0.0, 0.8])}
    position = np.array([0.2, 1.0, -0.3])
    compound = Compound([(SHAPES[kind], (offset[kind], turn[kind])) for kind in offset])
    camera = Camera((1.5, 2.0, 5.0), (0, 1, 0), (0, 1, 0), FIELD_OF_VIEW)
    whole = render_rgb(*build((compound, {"position": position})), WIDTH, HEIGHT, camera)
    apart = [(SHAPES[kind], {"position": position + offset[kind], "orientation": turn[kind]}) for kind in offset]
    parts = render_rgb(*build(*apart), WIDTH, HEIGHT, camera)
    sky = render_rgb(*build((SHAPES["sphere"], {"position": (0, -50, 0)})), WIDTH, HEIGHT, camera)
    seen, expected = (picture != sky for picture in (whole, parts))
    assert expected.any(-1).sum() > 500
    assert (seen.any(-1) != expected.any(-1)).sum() <= 2


def test_sphere_on_the_axis_is_a_disc_of_the_closed_form_radius():
    model, state = build((Sphere(0.4), {}))
    camera = Camera((0, 0, 3), (0, 0, 0), (0, 1, 0), FIELD_OF_VIEW)
    rows, columns = np.nonzero(silhouette(model, state, camera, 0))
    radius = focal_length(camera) * math.tan(math.asin(0.4 / 3.0))
    assert len(rows) == pytest.approx(math.pi * radius**2, rel=0.02)
    assert (columns.mean(), rows.mean()) == pytest.approx((0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)), abs=0.05)


def test_small_sphere_appears_where_its_centre_projects():
    model, state = build((Sphere(0.1), {}))
    camera = Camera((1.0, 2.0, 4.0), (0.2, 0.1, 0), (0, 1, 0), FIELD_OF_VIEW)
    for position in [(0.9, 0.5, 0.3), (-0.8, -0.4, 0.6), (0.1, 1.1, -0.5)]:
        rows, columns = np.nonzero(silhouette(model, moved(state, 0, position), camera, 0))
        assert np.array([columns.mean(), rows.mean()]) == pytest.approx(project(camera, position)[0], abs=0.3)


def test_box_seen_face_on_covers_the_projected_face():
    model, state = build((Box((0.5, 0.3, 0.2)), {}))
    camera = Camera((0, 0, 3.2), (0, 0, 0), (0, 1, 0), FIELD_OF_VIEW)
    scale = focal_length(camera) / 3.0  # pixels a metre on the front face, which is 0.2 m nearer than the centre
    mask = silhouette(model, state, camera, 0)
    rows, columns = np.nonzero(mask)
    assert abs((np.ptp(columns) + 1) - 1.0 * scale) <= 1
    assert abs((np.ptp(rows) + 1) - 0.6 * scale) <= 1
    assert mask.sum() == (np.ptp(columns) + 1) * (np.ptp(rows) + 1)
    face = render_rgb(model, state, WIDTH, HEIGHT, camera)[mask]
    assert (face == face[0]).all()  # a flat face under parallel light has one colour


def test_capsule_seen_along_its_axis_is_a_disc():
    model, state = build((Capsule(0.3, 0.5), {}))
    camera = Camera((0, 4.0, 0), (0, 0, 0), (0, 0, -1), FIELD_OF_VIEW)
    # The upper cap, 3.5 m away, hides everything below it.
    radius = focal_length(camera) * math.tan(math.asin(0.3 / 3.5))
    assert silhouette(model, state, camera, 0).sum() == pytest.approx(math.pi * radius**2, rel=0.03)


def test_the_nearer_body_hides_the_farther():
    model, state = build((Sphere(0.3), {"position": (0, 0, 1)}), (Box((0.3, 0.3, 0.3)), {"position": (0, 0, -1)}))
    camera = Camera((0, 0, 5), (0, 0, 0), (0, 1, 0), FIELD_OF_VIEW)

    def centre(state):
        return render_rgb(model, state, WIDTH, HEIGHT, camera)[HEIGHT // 2, WIDTH // 2].astype(int)

    swapped = moved(moved(state, 0, (0, 0, -1)), 1, (0, 0, 1))
    red, _, blue = centre(state)
    assert blue > red + 40  # the first body is blue
    red, _, blue = centre(swapped)
    assert red > blue + 40  # the second is orange


@pytest.mark.parametrize("pitch", [0.0, 0.2, -0.15])
def test_horizon_lies_where_the_view_is_level(pitch):
    model, state = build((FLOOR, {}), (Sphere(0.2), {"position": (0, 0.2, 50)}))
    camera = Camera((0, 1, 0), (0, 1 - math.tan(pitch), -1), (0, 1, 0), FIELD_OF_VIEW)
    horizon = 0.5 * (HEIGHT - 1) - focal_length(camera) * math.tan(pitch)
    without, _ = build((Sphere(0.2), {"position": (0, 0.2, 50)}))
    ground = render_rgb(model, state, WIDTH, HEIGHT, camera).astype(int)
    bare = dataclasses.replace(state, position=state.position[1:], orientation=state.orientation[1:])
    sky = render_rgb(without, bare, WIDTH, HEIGHT, camera).astype(int)
    changed = (np.abs(ground - sky).sum(-1) > 0).all(-1)
    assert not changed[: math.ceil(horizon)].any()
    # The haze blends the last rows into the sky.
    assert changed[math.ceil(horizon) + 4 :].all()


def test_chequer_has_squares_of_a_power_of_two_of_the_smallest_body():
    model, state = build((FLOOR, {}), (Sphere(0.11), {"position": (30, 0.11, 0)}))
    camera = Camera((0.05, 6.0, 0.05), (0.05, 0, 0.05), (0, 0, -1), FIELD_OF_VIEW)
    row = render_rgb(model, state, WIDTH, HEIGHT, camera)[HEIGHT // 2].astype(int).sum(-1)
    bright = row > 0.5 * (row.max() + row.min())
    edges = np.nonzero(np.diff(bright))[0]
    pixels = 0.5 * focal_length(camera) / 6.0  # twice the diameter is 0.44 m, the nearest power of two 0.5 m
    assert np.diff(edges).mean() == pytest.approx(pixels, rel=0.05)


def test_plane_is_not_seen_from_behind():
    model, state = build((FLOOR, {}), (Sphere(0.4), {"position": (0, 1, 0)}))
    camera = Camera((0, -3, 0.1), (0, 1, 0), (0, 0, 1), FIELD_OF_VIEW)
    truth = expected_silhouette("sphere", (0, 1, 0), (1, 0, 0, 0), camera)
    assert (silhouette(model, state, camera, 1) != truth).sum() <= 2


def test_shadow_falls_along_the_light():
    shape, place = SHAPES["sphere"], {"position": (0, 1.5, 0)}
    model, state = build((FLOOR, {}), (shape, place))
    camera = Camera((0, 8, 0.01), (0, 0, 0), (0, 0, -1), FIELD_OF_VIEW)
    lit, gone = (
        render_rgb(model, s, WIDTH, HEIGHT, camera).astype(int).sum(-1) for s in (state, moved(state, 1, (0, 80, 0)))
    )
    ball = expected_silhouette("sphere", (0, 1.5, 0), (1, 0, 0, 0), camera)
    rows, columns = np.nonzero((lit < 0.75 * gone) & ~ball)
    foot = np.array([-0.45, 0.0, -0.55]) * 1.5  # light from (0.45, 1, 0.55): right, up, front
    assert np.array([columns.mean(), rows.mean()]) == pytest.approx(project(camera, foot)[0], abs=0.6)


def test_a_round_body_shows_its_rotation():
    model, state = build((Sphere(0.4), {}))
    camera = Camera((0.5, 0.8, 3), (0, 0, 0), (0, 1, 0), FIELD_OF_VIEW)
    turned = dataclasses.replace(state, orientation=state.orientation.at[0].set([math.cos(0.2), 0, 0, math.sin(0.2)]))
    assert (render_rgb(model, state, camera=camera) != render_rgb(model, turned, camera=camera)).any()


def test_no_axis_is_up_by_itself():
    place = {"position": (0.1, 0.5, 0.2), "orientation": (0.8, 0.6, 0, 0)}
    image = render_rgb(*build((FLOOR, {}), (Box((0.3, 0.2, 0.4)), place)), WIDTH, HEIGHT)
    # The same turned by a quarter about x: y becomes z, z becomes -y.
    quarter = Rotation.from_euler("x", 90, degrees=True)
    turned = np.roll((quarter * Rotation.from_quat([0.6, 0, 0, 0.8])).as_quat(), 1)
    place = {"position": (0.1, -0.2, 0.5), "orientation": tuple(turned)}
    floor = Plane(normal=(0, 0, 1), offset=0.0)
    upright = render_rgb(*build((floor, {}), (Box((0.3, 0.2, 0.4)), place), gravity=(0, 0, -9.8)), WIDTH, HEIGHT)
    different = (np.abs(image.astype(int) - upright.astype(int)) > 2).any(-1)
    assert different.mean() < 0.002


def test_batch_equals_single_pictures():
    model, state = build(
        (FLOOR, {}), (Sphere(0.3), {"position": (0, 0.3, 0)}), (SHAPES["capsule"], {"position": (1, 1, 0)})
    )
    camera = default_camera(model, state, 64 / 48)
    states = [moved(state, 1, (x, 0.3, 0.2)) for x in (-0.5, 0.0, 0.6)]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *states)
    images = jax.vmap(lambda s: render(model, s, camera, 64, 48))(batch)
    assert images.shape == (3, 48, 64, 3)
    assert images.dtype == np.uint8
    singles = np.stack([render_rgb(model, s, 64, 48, camera) for s in states]).astype(int)
    assert (np.abs(singles - np.asarray(images, int)) > 2).mean() < 1e-3
    assert (singles[0] != singles[1]).any()


def test_one_compilation_serves_equal_scenes_and_every_state():
    def scene(x):
        return build((FLOOR, {}), (Sphere(0.25), {"position": (x, 0.25, 0)}), (Sphere(0.2), {"position": (0, 0.2, 1)}))

    render_rgb(*scene(0.0), 32, 24)
    count = _render._cache_size()
    render_rgb(*scene(0.7), 32, 24)
    assert _render._cache_size() == count


def test_a_body_that_is_not_finite_is_left_out():
    model, state = build(
        (FLOOR, {}), (Sphere(0.3), {"position": (0, 0.3, 0)}), (Sphere(0.3), {"position": (1, 0.3, 0)})
    )
    camera = default_camera(model, state)
    broken = render_rgb(model, moved(state, 2, (math.nan, 0.3, 0)), WIDTH, HEIGHT, camera)
    gone = render_rgb(model, moved(state, 2, (0, 900.0, 0)), WIDTH, HEIGHT, camera)
    assert (broken == gone).all()
    assert np.isfinite(default_camera(model, moved(state, 2, (math.nan, 0, 0))).position).all()


@pytest.mark.parametrize(
    ("bodies", "gravity"),
    [
        pytest.param([(FLOOR, {})], (0, -9.8, 0), id="floor"),
        pytest.param([], (0, 0, 0), id="weightless"),
        pytest.param([(Plane(normal=(0.5, 0, 1), offset=-3.0), {})], (0, 0, -9.8), id="z up"),
        pytest.param([(Plane(normal=(0, 0.34, -0.94), offset=-1.0), {})], (0, -9.8, 0), id="steep slope before us"),
        pytest.param([(Box((50, 0.5, 50)), {"position": (0, -9, 0)})], (0, -9.8, 0), id="floor as a huge box"),
    ],
)
@pytest.mark.parametrize("size", [(160, 120), (60, 150)])
def test_default_view_shows_every_body_from_the_open_side(bodies, gravity, size):
    place = [(-0.7, 0.4, 0.3), (0.8, 0.2, -0.5), (0.1, 0.9, 0.0)]
    small = [(SHAPES[kind], {"position": at}) for kind, at in zip(("sphere", "box", "capsule"), place, strict=True)]
    model, state = build(*bodies, *small, gravity=gravity)
    camera = default_camera(model, state, size[0] / size[1])
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    surface = np.concatenate([np.add(at, 0.3 * directions) for at in place])
    pixels = project(camera, surface, *size)
    assert (pixels > -0.5).all()
    assert (pixels < np.array(size) - 0.5).all()
    assert np.ptp(pixels, axis=0).max() > 0.35 * min(size)
    for shape, _ in bodies:
        if isinstance(shape, Plane):
            normal = np.array(shape.normal) / np.linalg.norm(shape.normal)
            assert normal @ camera.position > shape.offset
    if any(gravity):
        assert np.dot(camera.up, gravity) < 0


def test_scene_of_planes_only_can_be_seen():
    model, state = build((FLOOR, {}), (Plane(normal=(1, 0, 0), offset=-2.0), {}))
    image = render_rgb(model, state, 64, 48)
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 3


GOOD = {"position": (0, 0, 3), "target": (0, 0, 0), "up": (0, 1, 0), "vertical_field_of_view": 0.8}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": (0, 0)}, "camera.position"),
        ({"position": (0, 0, math.nan)}, "camera.position"),
        ({"position": "above"}, "camera.position"),
        ({"target": (0, math.inf, 0)}, "camera.target"),
        ({"target": (0, 0, 3)}, "camera.target must differ"),
        ({"up": (0, 0, 0)}, "camera.up must not be zero"),
        ({"up": (0, 0, -2)}, "camera.up must not be parallel"),
        ({"vertical_field_of_view": 45.0}, "between 0 and pi radians"),
        ({"vertical_field_of_view": 0.0}, "between 0 and pi radians"),
        ({"vertical_field_of_view": math.nan}, "between 0 and pi radians"),
        ({"vertical_field_of_view": (0.5, 0.5)}, "one angle"),
    ],
)
def test_bad_cameras_are_refused(change, message):
    model, state = build((Sphere(0.3), {}))
    with pytest.raises(ValueError, match=message):
        render_rgb(model, state, camera=Camera(**{**GOOD, **change}))


def test_a_camera_must_be_a_camera():
    model, state = build((Sphere(0.3), {}))
    with pytest.raises(ValueError, match="must be a Camera"):
        render_rgb(model, state, camera=((0, 0, 3), (0, 0, 0), (0, 1, 0)))


@pytest.mark.parametrize("size", [{"width": 0}, {"height": -3}, {"width": 12.5}, {"height": True}])
def test_bad_sizes_are_refused(size):
    model, state = build((Sphere(0.3), {}))
    with pytest.raises(ValueError, match=next(iter(size))):
        render_rgb(model, state, **size)


def test_an_unknown_kind_of_shape_is_named():
    _, state = build((Sphere(0.3), {}))
    shape = SimpleNamespace(kind="teapot", body=0, index=0)
    model = SimpleNamespace(
        scene=SimpleNamespace(shapes=(shape,)), shapes={"teapot": {"radius": np.ones(1)}}, gravity=np.zeros(3)
    )
    for camera in (None, Camera(**GOOD)):
        with pytest.raises(ValueError, match="'teapot' of body 0"):
            render_rgb(model, state, camera=camera)
