"""Defaults are the documented ones, and each silent extra can be switched off (benchmark M5)."""

import dataclasses

import numpy as np
import pytest

from mathota_jax import Options

DEFAULTS = {
    "dt": 1 / 60,
    "velocity_iterations": 10,
    "position_iterations": 3,
    "linear_damping": 0.01,
    "angular_damping": 0.05,
    "slop": 0.0001,
    "position_percent": 0.8,
    "baumgarte": 0.1,
    "warm_start": True,
    "broadphase": "auto",
    "pair_capacity": None,
    "touching_capacity": None,
    "solver": "pgs",
    "conjugate": False,
    "exact_joints": True,
    "substeps": None,
    "impact_events": 0,
}
OFF = {"position_iterations": 0, "linear_damping": 0.0, "angular_damping": 0.0, "slop": 0.0, "position_percent": 0.0}


def test_defaults():
    options = Options()
    for name, value in DEFAULTS.items():
        assert getattr(options, name) == value, name


@pytest.mark.parametrize("name", OFF)
def test_every_extra_can_be_zero(name):
    assert getattr(Options(**{name: OFF[name]}), name) == 0


def test_numbers_of_numpy_are_numbers():
    options = Options(dt=np.float32(0.5), velocity_iterations=np.int64(3))
    assert (options.dt, options.velocity_iterations) == (0.5, 3)


@pytest.mark.parametrize("solver", ["soft_step", "converged"])
def test_conjugate_directions_are_those_of_sweeps(solver):
    with pytest.raises(ValueError, match=r"Options.conjugate needs solver='pgs'"):
        Options(conjugate=True, solver=solver)


def test_options_are_frozen_hashable_and_comparable():
    assert Options(dt=0.01) == Options(dt=0.01) != Options(dt=0.02)
    assert hash(Options()) == hash(Options())
    with pytest.raises(dataclasses.FrozenInstanceError):
        Options().dt = 0.1


@pytest.mark.parametrize(
    ("name", "value"), [("broadphase", "octree"), ("broadphase", None), ("pair_capacity", 0), ("touching_capacity", 0)]
)
def test_bad_broadphase_is_refused(name, value):
    with pytest.raises(ValueError, match=f"Options.{name}"):
        Options(**{name: value})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"solver": "newton"}, r"Options\.solver must be one of 'pgs', 'converged', 'soft_step', got 'newton'"),
        ({"solver": "soft_step", "substeps": 0}, r"Options\.substeps must be an integer of at least 1, got 0"),
        ({"solver": "soft_step", "substeps": 2.5}, r"Options\.substeps must be an integer of at least 1, got 2.5"),
        ({"impact_events": -1}, r"Options\.impact_events must be an integer of at least 0, got -1"),
        ({"impact_events": True}, r"Options\.impact_events must be an integer of at least 0, got True"),
        ({"impact_events": 1, "solver": "soft_step"}, r"Options\.impact_events needs solver='pgs' or 'converged'"),
        ({"impact_events": 1, "sleep": True}, r"Options\.impact_events = 1 can not be combined with .*sleep=True"),
        ({"impact_events": 1, "continuous": True}, r"Options\.impact_events = 1 .* continuous=True.*switch these off"),
        ({"substeps": 4}, r"Options\.substeps = 4 needs solver='soft_step', got solver='pgs'; .* divide dt"),
        ({"solver": "converged", "substeps": 2}, r"Options\.substeps = 2 needs solver='soft_step'"),
    ],
)
def test_bad_solver_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Options(**arguments)


def test_substeps_have_a_default_where_they_mean_something():
    assert Options(solver="soft_step").substep_count == 4
    assert Options(solver="soft_step", substeps=7).substep_count == 7
