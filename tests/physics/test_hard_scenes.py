"""The hard scenes of the benchmark suite against their gates, by solver tier (`hard_cases`), in float32.

The whole table is slow and is what the report measures; shortened runs of some cases are in the quick suite.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mathota_jax import Box, Flag, Sphere, time_of_impact
from tests.benchmarks import hard_scenes
from tests.benchmarks.hard_cases import CASES, NO_PUSH, energy_of_balls, overlap_of_balls, record
from tests.marks import QUICK_AND_SLOW_PRECISION

EVERY = [pytest.param(case, tier, id=f"{case.name}-{tier}") for case in CASES for tier in case.tested]
BY_NAME = {case.name: case for case in CASES}


@pytest.mark.slow
@pytest.mark.parametrize(("case", "tier"), EVERY)
def test_gates(case, tier, gate):
    run, flags = record(case, tier)
    values = case.measure(run)
    assert not flags & (Flag.NON_FINITE | Flag.CONTACT_OVERFLOW)
    for name, limit in case.gates.items():
        gate(name, values[name], limit)


@pytest.mark.parametrize(
    ("name", "tier", "seconds"),
    [
        ("A1 balls on a board, pushed diagonally", "pgs", 0.5),
        ("B1 cube of 100 times the mass on a cube", "pgs, conjugate", 1.0),
        ("B3 stack of 20 cubes", "pgs, conjugate", 1.0),
        ("B7a ball of 672 links' mass on a chain of 40", "pgs", 3.5),
        pytest.param("B7b bridge of 160 links", "pgs", 3.5, marks=pytest.mark.slow),
    ],
)
def test_gates_in_a_short_run(name, tier, seconds, gate):
    case = BY_NAME[name]
    run, flags = record(case, tier, seconds)
    values = case.measure(run)
    assert not flags
    for name, limit in case.gates.items():
        gate(name, values[name], limit)


@pytest.mark.parametrize("restitution", [0.0, 1.0])
@pytest.mark.parametrize("precision", QUICK_AND_SLOW_PRECISION, indirect=True)
def test_small_block_of_balls(precision, restitution, gate):
    """A3 and A4 with 27 balls for 2 s: the overlap of RaiSim, and no energy from nothing."""
    dt, lowest = 1 / 240, 0.101 + restitution
    case = dataclasses.replace(
        CASES[0], push=NO_PUSH, dt=dt,
        build=lambda options: hard_scenes.block_of_balls(options, 3, lowest, restitution),
    )  # fmt: skip
    run, flags = record(case, "pgs", 2.0)
    assert not flags
    # The gate for 216 balls, by the number of balls.
    gate("sum of squared overlaps [m^2]", overlap_of_balls(run)["sum of squared overlaps [m^2]"], 135 * dt**2 / 8)
    gate("energy gained", max(0.0, energy_of_balls(run)["energy gained / that at the start"]), 1e-4)
    assert run.speed.max() > 0.5


def test_time_of_impact_of_a_bullet(precision, gate):
    """B12e: a ball of 1 m at 1e5 m/s, 998 m away from the near side of a cube of 2 m."""
    still, upright = (np.zeros(3), np.zeros(3)), np.array([1.0, 0.0, 0.0, 0.0])
    found = jax.jit(
        lambda place, velocity: time_of_impact(
            Sphere(1.0),
            (place, upright),
            (velocity, still[1]),
            Box((1.0, 1.0, 1.0)),
            (np.zeros(3), upright),
            still,
            1.0,
        )
    )(jnp.array([-1000.0, 0.3, 0.2]), jnp.array([1e5, 0.0, 0.0]))
    assert bool(found.hit)
    gate("time / 0.00998 s - 1", float(found.time) / 0.00998 - 1, {"float32": 1e-6, "float64": 1e-9}[str(precision)])
