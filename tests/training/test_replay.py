"""The replay file: self-contained, well-formed, and its embedded data decoded independently of the writer."""

import base64
import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from mathota_jax import Box, Capsule, Options, Plane, SceneBuilder, Sphere, contacts, rollout
from training.replay import ASSETS, SCRIPTS, write_replay

VOID = {"meta", "input", "link", "img", "br"}
FRAMES, BODIES, SLOTS = 7, 4, 3


class Page(HTMLParser):
    """Collects elements, attributes and text, and checks that elements nest."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.attributes, self.text = [], [], [], {}
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.attributes += [(tag, name, value) for name, value in attributes]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        tag = self.open[-1] if self.open else ""
        self.text.setdefault(tag, []).append(data)


@pytest.fixture(scope="module")
def model():
    builder = SceneBuilder(gravity=(0, 0, -9.8))
    builder.add_body(Plane(normal=(0, 0, 1), offset=0.5), static=True)
    builder.add_body(Sphere(0.25), mass=1.0, position=(0, 0, 2))
    builder.add_body(Box((0.1, 0.2, 0.3)), mass=1.0, position=(1, 0, 2))
    builder.add_body(Capsule(0.1, 0.4), mass=1.0, position=(2, 0, 2))
    return builder.build()[0]


@pytest.fixture
def trajectory():
    random = np.random.default_rng(0)
    orientation = random.normal(size=(FRAMES, BODIES, 4))
    orientation /= np.linalg.norm(orientation, axis=-1, keepdims=True)
    return SimpleNamespace(
        position=random.normal(size=(FRAMES, BODIES, 3)).astype(np.float32), orientation=orientation.astype(np.float32)
    )


@pytest.fixture
def touches():
    random = np.random.default_rng(1)
    normal = random.normal(size=(FRAMES, SLOTS, 3))
    return {
        "position": random.normal(size=(FRAMES, SLOTS, 3)).astype(np.float32),
        "normal": (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32),
        "force": random.uniform(1, 9, size=(FRAMES, SLOTS)).astype(np.float32),
        "active": np.array(
            [[frame % 2, slot != 1, frame > 4] for frame in range(FRAMES) for slot in [frame % 3]], bool
        ),
    }


@pytest.fixture
def write(tmp_path):
    def written(*arguments, **options):
        path = tmp_path / "some" / "folder" / "replay.html"
        write_replay(path, *arguments, **options)
        return path.read_text(encoding="utf-8")

    return written


def embedded(text):
    found = re.findall(r'<script type="application/json" id="recording">(.*?)</script>', text, re.DOTALL)
    assert len(found) == 1
    return json.loads(found[0])


def floats(text, *shape, dtype="<f4"):
    return np.frombuffer(base64.b64decode(text, validate=True), dtype).reshape(shape)


def test_page_needs_nothing_from_outside(write, model, trajectory, touches):
    text = write(model, trajectory, 0.1, contacts=touches, title="A run")
    page = Page(text)
    assert "://" not in re.sub(r"data:[^\"']*", "", text)
    assert not [entry for entry in page.attributes if entry[1] in {"src", "href", "srcset", "action", "data"}]
    assert not {"link", "iframe", "object", "embed", "img", "base"} & set(page.tags)
    for request in ("fetch(", "XMLHttpRequest", "WebSocket", "import(", "importScripts", "@import", "url("):
        assert request not in text
    assert page.text["title"] == ["A run"]
    assert "@@" not in text


def test_every_script_and_every_element_it_asks_for_is_in_the_page(write, model, trajectory):
    assert {path.name for path in ASSETS.glob("*.js")} == set(SCRIPTS)
    text = write(model, trajectory, 0.1)
    ids = [value for _, name, value in Page(text).attributes if name == "id"]
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'element\("(\w+)"\)', text)) <= set(ids)


def test_poses_round_trip_bit_for_bit(write, model, trajectory):
    trajectory.position[3, 2, 1] = np.nan
    data = embedded(write(model, trajectory, 1 / 240))
    assert (data["frameCount"], data["bodyCount"], data["dt"]) == (FRAMES, BODIES, 1 / 240)
    position = floats(data["position"], FRAMES, BODIES, 3)
    np.testing.assert_array_equal(position, trajectory.position)
    np.testing.assert_array_equal(floats(data["orientation"], FRAMES, BODIES, 4), trajectory.orientation)
    assert data["contacts"] is None


def test_shapes_carry_their_sizes_and_bodies(write, model, trajectory):
    shapes = embedded(write(model, trajectory, 0.1))["shapes"]
    by_kind = {shape["kind"]: shape for shape in shapes}
    assert [shape["body"] for shape in shapes] == [0, 1, 2, 3]
    assert by_kind["plane"]["normal"] == [0, 0, 1]
    assert by_kind["plane"]["offset"] == 0.5
    assert by_kind["sphere"]["radius"] == 0.25
    assert by_kind["box"]["halfExtents"] == pytest.approx([0.1, 0.2, 0.3])
    assert (by_kind["capsule"]["radius"], by_kind["capsule"]["halfHeight"]) == pytest.approx((0.1, 0.4))
    assert len({tuple(shape["colour"]) for shape in shapes}) == 4


def test_up_is_against_gravity(write, model, trajectory):
    right, up, front = np.array(embedded(write(model, trajectory, 0.1))["basis"])
    assert up == pytest.approx([0, 0, 1])
    assert np.cross(right, up) == pytest.approx(front)


def test_active_contacts_round_trip(write, model, trajectory, touches):
    data = embedded(write(model, trajectory, 0.1, contacts=touches))["contacts"]
    active = touches["active"]
    assert 0 < active.sum() < active.size
    np.testing.assert_array_equal(floats(data["count"], FRAMES, dtype="<u4"), active.sum(1))
    np.testing.assert_array_equal(floats(data["position"], -1, 3), touches["position"][active])
    np.testing.assert_array_equal(floats(data["normal"], -1, 3), touches["normal"][active])
    force = floats(data["force"], -1, 3)
    np.testing.assert_allclose(np.linalg.norm(force, axis=-1), touches["force"][active], rtol=1e-5)
    np.testing.assert_allclose(np.cross(force, touches["normal"][active]), 0, atol=1e-5)


def test_contacts_may_be_an_object_with_force_vectors_and_no_mask(write, model, trajectory, touches):
    vectors = np.random.default_rng(2).normal(size=(FRAMES, SLOTS, 3)).astype(np.float32)
    given = SimpleNamespace(position=touches["position"], normal=touches["normal"], force=vectors)
    data = embedded(write(model, trajectory, 0.1, contacts=given))["contacts"]
    np.testing.assert_array_equal(floats(data["force"], FRAMES, SLOTS, 3), vectors)


def test_pairs_that_do_not_touch_are_left_out(write, model, trajectory, touches):
    given = {name: touches[name] for name in ("position", "normal")}
    separation = np.full((FRAMES, SLOTS), 0.2)
    separation[2, 1] = -0.001
    force = np.zeros((FRAMES, SLOTS))
    force[5, 0] = 3.0
    data = embedded(write(model, trajectory, 0.1, contacts={**given, "separation": separation, "force": force}))
    assert floats(data["contacts"]["count"], FRAMES, dtype="<u4").tolist() == [0, 0, 1, 0, 0, 1, 0]


def test_a_contact_that_is_not_finite_is_left_out(write, model, trajectory, touches):
    touches["active"][:] = True
    touches["normal"][1, 2] = np.nan
    data = embedded(write(model, trajectory, 0.1, contacts=touches))["contacts"]
    assert floats(data["count"], FRAMES, dtype="<u4").tolist() == [3, 2, 3, 3, 3, 3, 3]
    assert np.isfinite(floats(data["normal"], -1, 3)).all()


def test_a_title_cannot_break_the_page(write, model, trajectory):
    title = "</script><script>alert(1)</script> & @@data@@ <b>"
    text = write(model, trajectory, 0.1, title=title)
    page = Page(text)
    assert page.tags.count("script") == 2
    assert page.text["title"] == [title]
    assert embedded(text)["title"] == title


def test_the_first_view_holds_the_whole_motion_but_not_one_escape(write, model):
    position = np.zeros((200, BODIES, 3), np.float32)
    position[:, 1:, 0] = np.linspace(-3, 3, 200)[:, None]
    position[199, 2] = 1e6
    trajectory = SimpleNamespace(position=position, orientation=np.tile([1.0, 0, 0, 0], (200, BODIES, 1)))
    view = embedded(write(model, trajectory, 0.1))["view"]
    assert view["target"] == pytest.approx([0, 0, 0], abs=0.1)
    assert 3.0 < view["radius"] < 4.0
    assert view["distance"] * np.sin(view["fieldOfView"] / 2) == pytest.approx(view["radius"])


def test_engine_trajectories_and_contacts_are_accepted_as_they_are(write):
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True)
    builder.add_body(Sphere(0.2), mass=1.0, position=(0, 0.21, 0))
    model, state = builder.build(Options(dt=1 / 60))
    final, states = rollout(model, state, 30)
    met = jax.vmap(contacts, in_axes=(None, 0))(model, states)
    data = embedded(write(model, states, 1 / 60, contacts=met))
    position = floats(data["position"], 30, 2, 3)
    np.testing.assert_array_equal(position[-1], np.asarray(final.position))
    assert position[-1, 1, 1] == pytest.approx(0.2, abs=0.01)
    touching = floats(data["contacts"]["position"], -1, 3)
    assert len(touching) > 20
    np.testing.assert_allclose(touching, 0, atol=0.01)


def cut(array):
    return np.asarray(array)[:, :-1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": 0.0}, "dt must be a positive"),
        ({"dt": float("nan")}, "dt must be a positive"),
        ({"position": np.zeros((FRAMES, 3))}, "trajectory.position"),
        ({"position": np.zeros((0, BODIES, 3)), "orientation": np.zeros((0, BODIES, 4))}, "trajectory.position"),
        ({"orientation": np.zeros((FRAMES, BODIES, 3))}, "trajectory.orientation"),
        ({"position": np.zeros((FRAMES, 2, 3)), "orientation": np.zeros((FRAMES, 2, 4))}, "shape on body 2"),
    ],
)
def test_bad_trajectories_are_refused(write, model, trajectory, change, message):
    given = {**vars(trajectory), "dt": 0.1, **change}
    dt = given.pop("dt")
    with pytest.raises(ValueError, match=message):
        write(model, SimpleNamespace(**given), dt)


@pytest.mark.parametrize("name", ["position", "normal", "active", "force"])
def test_bad_contacts_are_refused(write, model, trajectory, touches, name):
    with pytest.raises(ValueError, match=r"contacts\."):
        write(model, trajectory, 0.1, contacts={**touches, name: touches[name][:, :-1]})


def test_contacts_without_normals_are_refused(write, model, trajectory, touches):
    with pytest.raises(ValueError, match="contacts has no 'normal'"):
        write(model, trajectory, 0.1, contacts={"position": touches["position"]})
