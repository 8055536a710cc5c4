"""The examples of the README and of the pages in docs run, and print what they say."""

import re

import numpy as np
import pytest

from mathota_jax.fit import Trajectories, save_npz
from tests.fit.scenes import RADIUS, bounce_height
from tests.status import ROOT

PAGES = sorted(ROOT.glob("docs/*.md"))
LONG = {"environments"}
"""Compiles the programs of three environments; each of what it shows has tests in `tests/envs`."""


def blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.S)


def programs():
    """Each example of the README stands alone; those of a page continue one another."""
    readme = [pytest.param(code, id=f"README {place}") for place, code in enumerate(blocks(ROOT / "README.md"))]
    pages = [page for page in PAGES if blocks(page)]
    return readme + [
        pytest.param("\n".join(blocks(page)), id=page.stem, marks=pytest.mark.slow if page.stem in LONG else ())
        for page in pages
    ]


@pytest.fixture
def recorded_motion(tmp_path, monkeypatch):
    """The file that the page on fitting reads: a ball of restitution 0.8, dropped from 1 m, for 1 s, with noise of 1 mm."""
    monkeypatch.chdir(tmp_path)
    position = np.zeros((1, 61, 1, 3))
    position[0, :, 0, 1] = RADIUS + bounce_height(np.arange(61) / 60, 0.8)
    position += 1e-3 * np.random.default_rng(0).normal(size=position.shape)
    save_npz("motion.npz", Trajectories("ball", 1 / 60, position))


def test_there_is_an_example_for_each_reader():
    assert len(blocks(ROOT / "README.md")) == 4
    assert {page.stem for page in PAGES if blocks(page)} == {
        "environments",
        "gradients",
        "fitting",
        "batches",
        "robots",
        "pictures",
        "scenes",
    }


@pytest.mark.parametrize("code", programs())
@pytest.mark.usefixtures("recorded_motion")
def test_example_runs_and_prints_what_it_says(code, capsys):
    """A comment `# -> number` after a print is checked to 1 %."""
    exec(compile(code, "example", "exec"), {})
    printed = capsys.readouterr().out.split("\n")
    claimed = re.findall(r"# -> ([-\d.]+)", code)
    assert len(printed) >= len(claimed)
    for value, line in zip(claimed, printed, strict=False):
        assert float(line.split()[0]) == pytest.approx(float(value), rel=0.01)
