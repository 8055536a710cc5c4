"""Rays against an oracle that knows only which points are inside: dense samples along the ray and bisection, float64."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from mathota_jax import (
    Box,
    Capsule,
    Compound,
    Cone,
    Cylinder,
    Heightfield,
    Plane,
    Polyhedron,
    SceneBuilder,
    Sphere,
    raycast,
)
from mathota_jax.collision.rays import RAYS
from mathota_jax.geometry import SHAPES
from tests.hulls import BOX_CORNERS
from tests.marks import QUICK_AND_SLOW_PRECISION

HOUSE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.5, 1.6, 0], [0, 1, 0]])
HOUSE = np.concatenate([HOUSE, HOUSE + np.array([0.2, 0.1, 0.7])])
RANDOM = np.random.default_rng(7)
SHAPE = {
    "plane": Plane((0.3, 1.0, -0.2), 0.4),
    "sphere": Sphere(0.7),
    "capsule": Capsule(0.3, 0.8),
    "box": Box((0.2, 0.5, 1.1)),
    "cylinder": Cylinder(0.6, 0.25),
    "cone": Cone(0.5, 0.6),
    "polyhedron": Polyhedron(HOUSE),
    "heightfield": Heightfield(0.3 * RANDOM.normal(size=(6, 9)) + 0.4, 0.5),
}
VARIANTS = {
    **SHAPE,
    "needle": Cone(0.01, 1.0),
    "coin": Cylinder(1.0, 0.01),
    "plate": Polyhedron(BOX_CORNERS * [1.0, 0.01, 1.0]),
    "cloud": Polyhedron(RANDOM.normal(size=(40, 3))),
    "steps": Heightfield(np.round(RANDOM.uniform(size=(5, 5)) * 2), 0.4),
}
POSITION, TURN = np.array([0.3, -0.7, 1.2]), Rotation.from_rotvec([0.5, 1.1, -0.4])
RAYS_EACH = 300


# ---- oracle ----------------------------------------------------------------------------------------------------------


def level(shape, p):
    """Negative inside, positive outside, continuous; (..., 3) points in the shape's frame."""
    x, y, z = np.moveaxis(p, -1, 0)
    across = np.hypot(x, z)
    if isinstance(shape, Plane):
        return p @ shape.normal - shape.offset
    if isinstance(shape, Sphere):
        return np.linalg.norm(p, axis=-1) - shape.radius
    if isinstance(shape, Capsule):
        return np.hypot(across, np.maximum(np.abs(y) - shape.half_height, 0)) - shape.radius
    if isinstance(shape, Box):
        return (np.abs(p) - shape.half_extents).max(-1)
    if isinstance(shape, Cylinder):
        return np.maximum(across - shape.radius, np.abs(y) - shape.half_height)
    if isinstance(shape, Cone):
        side = across - shape.radius * (1.5 * shape.half_height - y) / (2 * shape.half_height)
        return np.maximum(side, -0.5 * shape.half_height - y)
    if isinstance(shape, Polyhedron):
        planes = ConvexHull(shape.vertices).equations
        return (p @ planes[:, :3].T + planes[:, 3]).max(-1)
    heights = shape.heights
    rows, columns = heights.shape
    u, v = x / shape.cell_size + (rows - 1) / 2, z / shape.cell_size + (columns - 1) / 2
    i, j = np.clip(np.floor(u), 0, rows - 2).astype(int), np.clip(np.floor(v), 0, columns - 2).astype(int)
    fu, fv = u - i, v - j
    one = heights[i, j] * (1 - fu) + heights[i + 1, j] * (fu - fv) + heights[i + 1, j + 1] * fv
    two = heights[i, j] * (1 - fv) + heights[i, j + 1] * (fv - fu) + heights[i + 1, j + 1] * fu
    beyond = np.maximum(np.maximum(-u, u - rows + 1), np.maximum(-v, v - columns + 1)) * shape.cell_size
    return np.maximum(y - np.where(fu > fv, one, two), beyond)


def size_of(shape):
    return 1.0 if isinstance(shape, Plane) else shape.bounding_radius()


