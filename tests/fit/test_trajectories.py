"""Recorded motions: what is refused, and that files come back as they were written."""

import dataclasses
import math

import numpy as np
import pytest

from mathota_jax import Plane, SceneBuilder, Sphere
from mathota_jax.fit import Noise, Parameter, Spread, Trajectories, fit, load, load_csv, load_npz, save_npz

NAN = float("nan")


def example(**changes):
    """Two trajectories of three frames of two bodies."""
    random = np.random.default_rng(0)
    orientation = random.normal(size=(2, 3, 2, 4))
    given = {
        "bodies": ("ball", "cube"),
        "dt": 0.01,
        "position": random.normal(size=(2, 3, 2, 3)),
        "orientation": orientation / np.linalg.norm(orientation, axis=-1, keepdims=True),
        **changes,
    }
    return Trajectories(**given)


def changed(name, where, value):
    array = np.array(getattr(example(), name))
    array[where] = value
    return {name: array}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"position": np.zeros((3, 2, 3))},
            r"position must have shape \(trajectory, frame, body, 3\), got \(3, 2, 3\)",
        ),
        ({"position": np.zeros((2, 3, 1, 3))}, r"position must have shape \(2, 3, 2, 3\)"),
        ({"orientation": np.zeros((2, 3, 2, 3))}, r"orientation must have shape \(2, 3, 2, 4\)"),
        ({"velocity": np.zeros((2, 2, 2, 3))}, "velocity must have shape"),
        ({"position": np.zeros((0, 3, 2, 3)), "orientation": None}, "there is no trajectory"),
        ({"position": np.zeros((2, 0, 2, 3)), "orientation": None}, "at least 2 frames, got 0"),
        ({"position": np.zeros((2, 1, 2, 3)), "orientation": None}, "at least 2 frames, got 1"),
        (changed("position", np.s_[:, :, 1], NAN), "position of 'cube' is NaN in every frame"),
        (changed("orientation", np.s_[:, :, 0], NAN), "orientation of 'ball' is NaN in every frame"),
        (
            {**changed("position", np.s_[1, 1:], NAN), "orientation": None},
            "trajectory 1 holds nothing after its first frame",
        ),
        (changed("position", np.s_[0, 0, 0, 0], np.inf), "position holds infinite numbers"),
        (
            changed("orientation", np.s_[1, 2, 1, 3], NAN),
            "orientation of 'cube' in frame 2 of trajectory 1 is NaN in part",
        ),
        (changed("orientation", np.s_[1, 2, 1], 1.0), "frame 2 of trajectory 1 has the length 2"),
        ({"position": "motion"}, "position must be an array of numbers"),
        ({"dt": 0.0}, "dt must be a positive number"),
        ({"dt": [0.1, 0.2]}, "dt must be one number"),
        ({"dt": True}, "dt must be one number of seconds, got True"),
        ({"position": np.zeros((2, 3, 2, 3), complex)}, "position must be an array of real numbers"),
        ({"bodies": ("ball", "ball")}, "different names"),
        ({"action": np.zeros((2, 3, 1))}, r"action must have shape \(2, 2, motor\)"),
        ({"action": np.full((2, 2, 1), NAN)}, "action must not hold NaN"),
    ],
)
def test_mistakes_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        example(**changes)


def ball_scene():
    builder = SceneBuilder()
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, name="ground")
    builder.add_body(Sphere(0.1), mass=1.0, position=(0, 1, 0), name="ball")
    return builder.build()


def ball_data(**changes):
    return Trajectories(**{"bodies": "ball", "dt": 0.01, "position": np.zeros((1, 5, 1, 3)), **changes})


