"""The axis of least overlap of two polytopes: closed forms, random poses against the oracle, tables of many pairs."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mathota_jax.collision.convex.difference import difference
from mathota_jax.collision.convex.polytope import POLYTOPES, polytope
from mathota_jax.collision.convex.separating_axis import separating_axis
from mathota_jax.collision.polyhedron import edge_table
from mathota_jax.geometry.hull import convex_hull, padded_faces
from mathota_jax.spatial import wanted as some_of_many
from mathota_jax.spatial.pose import Pose
from mathota_jax.spatial.quaternion import Quaternion, to_matrix
from mathota_jax.spatial.vector import Vec3, cross, dot, norm
from mathota_jax.spatial.wanted import LANES
from tests.convex_oracle import Placed, oracle, random_scene, rounded, to_engine, with_faces
from tests.marks import QUICK_IN_FLOAT64


@functools.partial(jax.jit, static_argnames="pair")
def axis(pair, wanted, a, pa, qa, b, pb, qb):
    shapes = difference(
        pair[0], with_faces(a), Pose(pa, to_matrix(qa)), pair[1], with_faces(b), Pose(pb, to_matrix(qb))
    )
    cores = (polytope(kind, with_faces(core)) for kind, core in zip(pair, (shapes.a, shapes.b), strict=True))
    return separating_axis(shapes, *cores, wanted), shapes.scale


@pytest.mark.parametrize("pair", [("polyhedron", "polyhedron"), ("capsule", "box"), ("sphere", "polyhedron")])
@pytest.mark.parametrize("precision", QUICK_IN_FLOAT64, indirect=True)
def test_depth_of_overlapping_cores_against_the_oracle(pair, precision):
    """In more pairs than are tested at a time, of which only some are wanted."""
    count = LANES + 400
    scene = random_scene(pair, count, reach=0.3)
    for side in "ab":
        if "radius" in scene[side]:
            scene[side]["radius"] *= 1e-9  # what the oracle calls overlap is that of the cores
    scene = rounded(scene, precision)
    wanted = np.arange(count) % 7 != 3
    found, scale = axis(pair, jnp.asarray(wanted[None]), *to_engine(scene, precision))
    separation = np.asarray(found.separation * scale)[0]
    assert np.isfinite(separation).all()
    compared = 0
    for index in np.flatnonzero(wanted)[::10]:
        truth, _ = oracle(Placed(pair, scene, index))
        if truth < -1e-6:
            assert separation[index] == pytest.approx(truth, abs=2e-6 if precision == np.float32 else 1e-9)
            compared += 1
    assert compared > 10


def test_all_pairs_at_once_as_on_gpus(monkeypatch, float64):
    """The same axes, of shapes of which half are so far apart that they would test every edge."""
    pair, count = ("polyhedron", "polyhedron"), LANES + 7
    scene = random_scene(pair, count, reach=0.3)
    scene["pb"][::2] *= 100.0
    arguments = pair, jnp.asarray(np.arange(count)[None] % 2 == 1), *to_engine(scene, np.float64)
    in_turns, _ = axis(*arguments)
    monkeypatch.setattr(some_of_many, "by_platform", lambda anywhere, on_gpu, result, *args: on_gpu(*args))
    at_once, _ = jax.jit(axis.__wrapped__, static_argnames="pair")(*arguments)
    assert (in_turns.separation < 0).sum() > count // 4
    for one, other in zip(jax.tree.leaves(in_turns), jax.tree.leaves(at_once), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-14)


def pose(offset, turn=(0, 0, 0)):
    w, x, y, z = Rotation.from_rotvec(turn).as_quat()[[3, 0, 1, 2]]
    quaternion = Quaternion(*(jnp.full((1, 1), c) for c in (w, x, y, z)))
    return Pose(Vec3(*(jnp.full((1, 1), c) for c in np.asarray(offset, float))), to_matrix(quaternion))


def test_crossed_edges_of_two_cubes(float64):
    """Each stands on an edge; the edges cross at a right angle and overlap by 2 sqrt(2) less the distance."""
    cube = {"half_extents": Vec3(*(jnp.ones((1, 1)) for _ in range(3)))}
    quarter = np.pi / 4
    shapes = difference("box", cube, pose((0, 0, 0), (quarter, 0, 0)), "box", cube, pose((0, 2.7, 0), (0, 0, quarter)))
    found = separating_axis(shapes, polytope("box", shapes.a), polytope("box", shapes.b), jnp.ones((1, 1), bool))
    assert float((found.separation * shapes.scale)[0, 0]) == pytest.approx(2.7 - 2 * np.sqrt(2), abs=1e-12)
    up = [float(c[0, 0]) for c in pose((0, 0, 0), (quarter, 0, 0)).rotation.apply(found.direction)]
    np.testing.assert_allclose(up, (0, 1, 0), atol=1e-12)


def test_different_polyhedra_in_one_table(float64):
    """A cube and a tetrahedron, whose padded faces and edges change nothing, against the same cube."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    hulls = [convex_hull("cube", corners), convex_hull("tetrahedron", np.vstack([np.zeros(3), np.eye(3)]))]
    full = [np.vstack([h.vertices, np.repeat(h.vertices[-1:], 8 - len(h.vertices), axis=0)]) for h in hulls]
    both = {
        "vertices": Vec3(*(jnp.asarray(np.stack(full)[:, :, k].T[..., None]) for k in range(3))),
        "faces": padded_faces([h.faces for h in hulls]),
    }
    cube = {"half_extents": Vec3(*(jnp.ones((1, 1)) for _ in range(3)))}
    place = Pose(Vec3(jnp.array([[1.5], [1.9]]), jnp.zeros((2, 1)), jnp.full((2, 1), 0.1)), pose((0, 0, 0)).rotation)
    shapes = difference("polyhedron", both, pose((0, 0, 0)), "box", cube, place)
    core = polytope("polyhedron", {**shapes.a, "faces": both["faces"]})
    found = separating_axis(shapes, core, polytope("box", shapes.b), jnp.ones((2, 1), bool))
    np.testing.assert_allclose((found.separation * shapes.scale)[:, 0], (-0.5, -0.1), atol=1e-12)
    np.testing.assert_allclose(np.stack(found.direction)[:, :, 0], np.outer((1, 0, 0), (1, 1)), atol=1e-12)


@pytest.mark.parametrize("kind", POLYTOPES)
def test_edges_run_along_the_product_of_their_normals(kind):
    shape = jax.tree.map(lambda c: c[..., :1], to_engine(random_scene((kind, kind), 2), np.float32)[0])
    core = polytope(kind, with_faces(shape))
    if kind == "sphere":
        assert core.edges is None
        return
    for start, end, left, right in np.moveaxis(core.edges, -1, 0)[0].T:
        along = core.vertices.map(lambda c, e=end, s=start: c[e, 0] - c[s, 0])
        across = cross(*(core.normals.map(lambda c, f=face: c[f, 0]) for face in (left, right)))
        assert (np.asarray(dot(across, along)) > 0).all()
        assert np.asarray(norm(cross(across, along)) / norm(along)).max() < 1e-5


def test_an_edge_table_names_each_edge_once():
    hull = convex_hull("points", np.random.default_rng(2).normal(size=(30, 3)))
    start, end, left, right = edge_table(padded_faces([hull.faces]))[:, :, 0]
    assert len(start) == len(hull.vertices) + len(hull.faces) - 2  # Euler
    for ends in zip(start, end, left, right, strict=True):
        assert set(ends[:2]) <= set(hull.faces[ends[2]]) & set(hull.faces[ends[3]])
