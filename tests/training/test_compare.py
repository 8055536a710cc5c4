"""The comparison of training runs."""

import json

from training import compare


def write_run(folder, backend, returns, environment="mathota/BallBalance-v0"):
    folder.mkdir()
    evaluations = [
        {"steps": 100 * (k + 1), "seconds": 1.0, "mean_return": value, "std_return": 1.0}
        for k, value in enumerate(returns)
    ]
    metrics = {
        "environment": environment,
        "backend": backend,
        "seed": 0,
        "steps": 100 * len(returns),
        "training_seconds": 12.0,
        "evaluation": {"mean_return": returns[-1], "std_return": 2.0},
        "training_evaluations": evaluations,
        "hyperparameters": {"worlds": 8},
    }
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def test_table_and_picture(tmp_path, capsys):
    folders = [
        write_run(tmp_path / "a", "gradient", [50.0, 92.0, 100.0]),
        write_run(tmp_path / "b", "jax", [10.0, 20.0, 30.0]),
    ]
    picture = tmp_path / "curves.png"
    assert compare.main([*map(str, folders), "--output", str(picture)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2] == "| gradient | 8 | 300 | 100.0 ± 2.0 | 200 | 12 |"
    assert lines[3] == "| jax | 8 | 300 | 30.0 ± 2.0 | never | 12 |"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_bad_folders(tmp_path, capsys):
    assert compare.main([str(tmp_path)]) == 2
    assert "holds no metrics.json" in capsys.readouterr().err
    folders = [write_run(tmp_path / "a", "jax", [1.0]), write_run(tmp_path / "b", "jax", [1.0], "mathota/Other-v0")]
    assert compare.main([str(folder) for folder in folders]) == 2
    assert "different environments" in capsys.readouterr().err
