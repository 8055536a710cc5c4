"""General convex distance against an independent float64 oracle: cutting planes with SciPy's NNLS and Qhull."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mathota_jax import Box, Polyhedron, signed_distance
from mathota_jax.collision.convex import SUPPORT, support
from mathota_jax.collision.convex.support import UNROLLED_VERTICES
from mathota_jax.collision.pairs import PAIRS, SEARCHED
from tests.benchmarks import pose_classes
from tests.benchmarks.pose_sweep import gate as error_gate
from tests.benchmarks.pose_sweep import measure, sweep
from tests.convex_oracle import (
    FLAT,
    KINDS,
    ROUND,
    Placed,
    Result,
    call,
    distance_to,
    extreme_point,
    oracle,
    random_scene,
    random_shape,
    rounded,
    to_engine,
)
from tests.direction_oracle import direction_distance
from tests.hulls import BOX_CORNERS
from tests.marks import QUICK_AND_SLOW_PRECISION, QUICK_IN_FLOAT64
from tests.polytope_oracle import polytope_distance, polytope_pairs

SEARCHED_PAIRS = [pair for pair in PAIRS if PAIRS[pair].method in SEARCHED]
"""The others have closed forms or exact searches of their own, and tests of those."""
QUICK = [("box", "polyhedron"), ("cylinder", "cone")]
"""Pairs of the normal suite; the slow one runs them all."""
NORMAL_COUNT, SLOW_COUNT = 40, 952
"""Poses of one class: the slow sweep has 21 classes x 952 poses, 20,000 in all, in each precision."""


def every_pair(*quick):
    return [
        pytest.param(pair, id="_".join(pair), marks=() if pair in quick else pytest.mark.slow)
        for pair in SEARCHED_PAIRS
    ]


def check(pair, scene, dtype):
    """Every gate on value, normal and witness points of a scene."""
    scene = rounded(scene, dtype)
    result = Result(pair, scene, dtype)
    assert result.types == {dtype}
    curved = not set(pair) <= {*FLAT, *ROUND}
    share = 2e-5 if dtype == np.float32 else 1e-6 if curved else 1e-9
    tight = 1e-5 if dtype == np.float32 else 1e-6
    np.testing.assert_allclose(np.linalg.norm(result.normal, axis=1), 1.0, atol=1e-6)
    failures = []
    for index in range(len(scene["pb"])):
        placed = Placed(pair, scene, index)
        size = placed.size()
        truth, normal = oracle(placed)
        truth = max(truth, placed.reach(result.normal[index]))
        error = result.separation[index] - truth
        # Inside the valid cone of normals: the separation along ours is the distance to the gate's precision.
        angle = np.degrees(np.arccos(np.clip(result.normal[index] @ normal, -1, 1)))
        valid = angle < 0.1 or abs(placed.reach(result.normal[index]) - truth) < share * size
        witness = np.abs(
            result.point_b[index] - result.point_a[index] - result.separation[index] * result.normal[index]
        )
        on_surface = max(abs(distance_to(placed, s, p[index])) for s, p in enumerate((result.point_a, result.point_b)))
        if abs(error) > share * size or not valid or witness.max() > tight * size or on_surface > 2 * tight * size:
            failures.append((index, truth, error, angle, witness.max(), on_surface, bool(result.converged[index])))
    assert not failures, failures[:5]
    return result


@pytest.mark.parametrize("pair", every_pair(*QUICK))
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_random_poses(pair, precision):
    result = check(pair, random_scene(pair, NORMAL_COUNT), precision)
    assert 0.1 < (result.separation < 0).mean() < 0.99  # both regimes are there
    # Deep overlaps of curved shapes are not always proved within the work budget.
    assert result.converged.mean() > (0.85 if {"cylinder", "cone"} & set(pair) else 0.99)


@pytest.mark.parametrize("kind", ["any: gap -0.0001", "1:1000: gap +1e-05", "needles: gap -1e-05"])
@pytest.mark.parametrize("pair", every_pair(*QUICK))
def test_what_is_not_flagged_is_right(pair, kind, precision):
    """Also at a size ratio of 1:1000 and for crossed needles; flagged poses are few, and all of them may be wrong."""
    result = measure(pair, sweep(pair, kind, NORMAL_COUNT, precision), precision)
    wrong = ~(np.maximum(result["separation"], result["normal"]) <= error_gate(pair, precision))
    assert not (wrong & result["converged"]).any()
    assert result["converged"].mean() >= (0.7 if kind.startswith("needles") else 0.9)


@pytest.mark.parametrize(
    "pair",
    [
        pytest.param(pair, id="_".join(pair), marks=() if pair == ("capsule", "polyhedron") else pytest.mark.slow)
        for pair in pose_classes.EVERY
    ],
)
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_separated_touching_shallow_and_deep_poses(pair, precision):
    """Nothing wrong without a flag and no wrong sign; see `tests.benchmarks.pose_classes` for 20,000 of each pair."""
    name = np.dtype(precision).name
    for row in pose_classes.measure(pair, *pose_classes.draw(pair, 2000), name, pose_classes.ways(pair, name)):
        assert row["wrong_unflagged"] == row["flips"] == 0, row
        # Overlaps of curved shapes are right long before they are proved.
        assert row["flagged"] <= (0.15 * row["poses"] if {"cylinder", "cone"} & set(pair) else 10), row


@pytest.mark.parametrize(
    "pair",
    [
        pytest.param(pair, id="_".join(pair), marks=() if pair == ("polyhedron", "polyhedron") else pytest.mark.slow)
        for pair in pose_classes.EVERY
    ],
)
def test_shapes_that_rest_on_each_other(pair):
    """A heap that lies still raises no flag: of polytopes with all but parallel faces every answer is proved."""
    scene, kinds, sizes = pose_classes.draw(pair, 4000, ["resting"])
    (row,) = pose_classes.measure(pair, scene, kinds, sizes, "float32", {"": pose_classes.registered})
    assert row["wrong"] == row["flips"] == 0, row
    # Where the edge of an end grazes, the overlap along many directions is the same to within the tolerance.
    assert row["flagged"] <= (0.005 * row["poses"] if {"cylinder", "cone"} & set(pair) else 0), row


@pytest.mark.parametrize("pair", [("cylinder", "cone"), pytest.param(("cone", "polyhedron"), marks=pytest.mark.slow)])
def test_the_search_of_directions_agrees_with_cutting_planes(pair):
    scene = random_scene(pair, 20, reach=1.5)
    truths, _ = direction_distance(pair, scene)
    expected = [oracle(Placed(pair, scene, index))[0] for index in range(20)]
    np.testing.assert_allclose(truths, expected, atol=1e-9)


@pytest.mark.parametrize("pair", polytope_pairs())
def test_the_two_oracles_agree(pair):
    scene = random_scene(pair, 6, reach=1.5)
    truths, _ = polytope_distance(pair, scene)
    expected = [oracle(Placed(pair, scene, index))[0] for index in range(6)]
    np.testing.assert_allclose(truths, expected, atol=1e-10)


def test_a_side_that_ends_before_it_crosses_the_other():
    """The lines of contact of two cylinders, of size ratio 1:1000, cross beyond the end of the small one."""
    scene = {
        "a": {"half_height": np.array([8.748348e-4]), "radius": np.array([6.637906e-4])},
        "b": {"half_height": np.array([0.9493164420127869]), "radius": np.array([0.28529810905456543])},
        "pa": np.array([[-0.01651114, -0.08964566, 0.20927234]]),
        "pb": np.array([[-0.28698921, -0.12458938, 0.11371686]]),
        "qa": np.array([[-0.72245622, 0.57233173, 0.38281742, -0.06280313]]),
        "qb": np.array([[0.78086001, 0.42143002, -0.45894176, 0.04502007]]),
    }
    check(("cylinder", "cylinder"), scene, np.dtype("float32"))


@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_a_corner_that_all_but_meets_a_corner(precision):
    """A hull with a corner pressed into a face of a box by next to nothing, at 1e-6 to 1e-2 from the corner of the face."""
    pair, count = ("box", "polyhedron"), 400
    scene = random_scene(pair, count)
    rng = np.random.default_rng(8)
    turns = [Rotation.from_quat(scene["q" + side][:, [1, 2, 3, 0]]) for side in "ab"]
    corners = scene["b"]["vertices"]
    lowest = np.argmax(np.einsum("pck,pk->pc", corners, turns[1].inv().apply(turns[0].apply([0.0, -1.0, 0.0]))), axis=1)
    target = scene["a"]["half_extents"] - 10 ** rng.uniform(-6, -2, (count, 3)) * [1, 0, 1]
    target[:, 1] -= rng.uniform(1e-6, 3e-5, count)
    scene["pb"] = scene["pa"] + turns[0].apply(target) - turns[1].apply(corners[np.arange(count), lowest])
    scene = rounded(scene, precision)
    truths, _ = polytope_distance(pair, scene)
    result = Result(pair, scene, precision)
    np.testing.assert_allclose(result.separation, truths, atol=error_gate(pair, precision))
    assert result.converged.mean() > 0.98


@pytest.mark.parametrize("other", ["capsule", "box"])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_a_sphere_whose_centre_all_but_touches_the_core(other, precision):
    """From 1e-9 to 1e-3 off an axis, a corner, an edge or a face, in any direction: in closed form, and proved."""
    rng, count = np.random.default_rng(11), 400
    core = np.array([0.0, 0.7, 0.0]) if other == "capsule" else np.array([0.3, 0.7, 0.5])
    on_core = core * rng.choice([-1.0, 0.25, 1.0], size=(count, 3))
    if other == "box":
        on_core[:, 0] = core[0] * rng.choice([-1.0, 1.0], size=count)
    outward = rng.normal(size=(count, 3))
    outward = np.where(np.abs(on_core) == core, np.copysign(outward, on_core), 0.0)
    if other == "capsule":
        outward[:, [0, 2]] = rng.normal(size=(count, 2))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    offset = outward * 10 ** rng.uniform(-9, -3, (count, 1))
    turns = Rotation.random(count, random_state=rng)
    shape = {"half_extents": np.tile(core, (count, 1))}
    if other == "capsule":
        shape = {"radius": np.full(count, 0.4), "half_height": np.full(count, 0.7)}
    scene = {
        "a": {"radius": np.full(count, 0.5)}, "b": shape, "pa": turns.apply(on_core + offset), "pb": np.zeros((count, 3)),
        "qa": np.tile([1.0, 0, 0, 0], (count, 1)), "qb": turns.as_quat()[:, [3, 0, 1, 2]],
    }  # fmt: skip
    result = Result(("sphere", other), rounded(scene, precision), precision)
    expected = np.linalg.norm(offset, axis=1) - (0.9 if other == "capsule" else 0.5)
    single = precision == np.float32
    np.testing.assert_allclose(result.separation, expected, atol=2e-5 if single else 1e-12)
    assert single or result.converged.all()


@pytest.mark.slow
@pytest.mark.parametrize("pair", SEARCHED_PAIRS, ids=["_".join(pair) for pair in SEARCHED_PAIRS])
def test_many_random_poses(pair, precision):
    check(pair, random_scene(pair, SLOW_COUNT, ("", "")), precision)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [1e-2, 1e-4, -1e-4, -1e-2])
@pytest.mark.parametrize("pair", every_pair(*QUICK))
def test_touching_and_shallow_poses(pair, gap, precision):
    scene = random_scene(pair, NORMAL_COUNT)
    for index in range(NORMAL_COUNT):
        truth, normal = oracle(Placed(pair, scene, index))
        scene["pb"][index] += (gap - truth) * normal
    result = check(pair, scene, precision)
    assert np.all((result.separation < 0) == (gap < 0))


@pytest.mark.slow
@pytest.mark.parametrize(
    "forms", [("needle", "plate"), ("plate", "plate"), ("needle", "needle"), ("small", ""), ("", "small")]
)
@pytest.mark.parametrize("pair", every_pair(*QUICK))
def test_extreme_forms(pair, forms, precision):
    check(pair, random_scene(pair, NORMAL_COUNT, forms, reach=1.0), precision)


@pytest.mark.slow
@pytest.mark.parametrize("pair", every_pair(*QUICK))
def test_nearly_coincident_centres(pair, precision):
    scene = random_scene(pair, NORMAL_COUNT)
    scene["pb"] = scene["pa"] + 1e-6 * (scene["pb"] - scene["pa"])
    check(pair, scene, precision)


@pytest.mark.parametrize("kind", KINDS)
def test_support_points_are_extreme(kind):
    with jax.enable_x64(True):
        rng = np.random.default_rng(3)
        shape, directions = random_shape(kind, rng, 200), rng.normal(size=(200, 3))
        scene = {
            "a": shape,
            "b": shape,
            "pa": directions,
            "pb": directions,
            "qa": np.eye(4)[[0] * 200],
            "qb": np.eye(4)[[0] * 200],
        }
        parameters, direction, *_ = to_engine(scene, np.float64)
        point, code = support(kind, parameters, direction)
        assert code.dtype == jnp.int32
        for index in range(200):
            expected = extreme_point(kind, {name: value[index] for name, value in shape.items()}, directions[index])
            np.testing.assert_allclose([np.broadcast_to(c, (1, 200))[0, index] for c in point], expected, atol=1e-12)
    assert set(SUPPORT) == set(KINDS)


@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_polyhedron_of_more_corners_than_are_unrolled(precision):
    """A hull above a plate: its lowest corner counts."""
    points = np.random.default_rng(4).normal(size=(UNROLLED_VERTICES + 12, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    hull, plate = Polyhedron(points), Box((5.0, 1.0, 5.0))
    assert len(hull.vertices) == len(points)
    level = np.array([1.0, 0.0, 0.0, 0.0])
    for height in (1.5, 1.9, 2.1):
        found = signed_distance(plate, (np.zeros(3), level), hull, (np.array([0.0, height, 0.0]), level))
        assert float(found.separation) == pytest.approx(height - 1 + points[:, 1].min(), abs=2e-6)
        np.testing.assert_allclose(found.normal, (0, 1, 0), atol=1e-6)


# ---- degenerate poses --------------------------------------------------------------------------------------------


def degenerate_scene(pair):
    turns = [Rotation.identity()]
    turns += [Rotation.from_rotvec(t * np.eye(3)[k]) for t in (1e-9, 1e-3, np.pi / 4) for k in (0, 2)]
    offsets = [
        (0, 0, 0),
        (1e-9, 0, 0),
        (1, 0, 0),
        (0, 1, 0),
        (1, 1, 0),
        (1, 1, 1),
        (0, 0.95, 0),
        (0.5, 0, 0),
        (0, 2, 0),
    ]
    table = list(itertools.product(offsets, turns))
    count = len(table)
    cube = 0.5 * BOX_CORNERS
    shapes = {
        "radius": np.full(count, 0.5), "half_height": np.full(count, 0.5), "half_extents": np.full((count, 3), 0.5),
        "vertices": np.tile(np.vstack([cube, cube[:1]]), (count, 1, 1)),  # one vertex repeated, as padding does
    }  # fmt: skip
    names = {"sphere": ("radius",), "box": ("half_extents",), "polyhedron": ("vertices",)}
    pick = lambda kind: {n: shapes[n] for n in names.get(kind, ("radius", "half_height"))}  # noqa: E731
    return {
        "a": pick(pair[0]), "b": pick(pair[1]), "pa": np.zeros((count, 3)), "pb": np.array([o for o, _ in table], float),
        "qa": np.tile([1.0, 0, 0, 0], (count, 1)), "qb": np.array([t.as_quat()[[3, 0, 1, 2]] for _, t in table]),
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("pair", every_pair(("box", "cylinder")))
def test_degenerate_poses(pair, precision):
    """Coincident centres, parallel axes, exact touch of faces, edges and corners, tilts to nothing: right and finite."""
    scene = rounded(degenerate_scene(pair), precision)
    result = Result(pair, scene, precision)
    share = 2e-5 if precision == np.float32 else 1e-6
    for index in range(0, len(scene["pb"]), 3):
        placed = Placed(pair, scene, index)
        truth = max(oracle(placed, 1e-7)[0], placed.reach(result.normal[index]))
        assert abs(result.separation[index] - truth) < share, index
        assert abs(placed.reach(result.normal[index]) - truth) < share, index

    def everything(*arguments):
        contact = call(pair, *arguments)
        return sum(
            jnp.sum(x) for x in jax.tree.leaves((contact.normal, contact.separation, contact.point_a, contact.point_b))
        )

    arguments = to_engine(scene, precision)
    gradient = jax.grad(everything, argnums=tuple(range(6)))
    tangents = jax.tree.map(jnp.ones_like, arguments)
    first, second = jax.jit(lambda *x: jax.jvp(gradient, x, tangents))(*arguments)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves((first, second)))


# ---- derivatives -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("pair", every_pair(("cylinder", "polyhedron")))
def test_derivatives_against_central_differences(pair):
    """Separation, normal and both points by every parameter and pose component, away from changes of feature."""
    with jax.enable_x64(True):
        arguments = to_engine(random_scene(pair, NORMAL_COUNT), np.float64)

        def outputs(*x):
            contact = call(pair, *x)
            values = [contact.separation, *contact.normal, *contact.point_a, *contact.point_b]
            return jnp.stack(values), contact.feature

        value = jax.jit(outputs)
        forward = jax.jit(lambda x, t: jax.jvp(lambda *y: outputs(*y)[0], x, t)[1])
        leaves, tree = jax.tree.flatten(arguments)
        zeros = [jnp.zeros_like(leaf) for leaf in leaves]
        here, _ = value(*arguments)
        step, compared = 1e-6, 0
        for position, leaf in enumerate(leaves):
            rows = [()] if leaf.ndim == 2 else [(k,) for k in range(0, leaf.shape[0], 5)]
            for row in rows:
                change = jnp.zeros_like(leaf).at[row].set(1.0)
                sides = []
                for sign in (-1, 1):
                    moved = [*leaves[:position], leaf + sign * step * change, *leaves[position + 1 :]]
                    sides.append(value(*jax.tree.unflatten(tree, moved)))
                # No change of feature within the step: there the second difference would be of first order.
                same = np.asarray(jnp.abs(sides[0][0] + sides[1][0] - 2 * here).max(0) < 1e-9)
                assert same.mean() > 0.8
                tangents = [*zeros[:position], change, *zeros[position + 1 :]]
                derivative = forward(arguments, jax.tree.unflatten(tree, tangents))
                difference = (sides[1][0] - sides[0][0]) / (2 * step)
                error = np.asarray(jnp.abs(difference - derivative) / (1 + jnp.abs(derivative)))
                assert error[:, same].max() < 1e-6, (position, row, np.argwhere((error > 1e-6) & same)[:5])
                compared += 1
        assert compared >= 14


@pytest.mark.slow
def test_reverse_mode_agrees_with_forward():
    pair = ("cylinder", "polyhedron")
    with jax.enable_x64(True):
        arguments = to_engine(random_scene(pair, 16), np.float64)
        tangents = jax.tree.map(lambda x: jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape), arguments)
        function = lambda *x: call(pair, *x).separation.sum()  # noqa: E731
        _, forward = jax.jvp(function, arguments, tangents)
        gradient = jax.jit(jax.grad(function, argnums=tuple(range(6))))(*arguments)
        products = jax.tree.map(lambda g, t: (g * t).sum(), gradient, tangents)
        assert float(sum(jax.tree.leaves(products))) == pytest.approx(float(forward), rel=1e-9)