@pytest.mark.parametrize(
    ("data", "settings", "message"),
    [
        (example(), {}, "the scene has no body 'cube'; known: 'ground', 'ball'"),
        (ball_data(bodies="ground"), {}, "body 'ground' is static"),
        (ball_data(action=np.zeros((1, 4, 2))), {}, "each of the 0 motors"),
        (ball_data(), {"start": "recorded"}, "needs the orientation"),
        (ball_data(), {"start": "somewhere"}, "start must be one of 'recorded', 'free', 'model'"),
        (ball_data(), {"parameters": ["velocity[ball]"]}, 'need start="model"'),
        (ball_data(), {"segments": 9}, "at most the 4 frames"),
        (ball_data(), {"segments": 2, "horizons": (0.5, 1.0)}, "not both"),
        (ball_data(), {"horizons": (0.5, 0.4, 1.0)}, "horizons must be positive and increasing"),
        (ball_data(), {"substeps": 0}, "substeps must be a whole number"),
        (ball_data(), {"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        (ball_data(), {"huber": -1.0}, "huber must be a positive number"),
        (ball_data(), {"confidence": 95}, "confidence must lie between 0 and 1"),
        (ball_data(), {"horizons": 1.0}, "horizons must be positive and increasing"),
        (ball_data(), {"horizons": ("a", 1.0)}, "horizons must be numbers"),
        (ball_data(), {"huber": "a"}, "huber must be a positive number"),
        (ball_data(), {"noise": 1e-3}, "noise must be a Noise, such as"),
        (ball_data(), {"spread": 1e-3}, "spread must be a Spread, such as"),
        (ball_data(), {"optimiser": "adam"}, "optimiser must be one of optax"),
        (ball_data(), {"parameters": [Parameter("gravity", lower=9.81, upper=12)]}, "start of 'gravity'"),
        (np.zeros((1, 5, 1, 3)), {}, "data must be Trajectories"),
    ],
)
def test_mistakes_of_a_fit_are_named(data, settings, message):
    with pytest.raises(ValueError, match=message):
        fit(*ball_scene(), **{"parameters": ["gravity"], "data": data, **settings})


def test_model_and_state_the_wrong_way_round():
    model, state = ball_scene()
    with pytest.raises(ValueError, match="give model, state as `build` returns them, got State, Model"):
        fit(state, model, ["gravity"], ball_data())


def test_noise_must_be_positive():
    assert Noise(position=np.float32(2e-3)).position == pytest.approx(2e-3)
    with pytest.raises(ValueError, match=r"Spread\.orientation must be a positive"):
        Spread(orientation=math.inf)
    with pytest.raises(ValueError, match=r"Noise\.position must be a positive"):
        Noise(position=0.0)
    with pytest.raises(ValueError, match=r"Noise\.orientation"):
        Noise(orientation=None)


def test_npz_comes_back(tmp_path):
    data = example(velocity=np.ones((2, 3, 2, 3)), **changed("position", np.s_[1, 2, 0], NAN))
    save_npz(tmp_path / "motion.npz", data)
    again = load(tmp_path / "motion.npz")
    assert again.bodies == data.bodies and again.dt == data.dt
    for name, value in data.channels.items():
        np.testing.assert_allclose(getattr(again, name), value)


def test_npz_of_one_trajectory(tmp_path):
    np.savez(tmp_path / "motion.npz", dt=0.1, bodies=["ball"], position=np.zeros((4, 1, 3)))
    assert load_npz(tmp_path / "motion.npz").position.shape == (1, 4, 1, 3)


CSV = """trajectory,time,body,x,y,z,qw,qx,qy,qz
a,0.50,ball,0,1,0,1,0,0,0
a,0.51,ball,0.1,,0,,,,
a,0.53,ball,0.3,0.9,0,0,1,0,0
b,7.00,ball,5,1,0,1,0,0,0
b,7.01,ball,5,2,0,1,0,0,0
"""


def test_csv(tmp_path):
    path = tmp_path / "motion.csv"
    path.write_text(CSV)
    data = load(path)
    assert data.bodies == ("ball",) and data.dt == pytest.approx(0.01)
    expected = np.full((2, 4, 3), NAN)
    expected[0] = [[0, 1, 0], [0.1, NAN, 0], [NAN] * 3, [0.3, 0.9, 0]]
    expected[1, :2] = [[5, 1, 0], [5, 2, 0]]
    np.testing.assert_allclose(data.position[:, :, 0], expected)
    assert np.isnan(data.orientation[0, 1]).all() and data.orientation[0, 3, 0, 1] == 1


@pytest.mark.parametrize(("rate", "decimals"), [(24, 3), (30, 3), (60, 3), (120, 3), (240, 3), (59.94, 3), (240, 4)])
@pytest.mark.parametrize("lost", [slice(0), slice(20, 140)], ids=["complete", "gap"])
def test_rounded_times(tmp_path, rate, decimals, lost):
    """Frames are counted as they were recorded, two seconds of lost ones too, and their rate is right to rounding."""
    frames = np.delete(np.arange(200), lost)
    lines = [f"{k / rate + 5.0003:.{decimals}f},ball,{k},0,0" for k in frames]
    path = tmp_path / "motion.csv"
    path.write_text("\n".join(["time,body,x,y,z", *lines]))
    data = load(path)
    expected = np.full(200, NAN)
    expected[frames] = frames
    np.testing.assert_array_equal(data.position[0, :, 0, 0], expected)
    assert abs(data.dt * 199 - 199 / rate) < 10.0**-decimals


def test_times_rounded_too_coarsely(tmp_path):
    """Milliseconds at 400 frames a second differ by 2 or 3: whether these are 1 and 1 frames or 2 and 3 is not guessed."""
    path = tmp_path / "motion.csv"
    path.write_text("\n".join(["time,body,x,y,z", *(f"{k / 400:.3f},ball,0,0,0" for k in range(60))]))
    with pytest.raises(ValueError, match="off the grid of frames"):
        load(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("time,", "t,", "the column 'time' is missing"),
        ("qz", "q4", "unknown column 'q4'"),
        (",qz", "", "the column 'qz' of the orientation is missing"),
        ("0.51,ball", "0.515,ball", "line 2: the time is"),
        ("0.3,", "zero,", "line 4: 'zero' in column 'x' is not a number"),
        ("0.53,", "0.51,", "line 4: body 'ball' has this frame in line 3 already"),
        ("7.01,", ",", "line 6: the time is missing"),
        ("b,7.01,ball,5,2,0,1,0,0,0\n", "", "trajectory 1 holds nothing after its first frame"),
        ("5,2,0,1,0,0,0", "5,2,0", "line 6: expected 10 cells"),
        ("7.01,ball", "7.01,", "line 6: the name of the body is missing"),
        ("7.01,ball", "7.00000001,ball", "frames for 5 lines; times that are meant to be one must be equal"),
        (CSV.partition("\n")[2], "", "no line below the header"),
    ],
)
def test_bad_csv(tmp_path, old, new, message):
    assert old in CSV
    path = tmp_path / "motion.csv"
    path.write_text(CSV.replace(old, new))
    with pytest.raises(ValueError, match=message.replace("line 2: the time", "the time")):
        load_csv(path)


def test_bad_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        load(tmp_path / "missing.npz")
    with pytest.raises(ValueError, match=r"not from .\.txt."):
        load(tmp_path / "motion.txt")
    path = tmp_path / "motion.csv"
    path.write_bytes("time,body,x,y,z\n0,Würfel,0,0,0\n".encode("latin-1"))
    with pytest.raises(ValueError, match=r"motion\.csv: not a text file in UTF-8"):
        load(path)
    path = tmp_path / "motion.npz"
    for content in (b"no archive", b""):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"motion\.npz: not an NPZ file"):
            load(path)
    with open(path, "wb") as file:
        np.save(file, np.zeros((4, 1, 3)))
    with pytest.raises(ValueError, match=r"motion\.npz: not an NPZ file .*numpy\.save"):
        load(path)
    np.savez(path, dt=0.1, bodies=[3], position=np.zeros((4, 1, 3)))
    with pytest.raises(ValueError, match=r"bodies must be names, got \[3\]"):
        load(path)
    np.savez(path, dt=0.1, bodies=[b"ball"], position=np.zeros((4, 1, 3)))
    assert load(path).bodies == ("ball",)
    np.savez(path, dt=0.1, position=np.zeros((4, 1, 3)))
    with pytest.raises(ValueError, match="the key 'bodies' is missing"):
        load(path)
    np.savez(path, dt=0.1, bodies=["ball"], position=np.zeros((4, 1, 3)), orientaton=np.zeros((4, 1, 4)))
    with pytest.raises(ValueError, match="unknown key 'orientaton'"):
        load(path)


def test_taking_some_trajectories():
    data = example()
    part = data.take([1])
    assert part.count == 1 and dataclasses.astuple(part)[0] == data.bodies
    np.testing.assert_allclose(part.position[0], data.position[1])
