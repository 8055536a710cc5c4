"""Lists that name tests name tests that exist."""

import pathlib

import pytest

from tests.shortfalls import SHORTFALLS, TIMINGS

ROOT = pathlib.Path(__file__).parents[2]


@pytest.mark.parametrize("nodeid", sorted({**SHORTFALLS, **TIMINGS}))
def test_named_tests_exist(nodeid):
    path, name = nodeid.split("::")
    assert f"\ndef {name.split('[')[0]}(" in (ROOT / path).read_text()
