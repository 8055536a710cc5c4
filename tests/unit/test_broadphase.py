"""Broadphase methods against brute force in NumPy: the same set of pairs, whatever the scene."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Capsule, Compound, Plane, SceneBuilder, Sphere, rollout, step
from mathota_jax.collision.broadphase import BROADPHASES, Admissible, Bounds, Planes, candidate_pairs
from mathota_jax.collision.broadphase.choice import choose_method
from mathota_jax.pair_filter import make_filter
from mathota_jax.spatial.vector import Vec3
from tests.marks import QUICK_AND_SLOW_PRECISION

WORLDS = 3

compiled = jax.jit(candidate_pairs, static_argnums=(0, 2, 3))


def cloud(rng, count, spread=1.0, sizes=(0.05, 0.15), origin=0.0):
    """Centers and half extents of boxes, (world, shape, 3)."""
    center = origin + rng.uniform(-spread, spread, (WORLDS, count, 3))
    return center, rng.uniform(*sizes, (WORLDS, count, 3))


def coincident(rng, count):
    return np.broadcast_to(rng.normal(size=(WORLDS, 1, 3)), (WORLDS, count, 3)), np.full((WORLDS, count, 3), 0.1)


def mixed_sizes(rng, count):
    """Sizes 1 : 1000."""
    center, half = cloud(rng, count, 3.0)
    return center, half * np.where(rng.random((WORLDS, count, 1)) < 0.1, 10.0, 0.01)


def lattice(rng, count):
    """Cubes whose faces touch exactly: every comparison is a tie."""
    side = round(count ** (1 / 3)) + 1
    place = np.stack(np.unravel_index(rng.permutation(side**3)[:count], (side, side, side)), axis=-1)
    return np.broadcast_to(0.25 * place, (WORLDS, count, 3)), np.full((WORLDS, count, 3), 0.125)


def line(rng, count):
    """All along z, so that a sweep along x or y would meet everything; worlds differ in scale."""
    center = np.zeros((WORLDS, count, 3))
    center[..., 2] = rng.permutation(count) * np.array([[1e-6], [1.0], [1e6]])
    return center, np.broadcast_to(0.6 * np.array([1e-6, 1.0, 1e6])[:, None, None], (WORLDS, count, 3))


def two_clusters(rng, count):
    """A scene far wider than a grid of 1000 cells of its boxes."""
    center, half = cloud(rng, count, 0.3)
    return center + 1e4 * (np.arange(count) % 2)[None, :, None], half


SCENES = {
    "random": lambda rng, count: cloud(rng, count),
    "dense": lambda rng, count: cloud(rng, count, 0.3),
    "far from the origin": lambda rng, count: cloud(rng, count, 1.0, origin=1e4),
    "coincident": coincident,
    "one cell": lambda rng, count: cloud(rng, count, 0.1),
    "sizes 1:1000": mixed_sizes,
    "touching lattice": lattice,
    "line": line,
    "two clusters": two_clusters,
    "points": lambda rng, count: (rng.integers(0, 4, (WORLDS, count, 3)) / 3, np.zeros((WORLDS, count, 3))),
}


def bounds_of(center, half, dtype):
    """Bounds in the given precision with their own rounded corners; spheres around the boxes."""
    center, half = np.asarray(center, dtype), np.asarray(half, dtype)
    radius = np.linalg.norm(half.astype(float), axis=-1).astype(dtype)

    def vector(values):
        return Vec3(*(jnp.asarray(values[..., axis].T) for axis in range(3)))

    return Bounds(vector(center - half), vector(center + half), vector(center), jnp.asarray(radius.T))


def brute_force(bounds, admissible):
    """For each world, {(first, second): depth} by the definition, in NumPy float64."""
    low, high, center = (np.stack([np.asarray(c, float) for c in v]) for v in bounds[:3])
    radius = np.asarray(bounds.radius, float)
    excluded = {frozenset(pair) for pair in admissible.excluded}
    classes, ignored = admissible.filter.classes, {frozenset(pair) for pair in admissible.filter.ignored}
    found = []
    for world in range(radius.shape[1]):
        pairs = {}
        for i in range(admissible.shape_count):
            for j in range(i + 1, admissible.shape_count):
                a, b = admissible.bodies[i], admissible.bodies[j]
                if a == b or (admissible.static[i] and admissible.static[j]) or frozenset((a, b)) in excluded:
                    continue
                if ignored and frozenset((classes[a], classes[b])) in ignored:
                    continue
                depth = np.min(
                    np.minimum(high[:, i, world], high[:, j, world]) - np.maximum(low[:, i, world], low[:, j, world])
                )
                distance = np.linalg.norm(center[:, i, world] - center[:, j, world])
                if depth >= 0 and distance <= (radius[i, world] + radius[j, world]) * (1 + 1e-4):
                    pairs[i, j] = depth
        found.append(pairs)
    return found


def listed(pairs, world):
    """Pairs in the list of a world, in its order."""
    active = np.asarray(pairs.active)[:, world]
    return list(zip(np.asarray(pairs.first)[active, world], np.asarray(pairs.second)[active, world], strict=True))


def everything(count, static_share=0.0):
    return Admissible(tuple(range(count)), tuple(k < static_share * count for k in range(count)))


@pytest.mark.parametrize("method", BROADPHASES)
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_pairs_are_those_of_brute_force(method, scene, precision):
    count = 61
    rng = np.random.default_rng(len(scene))
    bounds = bounds_of(*SCENES[scene](rng, count), precision)
    admissible = everything(count, 0.4)
    expected = brute_force(bounds, admissible)
    capacity = count * (count - 1) // 2
    pairs = compiled(method, bounds, admissible, capacity)
    for world in range(WORLDS):
        assert listed(pairs, world) == sorted(expected[world])
        assert int(pairs.count[world]) == len(expected[world])
    assert not np.any(pairs.overflow)
    assert not np.any(pairs.invalid)


@pytest.mark.parametrize("chunk", [1, 200, 10**6])
@pytest.mark.parametrize("order", ["static first", "static last", "mixed", "one moves"])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_all_pairs_in_chunks_of_any_size(chunk, order, monkeypatch, precision):
    monkeypatch.setattr(importlib.import_module("mathota_jax.collision.broadphase.all_pairs"), "CHUNK", chunk)
    rng = np.random.default_rng(5)
    static = {
        "static first": np.arange(40) < 15,
        "static last": np.arange(40) >= 25,
        "mixed": rng.random(40) < 0.4,
        "one moves": np.arange(40) != 17,
    }[order]
    admissible = Admissible(tuple(range(40)), tuple(static.tolist()), ((16, 17), (17, 30)))
    bounds = bounds_of(*cloud(rng, 40, 0.2), precision)
    pairs = candidate_pairs("all_pairs", bounds, admissible, 780)
    for world, expected in enumerate(brute_force(bounds, admissible)):
        assert expected
        assert listed(pairs, world) == sorted(expected)


def test_scenes_are_neither_empty_nor_full():
    """Otherwise the test above could not fail."""
    for name, scene in SCENES.items():
        bounds = bounds_of(*scene(np.random.default_rng(len(name)), 61), np.float64)
        sizes = [len(pairs) for pairs in brute_force(bounds, everything(61, 0.4))]
        assert min(sizes) > 3, (name, sizes)
        assert max(sizes) < 1000 or name in ("coincident", "one cell"), (name, sizes)


@pytest.mark.parametrize("method", BROADPHASES)
def test_inadmissible_pairs_are_left_out(method, float64):
    """Compounds (several shapes on a body), static shapes in any place, pairs of bodies that are excluded or ignored."""
    rng = np.random.default_rng(3)
    count = 50
    bodies = tuple(int(b) for b in rng.integers(0, 30, count))
    admissible = Admissible(
        bodies,
        tuple(body % 3 == 0 for body in bodies),
        tuple((a, b) for a in range(30) for b in range(a + 1, 30) if (a * b) % 5 == 1),
        make_filter(30, [(frozenset(range(0, 30, 4)),) * 2, (frozenset(range(5)), frozenset(range(4, 30, 3)))]),
    )
    bounds = bounds_of(*cloud(rng, count, 0.3), np.float64)
    expected = brute_force(bounds, admissible)
    pairs = compiled(method, bounds, admissible, 1225)
    for world in range(WORLDS):
        assert len(expected[world]) > 0
        assert listed(pairs, world) == sorted(expected[world])


@pytest.mark.parametrize("method", BROADPHASES)
@pytest.mark.parametrize("scene", ["dense", "coincident", "touching lattice"])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_overflow_keeps_the_deepest_and_is_flagged(method, scene, precision):
    count, capacity = 61, 57
    rng = np.random.default_rng(1)
    center, half = SCENES[scene](rng, count)
    center = np.where(np.arange(WORLDS)[:, None, None] == 2, center + 10.0 * np.arange(count)[None, :, None], center)
    bounds = bounds_of(center, half, precision)
    admissible = everything(count)
    expected = brute_force(bounds, admissible)
    assert len(expected[0]) > capacity > len(expected[2])
    pairs = compiled(method, bounds, admissible, capacity)
    for world in range(WORLDS):
        depth = expected[world]
        ranked = sorted(depth, key=lambda pair, depth=depth: (-np.float32(depth[pair]), pair))
        assert listed(pairs, world) == sorted(ranked[:capacity])
        assert int(pairs.count[world]) == len(expected[world])
    np.testing.assert_array_equal(pairs.overflow, [len(e) > capacity for e in expected])


@pytest.mark.parametrize("count", [3, 9, 27, 200])
def test_the_deepest_by_digits_of_the_width_that_suits_a_number_of_shapes(count):
    """The tail digit of a depth, and digits that reach beyond the sign of an int32, are where it could go wrong."""
    rng = np.random.default_rng(count)
    center, half = cloud(rng, count, 1.0, (2.0, 3.0))
    half = half * np.where(rng.uniform(size=(WORLDS, count, 1)) < 0.2, 1e-20, 1.0)
    half[0] *= 1e25
    bounds, admissible = bounds_of(center, half, np.float32), everything(count)
    expected = brute_force(bounds, admissible)
    capacity = len(expected[1]) // 2 + 1
    pairs = compiled("all_pairs", bounds, admissible, capacity)
    for world, depth in enumerate(expected):
        ranked = sorted(depth, key=lambda pair, depth=depth: (-np.float32(depth[pair]), pair))
        assert len(ranked) > 1
        assert listed(pairs, world) == sorted(ranked[:capacity])


@pytest.mark.parametrize("method", BROADPHASES)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_bad_shapes_are_flagged_and_in_no_pair(method, bad, precision):
    rng = np.random.default_rng(5)
    count = 45
    center, half = cloud(rng, count, 0.4)
    center = center.copy()
    center[1, [0, 7, 44], [0, 1, 2]] = bad
    admissible = everything(count, 0.3)
    bounds = bounds_of(center, half, precision)
    expected = brute_force(bounds, admissible)
    pairs = compiled(method, bounds, admissible, 990)
    for world in range(WORLDS):
        kept = [p for p in sorted(expected[world]) if world != 1 or not {0, 7, 44} & set(p)]
        assert listed(pairs, world) == kept
    np.testing.assert_array_equal(pairs.invalid, [False, True, False])


def planes_and_boxes(dtype, count=40):
    """Bounds of four planes and `count` boxes, who may collide, and for each world {(plane, shape): depth}."""
    rng = np.random.default_rng(7)
    center, half = cloud(rng, count)
    normal = rng.normal(size=(WORLDS, 4, 3))
    normal[:, 0] = [0.0, 1.0, 0.0]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal, offset = normal.astype(dtype), rng.uniform(-0.9, -0.2, (WORLDS, 4)).astype(dtype)
    without = np.full((WORLDS, 4, 3), np.nan)
    bounds = bounds_of(np.concatenate([without, center], 1), np.concatenate([without, half], 1), dtype)
    vector = Vec3(*(jnp.asarray(normal[..., axis].T) for axis in range(3)))
    planes = Planes(vector, jnp.asarray(offset.T))
    bodies = (0, 0, 1, 2, *range(3, count + 3))
    admissible = Admissible(bodies, tuple(k < 4 or k % 5 == 0 for k in range(count + 4)), ((1, 3), (1, 4)))
    low, high = (np.stack([np.asarray(c, float) for c in corner]) for corner in bounds[:2])
    expected = brute_force(bounds, admissible)
    for world in range(WORLDS):
        for plane in range(4):
            n = normal[world, plane].astype(float)
            corners = np.where(n[:, None] > 0, low[:, :, world], high[:, :, world])
            spheres = n @ center[world].astype(dtype).T - np.asarray(bounds.radius, float)[4:, world] * (1 + 1e-4)
            lowest = np.maximum(n @ corners[:, 4:], spheres)
            for shape in range(4, count + 4):
                depth = offset[world, plane] - lowest[shape - 4]
                if depth >= 0 and not admissible.static[shape] and not (plane == 2 and shape in (4, 5)):
                    expected[world][plane, shape] = depth
    return bounds._replace(planes=planes), admissible, expected


@pytest.mark.parametrize("method", BROADPHASES)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_planes_meet_what_reaches_below_them(method, precision):
    bounds, admissible, expected = planes_and_boxes(precision)
    pairs = compiled(method, bounds, admissible, 44 * 43 // 2)
    for world in range(WORLDS):
        assert listed(pairs, world) == sorted(expected[world])
        assert 20 < sum(first < 4 for first, _ in expected[world]) < 100
    assert not np.any(pairs.overflow)
    assert not np.any(pairs.invalid)
    few = compiled(method, bounds, admissible, 25)
    for world in range(WORLDS):
        ranked = sorted(expected[world], key=lambda pair, depth=expected[world]: (-np.float32(depth[pair]), pair))
        assert len(set(listed(few, world)) & set(ranked[:25])) >= 24  # two depths may be equal but for the last bit
    assert np.all(few.overflow)


@pytest.mark.parametrize("method", BROADPHASES)
def test_bad_planes_are_flagged(method):
    bounds, admissible, _ = planes_and_boxes(np.float32)
    bad = bounds.planes._replace(offset=bounds.planes.offset.at[2, 1].set(np.nan))
    np.testing.assert_array_equal(
        compiled(method, bounds._replace(planes=bad), admissible, 100).invalid, [False, True, False]
    )


@pytest.mark.parametrize("method", BROADPHASES)
def test_all_shapes_bad(method):
    bounds = bounds_of(np.full((WORLDS, 9, 3), np.nan), np.ones((WORLDS, 9, 3)), np.float32)
    pairs = compiled(method, bounds, everything(9, 0.3), 20)
    assert not np.any(pairs.count)
    assert np.all(pairs.invalid)
    assert np.all((np.asarray(pairs.first) >= 0) & (np.asarray(pairs.second) < 9))


@pytest.mark.parametrize("method", BROADPHASES)
@pytest.mark.parametrize("count", [1, 2, 3])
def test_tiny_scenes(method, count):
    bounds = bounds_of(np.zeros((WORLDS, count, 3)), np.ones((WORLDS, count, 3)), np.float32)
    pairs = compiled(method, bounds, everything(count, 0.4), 4)
    np.testing.assert_array_equal(pairs.count, [len(p) for p in brute_force(bounds, everything(count, 0.4))])


@pytest.mark.parametrize("method", BROADPHASES)
def test_bounds_shared_by_all_worlds_are_spread(method):
    """A world axis of 1 means the same in every world."""
    bounds = bounds_of(*cloud(np.random.default_rng(0), 20, 0.3), np.float32)
    shared = bounds._replace(radius=bounds.radius[:, :1], low=bounds.low._replace(y=bounds.low.y[:, :1]))
    full = shared._replace(
        radius=jnp.repeat(shared.radius, WORLDS, 1), low=shared.low._replace(y=jnp.repeat(shared.low.y, WORLDS, 1))
    )
    for one, two in zip(*(compiled(method, b, everything(20), 190) for b in (shared, full)), strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("method", BROADPHASES)
def test_selection_has_no_derivative_and_does_not_break_one(method, float64):
    bounds = bounds_of(*cloud(np.random.default_rng(0), 20, 0.3), np.float64)

    def loss(bounds):
        pairs = compiled(method, bounds, everything(20), 190)
        first = jnp.take_along_axis(bounds.center.x, pairs.first, axis=0)
        return jnp.sum(jnp.where(pairs.active, first, 0.0) ** 2)

    for derivative in (jax.grad, jax.jacfwd):
        gradient = jax.jit(derivative(loss))(bounds)
        assert np.all(np.isfinite(gradient.center.x))
        assert np.any(np.asarray(gradient.center.x))
        assert not np.any(np.asarray(gradient.low.x))


def test_too_many_shapes_are_refused():
    with pytest.raises(ValueError, match="46340"):
        everything(50_000)


def test_method_follows_from_the_size_of_the_scene():
    mixed = [0.1] * 9 + [5.0]
    assert choose_method(64, 0, [0.1]) == "all_pairs"
    assert choose_method(1024, 0, [0.1, 0.2]) == "grid"
    assert choose_method(1024, 0, mixed) == "sort_and_sweep"
    assert choose_method(100, 2000, mixed) == "bvh"


@pytest.mark.parametrize("static", [False, True])
@pytest.mark.parametrize("part", [Box((0.2, 0.1, 0.1)), Capsule(0.1, 0.2)], ids=["boxes", "capsules"])
def test_all_shapes_of_a_kind_on_one_body(part, static):
    """What a body gives all its shapes was one row beside one row for each: the step could not be traced."""
    builder = SceneBuilder()
    builder.add_body(Plane((0, 1, 0), 0.0), static=True)
    parts = Compound([(part, ((side, 0, 0), (1, 0, 0, 0))) for side in (-0.2, 0.2)])
    builder.add_body(parts, position=(0, 0.5, 0), **({"static": True} if static else {"mass": 1.0}))
    for index in range(8):
        builder.add_body(Sphere(0.1), mass=1.0, position=(0.3 * index, 1.5, 0))
    model, state = builder.build()
    assert model.scene.broadphase is not None
    assert jax.eval_shape(lambda s: step(model, s), state).position.shape == (10, 3)


def balls_on_boxes():
    """Forty balls of one body on forty boxes of another: one pair shares the moving body with all others."""
    places = [(0.25 * i, 0.0, 0.5 * j) for i in range(-10, 10) for j in (-1, 1)]
    builder = SceneBuilder()
    boxes = Compound([(Box((0.12, 0.1, 0.12)), (place, (1, 0, 0, 0))) for place in places])
    balls = Compound([(Sphere(0.1), (place, (1, 0, 0, 0))) for place in places])
    builder.add_body(boxes, static=True, position=(0, -0.1, 0))
    builder.add_body(balls, mass=5.0, position=(0, 0.1, 0))
    return builder.build()


def test_a_body_of_many_shapes_has_turns_for_all_its_contacts():
    broadphase = balls_on_boxes()[0].scene.broadphase
    assert broadphase is not None and not broadphase.one_by_one
    (group,) = (group for group in broadphase.groups if group.kind_a != group.kind_b)
    assert 40 <= sum(tier.turn_count for tier in group.tiers) <= broadphase.capacity


@pytest.mark.slow
def test_a_body_of_many_shapes_stands_on_all_of_them():
    model, state = balls_on_boxes()
    final = rollout(model, state, 60)[0]
    assert not int(final.flags)
    np.testing.assert_allclose(final.position[1], state.position[1], atol=1e-5)
