"""Distance, normal and witness points of every pair, differentiated by poses and sizes, against central differences."""

import numpy as np
import pytest

from mathota_jax.collision.pairs import PAIRS
from tests.benchmarks.pair_derivatives import GATE, OUTPUTS, differences, measure, parameters_of

QUICK = [("plane", "box"), ("sphere", "cylinder"), ("capsule", "capsule"), ("box", "box")]


def case(pair):
    return pytest.param(pair, id="_".join(pair), marks=[] if pair in QUICK else [pytest.mark.slow])


@pytest.mark.parametrize("pair", [case(pair) for pair in PAIRS])
def test_against_central_differences(pair, float64, gate):
    rows = measure(pair, 24 if pair in QUICK else 16)
    for row in rows:
        assert row["finite"], f"NaN in a derivative by {row['parameter']}"
        for output in OUTPUTS:
            gate(f"{output} by {row['parameter']}", row[output], GATE)
    # The comparison must not be empty: few poses are near a change of features.
    assert np.mean([row["kept"] / row["poses"] for row in rows]) > 0.5
    assert max(row["largest"] for row in rows) > 0.5


def test_every_parameter_is_compared():
    for pair in PAIRS:
        labels, _, start = parameters_of(pair)
        assert len(labels) == len(start)
        assert {"position A", "orientation A", "position B", "orientation B"} < set(labels)


def test_a_wrong_derivative_and_a_kink_are_seen(float64):
    """Differences of |x|, x^3 and a jump of the slope inside the difference."""

    def outputs(vector, pose):
        return abs(vector + pose) + vector**3

    found, smooth = differences(outputs, np.zeros(1), np.array([[1.0], [-2.0], [1e-3]]))
    np.testing.assert_allclose(found[:2, 0, 0], [1.0, -1.0], atol=1e-9)
    assert smooth[:2].all() and not smooth[2].any()
