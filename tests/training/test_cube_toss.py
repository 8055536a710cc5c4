"""The example with real tosses. The data are not in the repository; where they are missing, what needs them is skipped."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from training import cube_toss
from training.cube_toss_data import GRAVITY, Tosses, load_tosses
from training.cube_toss_fit import FIRST, cross_entropy, fit_first_impacts
from training.cube_toss_model import SETTINGS, CubeParameters, errors, scene

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "cube_toss.npz"
needs_data = pytest.mark.skipif(not DATA.is_file(), reason=f"the tosses are not there ({DATA})")

FITTED = {
    SETTINGS[0]: CubeParameters(0.17341, 0.24105, 1.05845e-3, 5.3647e-3, 0.0512136),
    SETTINGS[1]: CubeParameters(0.17240, 0.23499, 1.03181e-3, 4.3504e-3, 0.0512136),
}
"""Fitted to the tosses of even index; see tests/benchmarks/results/cube_toss.md."""


def flying(frames=30):
    """One toss in free flight, as exact as floats are."""
    time = np.arange(frames) / 148
    velocity, rate = np.asarray([0.3, -0.2, 1.0]), np.asarray([3.0, -5.0, 2.0])
    begin = Rotation.from_rotvec([0.3, 0.1, -0.4])
    position = np.asarray([0.0, 0.1, 0.5]) + np.outer(time, velocity) - np.outer(time**2, [0, 0, GRAVITY / 2])
    orientation = (Rotation.from_rotvec(np.outer(time, rate)) * begin).as_quat()[:, [3, 0, 1, 2]]
    earlier = velocity + np.asarray([0, 0, GRAVITY / 2 / 148])  # recorded half a frame before
    row = {
        "position": position,
        "orientation": orientation,
        "velocity": np.tile(earlier, (frames, 1)),
        "angular_velocity": np.tile(rate + 0.2, (frames, 1)),
    }
    row["position"][-1, 2] = 0.01  # touches
    return (
        Tosses(
            np.asarray([frames]),
            **{key: value[None] for key, value in row.items()},
            dt=1 / 148,
            mass=0.37,
            half_width=0.05,
        ),
        velocity,
        rate,
    )


def test_flight_and_recorded_velocity():
    tosses, velocity, rate = flying()
    assert tosses.flight_length()[0] == 29
    np.testing.assert_allclose(tosses.recorded_start()[2][0], velocity, atol=1e-12)
    position, orientation, fitted, turning = tosses.flight_start()
    np.testing.assert_allclose(position[0], tosses.position[0, 0], atol=1e-12)
    np.testing.assert_allclose(fitted[0], velocity, atol=1e-10)
    np.testing.assert_allclose(turning[0], rate, atol=1e-6)
    np.testing.assert_allclose(np.abs(orientation[0] @ tosses.orientation[0, 0]), 1.0, atol=1e-10)


def test_rounded_cube_rests_on_its_half_width():
    model, state = scene(1 / 148, 0.37, FITTED[SETTINGS[0]])
    parameters = model.shapes["sphere"]
    lowest = np.asarray(parameters["local_position"])[:, 2] - np.asarray(parameters["radius"])
    np.testing.assert_allclose(lowest.min(), -FITTED[SETTINGS[0]].half_width, rtol=1e-6)
    np.testing.assert_allclose(model.inertia[1], FITTED[SETTINGS[0]].inertia, rtol=1e-6)
    assert state.position.shape == (2, 3)


def test_cross_entropy_finds_a_minimum():
    goal = np.asarray([0.2, 3.0])
    found = cross_entropy(lambda x: float(np.sum((x / goal - 1) ** 2)), np.ones(2), np.asarray([0.5, 1.5]), 8, seed=0)
    np.testing.assert_allclose(found, goal, rtol=0.02)


def test_missing_and_bad_files(tmp_path, capsys):
    assert cube_toss.main(["--data", str(tmp_path / "none.npz")]) == 2
    assert "github.com/DAIRLab/contact-nets" in capsys.readouterr().err
    np.savez(tmp_path / "bad.npz", position=np.zeros((2, 5, 3)))
    with pytest.raises(ValueError, match="the array 'length' is missing"):
        load_tosses(tmp_path / "bad.npz")
    names = ("velocity", "angular_velocity", "orientation", "position")
    arrays = {name: np.zeros((2, 5, 3)) for name in names}
    np.savez(tmp_path / "bad.npz", length=[5, 5], dt=0.1, mass=1.0, half_width=0.05, **arrays)
    with pytest.raises(ValueError, match=r"'orientation' must have shape \(2, 5, 4\)"):
        load_tosses(tmp_path / "bad.npz")


@needs_data
def test_friction_of_first_impacts():
    """Engines of three makers, tuned to whole tosses, find 0.17 to 0.18."""
    tosses = load_tosses(DATA)
    some = tosses.take(np.arange(tosses.count) % 6 == 0)
    result = fit_first_impacts(some, FIRST._replace(half_width=some.resting_half_width()))
    assert result.converged
    assert 0.14 < result.values[0] < 0.21
    assert 0.05 < result.values[1] < 0.4


@pytest.fixture(scope="module")
def predicted():
    """Errors (toss,) of the tosses of odd index, by setting."""
    tosses = load_tosses(DATA)
    odd = tosses.take(np.arange(tosses.count) % 2 == 1)
    return {setting: errors(odd, setting, FITTED[setting]) for setting in SETTINGS}


@needs_data
@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("error", ["position", "rotation"])
def test_prediction_of_tosses_not_fitted(predicted, setting, error, gate):
    """At most the errors of the best engine tuned to these tosses."""
    number = ("position", "rotation").index(error)
    best = min(figures[number] for figures in cube_toss.PEERS[setting].values())
    gate(f"{setting}: {error}", predicted[setting][number].mean(), best)
