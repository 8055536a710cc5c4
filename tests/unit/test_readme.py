"""The README shows what is there: its generated parts are current and its examples run."""

import re

import pytest

from tests import status

TEXT = status.README.read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", TEXT, flags=re.S)


def test_generated_parts_are_current():
    assert status.render(TEXT) == TEXT, "run `python -m tests.status`"


def test_markers_are_required():
    with pytest.raises(ValueError, match="markers"):
        status.render("no markers")


@pytest.mark.parametrize("feature", status.FEATURES, ids=lambda feature: feature.source)
def test_what_exists_is_tested(feature):
    assert status.tested(feature) or not status.exists(feature)


def test_absence_is_seen():
    assert not status.exists(status.Feature("dreams", "mathota_jax:dream", "unit"))
    assert not status.tested(status.Feature("stepping", "mathota_jax:step", "unit/no_such_test.py"))


def test_there_is_an_example_for_each_reader():
    assert len(EXAMPLES) == 4


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_example_runs_and_prints_what_it_says(number, capsys):
    """A comment `# -> number` after a print is checked to 1 %."""
    code = EXAMPLES[number]
    exec(compile(code, f"README example {number}", "exec"), {})
    printed = capsys.readouterr().out.split()
    claimed = re.findall(r"# -> ([-\d.]+)", code)
    assert len(printed) >= len(claimed)
    for value, text in zip(claimed, printed, strict=False):
        assert float(text) == pytest.approx(float(value), rel=0.01)