def window(shape):
    """Distances between which rays that start four sizes away can meet the shape."""
    return np.array([0.0, 8.0] if SHAPES[shape.kind].static_only else [2.9, 5.1]) * size_of(shape)


def oracle(shape, origin, direction, reach):
    """Distance to the first entry, NaN for none; and whether the answer is beyond doubt (no grazing)."""
    unit = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    t = np.linspace(*reach, 1201)
    values = level(shape, origin + t[:, None, None] * unit)
    enters = (values[:-1] > 0) & (values[1:] <= 0)
    hit = enters.any(0)
    first = np.where(hit, enters.argmax(0), 0)
    low, high = t[first], t[first + 1]
    for _ in range(50):
        middle = 0.5 * (low + high)
        outside = level(shape, origin + middle[:, None] * unit) > 0
        low, high = np.where(outside, middle, low), np.where(outside, high, middle)
    after = np.arange(len(t))[:, None] > first + 20
    deepest = np.where(hit, np.where(after, np.inf, values).min(0), values.min(0))
    doubt = min(2e-3, 0.1 * shape.inradius())
    clear = np.where(hit, deepest < -doubt, deepest > doubt)
    return np.where(hit, low, np.nan), clear


def rays(shape):
    """Half of them towards the inside of the shape, half past it; in the shape's frame."""
    rng = np.random.default_rng(11)
    size, half = size_of(shape), RAYS_EACH // 2
    origin = rng.normal(size=(RAYS_EACH, 3))
    origin *= 4.0 * size / np.linalg.norm(origin, axis=1, keepdims=True)
    if isinstance(shape, Polyhedron):
        target = rng.dirichlet(np.ones(len(shape.vertices)), RAYS_EACH) @ shape.vertices
    elif isinstance(shape, Heightfield):
        rows, columns = shape.heights.shape
        target = rng.uniform(-1, 1, (RAYS_EACH, 3)) * [rows - 1, 0, columns - 1] * (0.5 * shape.cell_size) + [0, 0.3, 0]
    else:
        target = 0.4 * rng.normal(size=(RAYS_EACH, 3)) * min(1.0, shape.inradius())
    target[half:] += 0.8 * size * rng.normal(size=(RAYS_EACH - half, 3))
    return origin, (target - origin) * rng.uniform(0.1, 10, (RAYS_EACH, 1))


def scene(shape, position=POSITION, turn=TURN):
    builder = SceneBuilder()
    builder.add_body(shape, static=True, position=position, orientation=turn.as_quat()[[3, 0, 1, 2]])
    return builder.build()


@jax.jit
def cast(model, state, origin, direction):
    return jax.vmap(lambda o, d: raycast(model, state, o, d))(origin, direction)


# ---- values ----------------------------------------------------------------------------------------------------------


