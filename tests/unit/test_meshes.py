"""Mesh files: hulls, convex decompositions and their cache. Runs only with the extra `io`."""

import sys

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from mathota_jax import Polyhedron, SceneBuilder, step
from mathota_jax.io import load_convex_parts, load_mesh, simplified_hull
from mathota_jax.io import meshes as module
from tests.hulls import BOX_CORNERS

BALL = np.random.default_rng(0).normal(size=(2000, 3))
BALL /= np.linalg.norm(BALL, axis=1, keepdims=True)

# ---- without extras --------------------------------------------------------------------------------------------------


def test_a_hull_of_few_corners_is_kept_whole():
    points = np.concatenate([BOX_CORNERS, 0.5 * BOX_CORNERS])
    np.testing.assert_array_equal(np.unique(simplified_hull(points), axis=0), np.unique(BOX_CORNERS, axis=0))


def test_a_hull_of_many_corners_is_thinned_out_evenly():
    kept = simplified_hull(BALL, 64)
    shape = Polyhedron(kept)
    assert len(shape.vertices) == 64
    assert {tuple(p) for p in kept} <= {tuple(p) for p in BALL}
    assert shape.volume() > 0.85 * ConvexHull(BALL).volume  # 64 even points give 0.89 (icosahedral bound)
    assert shape.inradius() > 0.8
    thin = simplified_hull(BALL * [1, 1e-3, 1e-2], 12)
    assert len(Polyhedron(thin).vertices) == 12


@pytest.mark.parametrize("limit", [3, 65, 8.0, "many"])
def test_vertex_limit_is_checked(limit):
    with pytest.raises(ValueError, match="vertex_limit must be a whole number from 4 to 64"):
        simplified_hull(BOX_CORNERS, limit)


def test_degenerate_points_are_left_to_polyhedron():
    with pytest.raises(ValueError, match=r"Polyhedron\.points must span a volume"):
        Polyhedron(simplified_hull(BOX_CORNERS[:4]))


@pytest.mark.parametrize("load", [load_mesh, load_convex_parts])
def test_missing_extra_is_named(load, monkeypatch, tmp_path):
    (tmp_path / "cube.obj").write_text("")
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r'needs trimesh: pip install "mathota-jax\[io\]"'):
        load(tmp_path / "cube.obj")


# ---- with trimesh ----------------------------------------------------------------------------------------------------


@pytest.fixture
def trimesh():
    return pytest.importorskip("trimesh")


@pytest.mark.parametrize("suffix", ["obj", "stl"])
def test_the_hull_of_a_file(suffix, trimesh, tmp_path):
    path = tmp_path / f"box.{suffix}"
    mesh = trimesh.creation.box((2.0, 4.0, 6.0))
    mesh.apply_translation((10.0, 0.0, 0.0))
    mesh.export(path)
    shape = load_mesh(path, scale=0.1)
    assert (len(shape.vertices), len(shape.faces)) == (8, 6)
    np.testing.assert_allclose(shape.volume(), 0.048, rtol=1e-6)
    np.testing.assert_allclose(shape.center_of_mass(), (1.0, 0.0, 0.0), atol=1e-6)


def test_a_round_mesh_is_simplified(trimesh, tmp_path):
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(4).export(path)
    shape = load_mesh(path)
    assert len(shape.vertices) == 64
    assert len(load_mesh(path, vertex_limit=20).vertices) == 20


