"""The command lines: bad input is refused in one line, and a short run writes all its files."""

import json
import sys

import pytest

from training import evaluate, train

ENVIRONMENT_ID = "mathota/InvertedPendulum-v0"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "mathota/Nothing-v0"], "mathota/InvertedPendulum-v0"),
        (["--env", ENVIRONMENT_ID, "--worlds", "0"], "worlds must be a whole number of at least 1, got 0"),
        (["--env", ENVIRONMENT_ID, "--steps", "-5"], "steps must be a whole number of at least 1, got -5"),
        (["--env", ENVIRONMENT_ID, "--eval-episodes", "0"], "evaluation_episodes must be"),
        (["--env", ENVIRONMENT_ID, "--seed", "-1"], "seed must be"),
        (["--env", ENVIRONMENT_ID, "--seed", str(2**31)], "seed must be less than 2\\*\\*31"),
        (["--env", ENVIRONMENT_ID, "--backend", "tensorflow"], "backend must be one of sb3, jax, gradient"),
        (["--env", ENVIRONMENT_ID, "--target-return", "nan"], "target_return must be finite"),
    ],
)
def test_bad_input(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert train.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    assert message.replace("\\", "") in error
    assert not list(tmp_path.iterdir()), "nothing may be written before the input is checked"


@pytest.mark.parametrize(
    ("backend", "package"), [("sb3", "stable_baselines3"), ("jax", "optax"), ("gradient", "optax")]
)
def test_missing_extra(backend, package, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, package, None)
    assert train.main(["--env", ENVIRONMENT_ID, "--backend", backend]) == 2
    error = capsys.readouterr().err
    assert package in error and "pip install 'mathota-jax[train]'" in error


def test_earlier_runs_are_not_overwritten(tmp_path, capsys):
    (tmp_path / "metrics.json").write_text("{}")
    assert train.main(["--env", ENVIRONMENT_ID, "--output", str(tmp_path)]) == 2
    assert "holds an earlier run" in capsys.readouterr().err
    assert (tmp_path / "metrics.json").read_text() == "{}"


@pytest.mark.parametrize("arguments", [["--output", "file/run"], ["--output", "file"], ["--output", "/proc"], []])
def test_folders_that_can_not_be_used(arguments, tmp_path, monkeypatch, capsys):
    """A file stands in their way, also in that of the folder that is made where none is named; or they take no files."""
    monkeypatch.chdir(tmp_path)
    for name in ("file", "runs"):
        (tmp_path / name).write_text("")
    assert train.main(["--env", ENVIRONMENT_ID, *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    assert (arguments[-1] if arguments else "runs/InvertedPendulum-v0") in error and "give another" in error


@pytest.mark.parametrize(
    "backend",
    ["sb3", "jax", pytest.param("gradient", marks=pytest.mark.slow)],  # reverse mode compiles for two minutes
)
def test_short_run_writes_everything(backend, tmp_path, capsys):
    folder = tmp_path / "run"
    sizes = ["--worlds", "4", "--steps", "240", "--eval-episodes", "2"]
    arguments = ["--env", ENVIRONMENT_ID, "--backend", backend, *sizes, "--output", str(folder)]
    assert train.main(arguments) == 0
    printed = capsys.readouterr().out
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["steps"] == (256 if backend == "gradient" else 240)  # whole updates: 4 of 64 steps
    assert metrics["evaluation"]["episodes"] == 2
    assert 1 <= metrics["evaluation"]["mean_return"] <= 1000
    assert metrics["evaluation"]["mean_length"] >= metrics["evaluation"]["mean_return"]
    assert (folder / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    assert "<html" in (folder / "replay.html").read_text().lower()
    for name in ("metrics.json", "learning_curve.png", "replay.html", "policy.json"):
        assert str(folder / name) in printed
    assert evaluate.main([str(folder), "--episodes", "2"]) == 0
    assert capsys.readouterr().out.startswith(f"{ENVIRONMENT_ID}: return ")


def test_evaluating_an_empty_folder(tmp_path, capsys):
    assert evaluate.main([str(tmp_path)]) == 2
    assert "policy.json" in capsys.readouterr().err
