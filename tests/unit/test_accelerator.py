"""The benchmark of thousands of worlds, on a few of them: pushes against a sum, and a whole report."""

import json

import numpy as np

from tests.benchmarks.accelerator import __main__ as accelerator
from tests.benchmarks.accelerator import measure, pushes
from tests.benchmarks.work_precision import engine
from tests.benchmarks.work_precision.scenes import SCENES


def test_pushes_add_up(gate):
    """A body without gravity or contact moves by the sum of its pushes."""
    scene, worlds, steps = SCENES["tumble"], 8, pushes.ENTRIES + 3
    table = pushes.forces(scene, worlds)
    program = pushes.pushed_ours(engine.program(scene, "pgs", worlds), table)
    velocity = program.motion(program.after(steps, measure.DT), worlds).velocity[:, 0]
    turns = np.arange(steps) % pushes.ENTRIES
    truth = measure.DT * np.asarray(table, float)[turns, :, 0].sum(axis=0) / scene.world.moving[0].mass
    assert np.abs(truth).max() > 0.1
    gate("velocity [m/s]", velocity - truth, 1e-6)


def test_report_of_a_few_worlds(tmp_path, gate):
    arguments = ["--worlds", "8", "--only", "bounce", "--engines", measure.OURS, "--rounds", "2", "--seconds", "0.01"]
    assert accelerator.main([*arguments, "--output", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "accelerator.json").read_text())["scenes"]["bounce"][0]["engines"][measure.OURS]
    assert found["rate"] > 0 and len(found["rates"]) == 2 and found["bytes_per_world"] > 0
    gate("error of the first bounce", found["error"], 1e-3)
    gate("worlds with a flag", found["flagged"], 0)
    gate("off a CPU [m/s]", found["off_cpu"], 1e-6)
    assert "| bounce | mathota_jax | 8 | " in (tmp_path / "accelerator.md").read_text()


def test_a_run_that_means_nothing_has_no_rate():
    row = {"rate": None, "error": 1.0, "flagged": 1.0, "bytes_per_world": None, "compile_seconds": 1.0,
           "off_cpu": None}  # fmt: skip
    report = {
        "date": "", "device": {"kind": "", "platform": "", "jax": ""}, "settings": {"dt": 1, "rounds": 1, "seconds": 1},
        "scenes": {"slide": [{"worlds": 4, "engines": {measure.OURS: row}}]},
    }  # fmt: skip
    assert "| slide | mathota_jax | 4 | - | - | 1e+02 % | - | 1e+02 % | - | 1.0 |" in accelerator.markdown(report)