def test_every_shape_can_be_seen():
    assert set(RAYS) == set(SHAPES) == set(SHAPE)


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_rays_meet_shapes_where_their_inside_begins(name, precision):
    shape = VARIANTS[name]
    origin, direction = rays(shape)
    size = size_of(shape)
    expected, clear = oracle(shape, origin, direction, window(shape))
    found = cast(*scene(shape), TURN.apply(origin) + POSITION, TURN.apply(direction))
    hit = np.asarray(found.hit)
    assert (clear & ~np.isnan(expected)).sum() > 20
    assert np.isnan(expected[clear]).sum() > (3 if name == "plane" else 20)
    reach = np.isnan(expected) & (np.asarray(found.distance) > window(shape)[1])  # beyond the oracle's samples
    np.testing.assert_array_equal((hit & ~reach)[clear], ~np.isnan(expected[clear]))
    both = clear & hit & ~np.isnan(expected)
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    # Round-off of a distance grows with the slant of the surface.
    slant = np.abs(np.einsum("nx,nx->n", np.asarray(found.normal, float), TURN.apply(unit)))[both]
    tolerance = (3e-6 if precision == "float32" else 1e-11) * 4.0 * size / slant
    assert np.all(np.abs(np.asarray(found.distance, float)[both] - expected[both]) < tolerance)
    np.testing.assert_array_equal(np.asarray(found.body), np.where(hit, 0, -1))
    np.testing.assert_array_equal(np.isinf(found.distance), ~hit)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), hit, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_normals_are_those_of_the_surface(name, float64):
    """``d distance / d origin = -n / (n . d)``, with central differences of the oracle."""
    shape = VARIANTS[name]
    origin, direction = rays(shape)
    size = size_of(shape)
    found = cast(*scene(shape, np.zeros(3), Rotation.identity()), origin, direction)
    step, thin = 1e-6 * size, (0.0, 0.03 * size)
    reached, clear = oracle(shape, origin, direction, window(shape))
    keep = clear & ~np.isnan(reached) & np.asarray(found.hit)
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    # Start just before the surface, where the oracle's samples are dense.
    near = origin + (reached - 0.01 * size)[:, None] * unit
    keep &= np.nan_to_num(level(shape, np.nan_to_num(near)), nan=-1.0) > 0
    near, unit, normal = near[keep], unit[keep], np.asarray(found.normal)[keep]
    difference = np.stack(
        [
            (oracle(shape, near + e, unit, thin)[0] - oracle(shape, near - e, unit, thin)[0]) / (2 * step)
            for e in np.eye(3) * step
        ],
        axis=-1,
    )
    expected = -normal / np.einsum("nx,nx->n", normal, unit)[:, None]
    error = np.linalg.norm(difference - expected, axis=1) / np.linalg.norm(expected, axis=1)
    assert keep.sum() > 20
    assert np.mean(error < 1e-4) > 0.97  # an edge lies within the step of some


def test_rays_from_afar_are_met_in_float32():
    """A small ball, box and cone a thousand sizes away."""
    with jax.enable_x64(False):
        for shape in (Sphere(0.7), Box((0.5, 0.5, 0.5)), Cone(0.5, 0.6), Cylinder(0.5, 0.5), Capsule(0.4, 0.4)):
            origin = np.array([[1000.0, 300.0, -200.0]])
            found = cast(*scene(shape, np.zeros(3), Rotation.identity()), origin, -origin)
            expected, _ = oracle(shape, origin * 4 / 1063, -origin, (2.0, 6.0))
            assert bool(found.hit[0])
            full, short = np.linalg.norm(origin), np.linalg.norm(origin * 4 / 1063)
            assert float(found.distance[0]) == pytest.approx(full - short + expected[0], abs=3e-4)


def test_directions_of_any_length_are_met():
    """The square of 1e-25 and of 1e25 is no number in float32."""
    with jax.enable_x64(False):
        model, state = scene(Sphere(0.4), np.zeros(3), Rotation.identity())
        lengths = np.array([1e-30, 1e-20, 1.0, 1e20, 1e30])
        found = cast(model, state, np.tile([0.0, 0.0, 2.0], (5, 1)), lengths[:, None] * [0.0, 0.0, -1.0])
        np.testing.assert_allclose(found.distance, 1.6, rtol=1e-6)


def test_the_apex_of_a_cone_has_a_normal():
    found = cast(
        *scene(Cone(0.35, 0.3), np.zeros(3), Rotation.identity()),
        np.array([[0.0, 2.0, 0.0]]),
        np.array([[0.0, -1.0, 0.0]]),
    )
    np.testing.assert_allclose(found.normal, [[0.0, 1.0, 0.0]], atol=1e-6)


