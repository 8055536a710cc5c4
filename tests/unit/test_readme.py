"""The README shows what is there: its generated parts are current."""

import pytest

from tests import status

TEXT = status.README.read_text()


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
