"""The viewer's geometry and clock, run in Node where it is installed, against closed forms and SciPy."""

import json
import math
import shutil
import subprocess

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from training.replay import ASSETS, SCRIPTS

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="needs Node.js on the path")


def evaluate(expression, *scripts):
    source = "\n".join((ASSETS / name).read_text(encoding="utf-8") for name in scripts)
    program = f'"use strict";\n{source}\nconsole.log(JSON.stringify({expression}));'
    done = subprocess.run([NODE, "-"], input=program, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


RADIUS, HALF = 0.3, 0.5
TETRAHEDRON = [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]
VOLUMES = {
    "sphere": ({"radius": RADIUS}, 4 / 3 * math.pi * RADIUS**3),
    "box": ({"halfExtents": [0.1, 0.2, 0.4]}, 8 * 0.1 * 0.2 * 0.4),
    "capsule": ({"radius": RADIUS, "halfHeight": HALF}, math.pi * RADIUS**2 * (2 * HALF + 4 / 3 * RADIUS)),
    "cylinder": ({"radius": RADIUS, "halfHeight": HALF}, 2 * math.pi * RADIUS**2 * HALF),
    "cone": ({"radius": RADIUS, "halfHeight": HALF}, 2 / 3 * math.pi * RADIUS**2 * HALF),
    "polyhedron": (
        {"vertices": [[3, -1, -1], [-1, 3, -1], [-1, -1, 3], [-1, -1, -1]], "triangles": TETRAHEDRON},
        4**3 / 6,
    ),
}


@pytest.mark.parametrize("kind", VOLUMES)
def test_meshes_enclose_the_volume_about_their_centroid(kind):
    size, volume = VOLUMES[kind]
    mesh = evaluate(f"MESHES.{kind}({json.dumps(size)})", "vectors.js", "meshes.js")
    points, normals = np.array(mesh["points"]), np.array(mesh["normals"])
    a, b, c = (points[np.array(mesh["triangles"])[:, corner]] for corner in range(3))
    parts = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6  # positive where the winding is outward
    assert parts.sum() == pytest.approx(volume, rel=0.02)
    centroid = (parts[:, None] * (a + b + c) / 4).sum(0) / parts.sum()
    assert centroid == pytest.approx([0, 0, 0], abs=2e-3)
    face = np.cross(b - a, c - a)
    mean = normals[np.array(mesh["triangles"])].sum(1)
    assert (np.einsum("ij,ij->i", face, mean) >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-9)


def test_pose_and_camera_matrices_agree_with_scipy_and_the_pinhole():
    quaternion, position, point = [0.5, -0.1, 0.7, 0.5], [1.0, 2.0, 3.0], [0.3, -0.4, 0.9]
    quaternion = (np.array(quaternion) / np.linalg.norm(quaternion)).tolist()
    eye, target, up, angle, aspect = [4, 3, 5], [0.5, 1, 1], [0, 0, 1], 0.7, 1.5
    placed, clip = evaluate(
        f"[transform(poseMatrix({position}, {quaternion}), {point}),"
        f" transform(multiply(perspective({angle}, {aspect}, 0.1, 100), lookAt({eye}, {target}, {up})), {point})]",
        "vectors.js",
    )
    rotation = Rotation.from_quat(np.roll(quaternion, -1))
    assert placed == pytest.approx([*(rotation.apply(point) + position), 1])
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    offset = np.subtract(point, eye)
    depth, focal = offset @ forward, 1 / math.tan(angle / 2)
    expected = [focal / aspect * (offset @ right) / depth, focal * (offset @ np.cross(right, forward)) / depth]
    assert [clip[0] / clip[3], clip[1] / clip[3]] == pytest.approx(expected)
    assert clip[3] == pytest.approx(depth)
    assert -1 < clip[2] / clip[3] < 1


def test_shadows_land_on_the_plane_along_the_light():
    normal, light, point = np.array([0.6, 0.8, 0]), np.array([0.48, 0.6, 0.64]), np.array([0.3, 2.0, -1.0])
    image = evaluate(f"transform(shadowMatrix([0.6, 0.8, 0], -0.5, [0.48, 0.6, 0.64]), {point.tolist()})", "vectors.js")
    assert normal @ image[:3] == pytest.approx(-0.5)
    assert np.cross(image[:3] - point, light) == pytest.approx([0, 0, 0], abs=1e-12)
    assert image[3] == 1


PLAYER = """(() => {
  const recording = { duration: 2, data: { dt: 0.5, frameCount: 5 }, frameAt: (time) => Math.floor(time / 0.5 + 1e-6) };
  const player = createPlayer(recording, () => {});
  const seen = [];
  const note = () => seen.push([player.time, player.playing]);
  player.advance(1); note();
  player.play(true); player.speed = 2; player.advance(0.6); note();
  player.stepFrames(-1); note();
  player.looping = false; player.play(true); player.advance(9); note();
  player.play(true); note();
  player.looping = true; player.advance(9); note();
  player.seek(-3); note();
  return seen;
})()"""


def test_the_clock_plays_steps_stops_and_loops():
    assert evaluate(PLAYER, "player.js") == [
        [0, False],
        [1.2, True],
        [0.5, False],
        [2, False],
        [0, True],
        [0, True],
        [0, True],
    ]


RECORDING = """(() => {
  const encode = (array) => btoa(String.fromCharCode(...new Uint8Array(array.buffer)));
  const half = Math.SQRT1_2;
  const recording = createRecording({
    dt: 0.5, frameCount: 3, bodyCount: 1,
    position: encode(new Float32Array([0, 0, 0, 2, 4, 6, NaN, 0, 0])),
    orientation: encode(new Float32Array([1, 0, 0, 0, -half, 0, 0, -half, 1, 0, 0, 0])),
    contacts: {
      count: encode(new Uint32Array([0, 2, 1])),
      position: encode(new Float32Array([1, 0, 0, 2, 0, 0, 3, 0, 0])),
      normal: encode(new Float32Array([0, 1, 0, 0, 1, 0, 0, 1, 0])),
      force: encode(new Float32Array([0, 5, 0, 0, 7, 0, 0, 0, 0])),
    },
  });
  const points = (time) => recording.contactsAt(time).map(({ position }) => position[0]);
  return [recording.pose(0.25, 0), recording.pose(0.75, 0), recording.pose(1, 0), points(0.3), points(0.6), points(1),
    recording.typicalForce];
})()"""


def test_recordings_are_interpolated_the_short_way_and_hide_what_is_not_finite():
    between, before_break, broken, none, two, one, typical = evaluate(RECORDING, "vectors.js", "recording.js")
    assert between["position"] == [1, 2, 3]
    eighth = math.pi / 8  # half of a quarter turn about z, as a half angle
    assert between["orientation"] == pytest.approx([math.cos(eighth), 0, 0, math.sin(eighth)], abs=1e-6)
    assert before_break["position"] == [2, 4, 6]
    assert broken is None
    assert (none, two, one) == ([], [1, 2], [3])
    assert typical == 5


PLACED = """(() => {
  const half = Math.SQRT1_2;
  const place = placeInBody({ localPosition: [1, 0, 0], localOrientation: [half, 0, 0, half] });
  const body = poseMatrix([0, 0, 5], [half, 0, half, 0]);
  return [transform(multiply(body, place), [1, 0, 0]), placeInBody({})];
})()"""


def test_parts_of_compounds_are_placed_in_their_body():
    point, nowhere = evaluate(PLACED, "vectors.js", "scene_items.js")
    # The part turns x to y and shifts to (1, 1, 0); the body turns x to -z.
    assert point == pytest.approx([0, 1, 4, 1], abs=1e-12)
    assert nowhere == [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def test_terrain_is_the_surface_that_the_engine_stands_on():
    """Triangles of the grid as `Heightfield` documents it, and outward normals: the volume below a surface is known."""
    heights = np.random.default_rng(0).uniform(0.5, 1.5, (3, 4))
    mesh = evaluate(f"heightfieldMesh({json.dumps(heights.tolist())}, 0.5)", "vectors.js", "meshes.js")
    points, triangles = np.array(mesh["points"]), np.array(mesh["triangles"])
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    areas = 0.5 * np.cross(b - a, c - a)[:, 1]
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(2 * 3 * 0.5**2)
    weights = np.zeros((3, 4))
    for i in range(2):
        for j in range(3):
            weights[[i, i, i + 1], [j, j + 1, j + 1]] += 1  # below and above the diagonal of the cell
            weights[[i, i + 1, i + 1], [j, j + 1, j]] += 1
    below = (areas * (a + b + c)[:, 1] / 3).sum()
    assert below == pytest.approx((weights * heights).sum() / 3 * 0.5**2 / 2)
    assert points.min(0)[[0, 2]] == pytest.approx([-0.5, -0.75])
    assert np.array(mesh["normals"])[:, 1].min() > 0


def test_the_whole_script_parses():
    source = "\n".join((ASSETS / name).read_text(encoding="utf-8") for name in SCRIPTS)
    done = subprocess.run([NODE, "--check", "-"], input=source, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