def test_no_ray_slips_through_a_seam(precision):
    """Rays at edges and corners of a mesh-like surface, straight and askew."""
    hills = SHAPE["heightfield"]
    rows, columns = hills.heights.shape
    x, z = np.meshgrid(np.linspace(-1, 1, 41) * (rows - 1.1) / 4, np.linspace(-1, 1, 65) * (columns - 1.1) / 4)
    target = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=-1)
    for slant in (np.array([0.0, 5.0, 0.0]), np.array([0.01, 5.0, 0.02])):
        down = np.broadcast_to(-slant, target.shape)
        assert np.all(cast(*scene(hills, np.zeros(3), Rotation.identity()), target + slant, down).hit)
    box = cast(*scene(Box((0.5, 0.5, 0.5)), np.zeros(3), Rotation.identity()), BOX_CORNERS * 3, -BOX_CORNERS)
    np.testing.assert_allclose(box.distance, 2.5 * np.sqrt(3), rtol=1e-6)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_axis_parallel_and_degenerate_rays_are_finite(precision):
    directions = np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))])
    starts = np.concatenate([-3 * np.eye(3), 3 * np.eye(3), np.full((1, 3), 3.0)])
    for shape in VARIANTS.values():
        model, state = scene(shape, np.zeros(3), Rotation.identity())
        found = cast(model, state, starts, directions)
        assert not found.hit[-1]
        assert not np.any(np.isnan(found.distance)) and not np.any(np.isnan(found.normal))

        def total(model, state, origin, direction):
            hit = jax.vmap(lambda o, d: raycast(model, state, o, d, 100.0))(origin, direction)
            return hit.distance.sum() + hit.normal.sum()

        gradient = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3), allow_int=True))(
            model, state, jnp.asarray(starts), jnp.asarray(directions)
        )
        for leaf in jax.tree.leaves(gradient):
            if leaf.dtype != jax.dtypes.float0:
                assert np.all(np.isfinite(leaf)), shape


@pytest.mark.parametrize("kind", SHAPE)
def test_a_ray_that_starts_inside_does_not_see_the_solid(kind):
    shape = SHAPE[kind]
    inside = {"plane": -2.0 * SHAPE["plane"].normal, "polyhedron": HOUSE.mean(0), "heightfield": np.array([0, -5.0, 0])}
    origin = np.broadcast_to(inside.get(kind, np.zeros(3)), (6, 3))
    found = cast(*scene(shape, np.zeros(3), Rotation.identity()), origin, np.concatenate([np.eye(3), -np.eye(3)]))
    assert not np.any(found.hit)


def test_the_nearest_of_several_and_the_reach():
    builder = SceneBuilder()
    ground = builder.add_body(Plane((0, 1, 0), 0.0), static=True)
    near = builder.add_body(Sphere(0.5), mass=1.0, position=(3, 1, 0))
    builder.add_body(Sphere(0.5), mass=1.0, position=(6, 1, 0))
    model, state = builder.build()
    found = raycast(model, state, jnp.array([0.0, 1, 0]), jnp.array([2.0, 0, 0]))
    assert (int(found.body), float(found.distance)) == (near, pytest.approx(2.5))
    assert int(raycast(model, state, jnp.array([0.0, 1, 0]), jnp.array([1.0, -1, 0])).body) == ground
    short = raycast(model, state, jnp.array([0.0, 1, 0]), jnp.array([1.0, 0, 0]), 2.0)
    assert (bool(short.hit), float(short.distance), int(short.body)) == (False, 2.0, -1)
    np.testing.assert_array_equal(short.normal, 0.0)


def test_parts_of_a_compound_are_seen_at_their_place():
    shape = Compound([(Sphere(0.2), ((1, 0, 0), (1, 0, 0, 0))), (Box((0.1, 0.3, 0.2)), ((-1, 0, 0), (0.8, 0, 0, 0.6)))])
    builder = SceneBuilder()
    builder.add_body(shape, mass=1.0, position=(0, 2, 0))
    model, state = builder.build()
    down = jnp.array([0.0, -1, 0])
    assert float(raycast(model, state, jnp.array([1.0, 5, 0]), down).distance) == pytest.approx(2.8, abs=1e-5)
    assert not raycast(model, state, jnp.array([0.0, 5, 0]), down).hit
    box = Rotation.from_quat([0, 0, 0.6, 0.8]).inv()
    origin, heading = box.apply([0.05, 3, 0.1]), box.apply([0.0, -1, 0])
    expected, _ = oracle(Box((0.1, 0.3, 0.2)), origin[None], heading[None], (0.0, 6.0))
    assert float(raycast(model, state, jnp.array([-0.95, 5, 0.1]), down).distance) == pytest.approx(
        expected[0], abs=1e-5
    )


