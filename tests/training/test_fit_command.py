"""The command line of the fit: its report, and its errors before anything is compiled."""

import json
import re

import numpy as np
import pytest

from mathota_jax.fit import Parameter, Trajectories, save_npz
from training import fit as command

SCENE = """
from mathota_jax import Plane, SceneBuilder, Sphere

def build_scene():
    builder = SceneBuilder(gravity=(0, -9.81, 0))
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, restitution=0.9, name="ground")
    builder.add_body(Sphere(0.1), mass=1.0, restitution=0.5, position=(0, 1.1, 0), name="ball")
    return builder

def nothing():
    return None

def broken():
    return build_scene().add_body(None)

def demanding(size):
    return build_scene()
"""


@pytest.fixture
def files(tmp_path):
    """A scene and a recording of a ball dropped from 1 m, which rebounds with 0.7 of its speed."""
    (tmp_path / "scene.py").write_text(SCENE)
    time = np.arange(17) * 0.05
    fall = np.sqrt(2 / 9.81)
    up = 0.7 * 9.81 * fall * (time - fall) - 9.81 * (time - fall) ** 2 / 2
    position = np.zeros((1, 17, 1, 3))
    position[0, :, 0, 1] = 0.1 + np.where(time < fall, 1 - 9.81 * time**2 / 2, up)
    position += 1e-3 * np.random.default_rng(0).normal(size=position.shape)
    save_npz(tmp_path / "motion.npz", Trajectories("ball", 0.05, position))
    return tmp_path


def run(files, *extra, scene="scene.py", data="motion.npz", parameter="restitution[ball]=0.5:0.1:0.89"):
    words = ["--scene", str(files / scene), "--data", str(files / data), "--parameter", parameter, "--start", "model"]
    return command.main([*words, "--substeps", "4", "--output", str(files / "out"), "--quiet", *extra])


def test_report(files, capsys):
    assert run(files, "--starts", "2") == 0
    assert "restitution[ball]: 0.7" in capsys.readouterr().out
    page = (files / "out" / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 3 and not re.search(r"(src|href)=\"(?!data:)", page)
    assert "restitution[ball]" in page and "Residuals" in page
    found = json.loads((files / "out" / "fit.json").read_text())["parameters"]["restitution[ball]"]
    assert found["lower"] < 0.7 < found["upper"] and abs(found["estimate"] - 0.7) < 0.01
    assert run(files, "--starts", "2") == 2
    assert "holds an earlier run" in capsys.readouterr().err


def test_what_can_not_be_fitted_leaves_no_folder(files, monkeypatch):
    monkeypatch.chdir(files)
    words = ["--scene", "scene.py", "--data", "motion.npz", "--parameter", "bounce[ball]", "--quiet"]
    assert command.main(words) == 2
    assert not list((files / "runs").iterdir())


def test_adam(files):
    assert run(files, "--method", "adam", "--learning-rate", "0.1", "--steps", "60") == 0
    found = json.loads((files / "out" / "fit.json").read_text())["parameters"]["restitution[ball]"]
    assert abs(found["estimate"] - 0.7) < 0.01


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parameter": "bounce[ball]"}, "unknown parameter 'bounce[ball]'"),
        ({"parameter": "restitution[ball]=0.5:0.6:0.8"}, "must lie strictly between its bounds"),
        ({"parameter": "restitution[ball]=a"}, "start and bounds must be numbers"),
        ({"parameter": "restitution[ball]=0.5:0.6"}, "write NAME, NAME=START or NAME=START:LOWER:UPPER"),
        ({"data": "lost.npz"}, "no such file"),
        ({"scene": "lost.py"}, "no file"),
        ({"scene": "scene.py:nothing"}, "must return a SceneBuilder, got NoneType"),
        ({"scene": "scene.py:other"}, "has no function other()"),
        ({"scene": "scene.py:broken"}, "scene.py:broken: broken() failed in line 14 of"),
        ({"scene": "scene.py:demanding"}, "demanding() failed: TypeError: demanding() missing 1 required positional"),
        ({"scene": "motion.py"}, "motion.py can not be loaded in line 2 of"),
    ],
)
def test_errors(files, capsys, changes, message):
    (files / "motion.py").write_text("import numpy\nnumpy.nothing\n")
    assert run(files, **changes) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("output", ["scene.py", "scene.py/deeper"])
def test_the_output_is_tried_before_the_fit(files, capsys, monkeypatch, output):
    monkeypatch.setattr(command, "fit", lambda *given, **settings: pytest.fail("fitted first"))
    assert run(files, "--output", str(files / output)) == 2
    assert f"--output {files / output}" in capsys.readouterr().err


@pytest.mark.parametrize("rate", ["0", "-1", "nan", "inf"])
def test_the_learning_rate_is_positive(files, capsys, rate):
    assert run(files, "--method", "adam", f"--learning-rate={rate}") == 2
    assert f"--learning-rate must be a positive number, got {float(rate)}" in capsys.readouterr().err


def test_parameters_of_the_command_line():
    assert command.parse_parameter("gravity") == Parameter("gravity")
    assert command.parse_parameter("mass[a]+mass[b]=2") == Parameter(("mass[a]", "mass[b]"), start=2.0)
    assert command.parse_parameter("mass[a]=2:1:3") == Parameter("mass[a]", 1.0, 3.0, 2.0)
    assert command.parse_parameter("mass[a]=:1:3") == Parameter("mass[a]", 1.0, 3.0)