def test_bad_files_are_named(trimesh, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.stl"):
        load_mesh(tmp_path / "nowhere.stl")
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    with pytest.raises(ValueError, match=r"empty\.obj"):
        load_mesh(tmp_path / "empty.obj")
    (tmp_path / "noise.stl").write_bytes(b"\x00\x01 not a mesh")
    with pytest.raises(ValueError, match=r"noise\.stl"):
        load_mesh(tmp_path / "noise.stl")
    (tmp_path / "scene.doc").write_text("text")
    with pytest.raises(ValueError, match=r"scene\.doc"):
        load_mesh(tmp_path / "scene.doc")
    mesh = trimesh.creation.box()
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    mesh.export(tmp_path / "open.stl")
    for load in (load_mesh, load_convex_parts):
        with pytest.raises(ValueError, match=r"open\.stl' is not a closed .*: 3 of 18 edges .*repair"):
            load(tmp_path / "open.stl")
    fin = trimesh.creation.box()
    fin = trimesh.Trimesh(np.concatenate([fin.vertices, [[3, 3, 3]]]), np.concatenate([fin.faces, [[0, 1, 8]]]))
    fin.export(tmp_path / "fin.obj")
    with pytest.raises(ValueError, match=r"fin\.obj' is not a closed \(manifold\) surface"):
        load_mesh(tmp_path / "fin.obj")
    (tmp_path / "nan.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv nan 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    with pytest.raises(ValueError, match=r"nan\.obj' holds vertices that are not finite"):
        load_mesh(tmp_path / "nan.obj")
    with pytest.raises(ValueError, match="scale must be a positive"):
        load_mesh(tmp_path / "fin.obj", scale=-1.0)


# ---- with coacd ------------------------------------------------------------------------------------------------------


@pytest.fixture
def angle(trimesh, tmp_path):
    """An L of three unit cubes, 1 m^3 each."""
    pytest.importorskip("coacd")
    section = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
    vertices = np.array([(x, y, z) for z in (0.0, 1.0) for x, y in section])
    sides = [t for k in range(6) for t in ((k, (k + 1) % 6, 6 + k), ((k + 1) % 6, 6 + (k + 1) % 6, 6 + k))]
    caps = [(0, 3, 1), (1, 3, 2), (0, 5, 3), (3, 5, 4)]
    top = [(a + 6, c + 6, b + 6) for a, b, c in caps]
    path = tmp_path / "angle.obj"
    trimesh.Trimesh(vertices, np.array(sides + caps + top)).export(path)
    return path


def test_a_concave_mesh_becomes_convex_parts(angle):
    shape = load_convex_parts(angle, scale=0.1, cache=False)
    assert len(shape.parts) == 2
    np.testing.assert_allclose(shape.volume(), 3e-3, rtol=0.05)
    np.testing.assert_allclose(shape.center_of_mass(), np.array([5 / 6, 5 / 6, 0.5]) * 0.1, atol=4e-3)
    assert load_mesh(angle).volume() > 3.4  # the hull fills the notch
    builder = SceneBuilder()
    builder.add_body(shape, density=1000.0, position=(0, 1, 0))
    model, state = builder.build()
    assert float(step(model, state).velocity[0, 1]) < 0
    assert not list(angle.parent.glob("*.npz"))


def test_the_cache_knows_content_and_settings(angle, monkeypatch, tmp_path):
    calls = []
    original = module._decomposed
    monkeypatch.setattr(module, "_decomposed", lambda *a: calls.append(1) or original(*a))
    first = load_convex_parts(angle)
    again = load_convex_parts(angle, scale=2.0)  # the scale is applied after the cache
    assert (len(calls), len(list(angle.parent.glob("angle.*.parts.npz")))) == (1, 1)
    np.testing.assert_allclose(again.volume(), 8 * first.volume())
    load_convex_parts(angle, threshold=0.3)
    assert len(calls) == 2
    angle.write_text(angle.read_text() + "\n# changed\n")
    load_convex_parts(angle)
    assert len(calls) == 3
    load_convex_parts(angle, cache=tmp_path / "folder")
    load_convex_parts(angle, cache=str(tmp_path / "folder"))
    assert len(calls) == 4
    (stored,) = (tmp_path / "folder").iterdir()
    stored.write_bytes(b"broken")
    load_convex_parts(angle, cache=tmp_path / "folder")
    assert len(calls) == 5
    load_convex_parts(angle, cache=tmp_path / "folder")
    assert len(calls) == 5


@pytest.mark.parametrize(
    ("setting", "message"),
    [({"threshold": 0.0}, "threshold"), ({"part_limit": 0}, "part_limit"), ({"vertex_limit": 100}, "vertex_limit")],
)
def test_bad_settings_are_named(setting, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        load_convex_parts(tmp_path / "any.obj", **setting)