@pytest.mark.parametrize(("name", "bad"), [("origin", (1.0, 2.0)), ("direction", 1.0)])
def test_bad_rays_are_named(name, bad):
    model, state = scene(Sphere(1.0))
    arguments = {"origin": (0.0, 0, 0), "direction": (1.0, 0, 0), name: bad}
    with pytest.raises(ValueError, match=f"raycast: {name} must have shape"):
        raycast(model, state, **arguments)


def test_a_reach_for_each_of_no_rays():
    with pytest.raises(ValueError, match=r"raycast: max_distance must be one number, got shape \(2,\); use jax\.vmap"):
        raycast(*scene(Sphere(1.0)), jnp.zeros(3), jnp.array([1.0, 0, 0]), jnp.ones(2))


# ---- derivatives -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", SHAPE)
def test_derivatives_match_central_differences(kind, float64):
    """Of distance and normal, by origin, direction, pose and every size, at hits away from edges."""
    shape = SHAPE[kind]
    model, state = scene(shape)
    origin, direction = (TURN.apply(v) for v in rays(shape))
    origin = origin + POSITION
    first = np.flatnonzero(np.asarray(cast(model, state, origin, direction).hit))[:12]

    def answer(origin, direction, position, orientation, sizes):
        moved = dataclasses.replace(state, position=position[None], orientation=orientation[None])
        hit = raycast(dataclasses.replace(model, shapes={kind: sizes}), moved, origin, direction)
        return jnp.concatenate([hit.distance[None], hit.normal])

    jacobian = jax.jit(jax.jacfwd(answer, argnums=(0, 1, 2, 3, 4)))
    evaluate = jax.jit(jax.vmap(answer, in_axes=0))
    matches = 0
    for ray in first:
        inputs = (
            jnp.asarray(origin[ray]),
            jnp.asarray(direction[ray]),
            state.position[0],
            state.orientation[0],
            model.shapes[kind],
        )
        exact = jax.tree.leaves(jacobian(*inputs))
        leaves, tree = jax.tree.flatten(inputs)
        good = True
        for index, leaf in enumerate(leaves):
            step = 1e-6
            shifts = np.eye(leaf.size).reshape(leaf.size, *leaf.shape) * step
            shifted = [[jnp.broadcast_to(x, (leaf.size, *x.shape)) for x in leaves] for _ in range(2)]
            shifted[0][index], shifted[1][index] = leaf + shifts, leaf - shifts
            after, before = (np.asarray(evaluate(*jax.tree.unflatten(tree, batch))) for batch in shifted)
            difference = (after - before) / (2 * step)
            ours = np.asarray(exact[index]).reshape(4, -1).T
            good &= bool(np.allclose(ours, difference, rtol=1e-6, atol=1e-6 * max(1.0, np.abs(difference).max())))
        matches += good
    assert len(first) == 12
    assert matches >= 11  # one may stand within a step of an edge
    reverse = jax.jacrev(answer, argnums=(0, 1, 2, 3, 4))(*inputs)
    for forward, back in zip(exact, jax.tree.leaves(reverse), strict=True):
        np.testing.assert_allclose(forward, back, atol=1e-9 * max(1.0, np.abs(forward).max()))


def test_rays_of_many_worlds():
    model, state = scene(Box((0.5, 0.5, 0.5)), np.zeros(3), Rotation.identity())
    states = jax.vmap(lambda x: dataclasses.replace(state, position=state.position + x))(jnp.arange(3.0)[:, None, None])
    origins = jnp.array([[-5.0, 0, 0], [-5.0, 1, 1]])
    found = jax.vmap(lambda s: jax.vmap(lambda o: raycast(model, s, o, jnp.array([1.0, 0, 0])))(origins))(states)
    np.testing.assert_allclose(found.distance, [[4.5, np.inf], [np.inf, 5.5], [np.inf, np.inf]], rtol=1e-6)
    np.testing.assert_array_equal(found.hit, [[True, False], [False, True], [False, False]])
