"""Known parameters are found again from data made with them, with honest intervals."""

import dataclasses
import math

import numpy as np
import pytest

from mathota_jax import Plane, SceneBuilder, Sphere
from mathota_jax.fit import Noise, Parameter, Spread, Trajectories, fit
from mathota_jax.fit.fitting import solve
from mathota_jax.fit.objective import Objective
from mathota_jax.fit.parameters import parameter_vector
from tests.fit.scenes import (
    FRAME,
    GRAVITY,
    NOISE,
    RADIUS,
    SUBSTEPS,
    TRUTH,
    bounce_height,
    clean_throws,
    noisy,
    puck,
    slides,
    struck_ball,
    unknown,
)
from tests.gradients.bystanders import add_bystanders
from tests.marks import slow_but
from tests.scenes import undamped


def dropped_ball(beside=False):
    builder = SceneBuilder(gravity=(0.0, -GRAVITY, 0.0))
    builder.add_body(Plane(normal=(0, 1, 0), offset=0.0), static=True, restitution=0.9, name="ground")
    builder.add_body(Sphere(RADIUS), mass=1.0, restitution=0.9, position=(0, 1 + RADIUS, 0), name="ball")
    if beside:
        add_bystanders(builder)
    return builder.build(undamped())


def drops(restitution=0.8):
    """20 heights in 2.5 s; nothing else was recorded."""
    position = np.full((1, 21, 1, 3), np.nan)
    position[0, :, 0, 1] = RADIUS + bounce_height(np.linspace(0, 2.5, 21), restitution)
    return Trajectories("ball", 2.5 / 20, position)


def restitution_by_heights(model, state):
    parameter = Parameter(("restitution[ball]", "restitution[ground]"))
    vector = parameter_vector(model, state, [parameter])
    return Objective(
        model, state, vector, drops(), Noise(), segment_count=1, substeps=30, start="model", spread=Spread()
    )


@pytest.fixture(scope="module")
def drop_objective():
    """Restitution by the heights, compiled once."""
    return restitution_by_heights(*dropped_ball())


@pytest.mark.parametrize("start", [0.6, 0.95])
def test_restitution_over_several_bounces(drop_objective, start, gate):
    """BENCHMARKS C8: |e - 0.8| < 1e-3 in at most 100 steps, from far below and above."""
    begin = np.asarray([[math.log(start / (1 - start))]])
    result = solve(drop_objective, begin, horizons=(0.3, 0.6, 1.0), step_limit=100)
    gate("restitution - 0.8", result.values[0] - 0.8, 1e-3)
    assert result.converged and result.steps <= 100
    assert not result.warnings


@pytest.mark.parametrize(("rate", "limit", "converged"), [(1e-4, 3, False), (0.05, 150, True)])
def test_first_order_steps_tell_whether_they_have_arrived(rate, limit, converged, float64):
    """A falling ball: three small steps leave gravity where it was, 150 larger ones find the least squares of it."""
    optax = pytest.importorskip("optax")
    builder = SceneBuilder(gravity=(0.0, -GRAVITY, 0.0))
    builder.add_body(Sphere(RADIUS), mass=1.0, name="ball")
    model, state = builder.build(undamped(dt=0.02))
    times = np.arange(26) * 0.02
    height = -0.5 * 9.0 * times**2 + np.random.default_rng(0).normal(size=26) * NOISE.position
    position = np.zeros((1, 26, 1, 3))
    position[0, :, 0, 1] = height
    result = fit(
        model,
        state,
        ["gravity"],
        Trajectories("ball", 0.02, position),
        start="model",
        noise=Noise(position=NOISE.position),
        optimiser=optax.adam(rate),
        step_limit=limit,
    )
    best = -2.0 * np.sum(height * times**2) / np.sum(times**4)
    low, high = result.interval("gravity")
    assert result.converged == converged
    assert any("Not converged" in warning for warning in result.warnings) == (not converged)
    assert (abs(result["gravity"] - best) < 0.1 * (high - low)) == converged


@pytest.mark.slow
def test_restitution_beside_others(precision, gate):
    """The same in both precisions beside a contact at rest and a pair that never touches."""
    objective = restitution_by_heights(*dropped_ball(beside=True))
    for start in (0.6, 0.95):
        test_restitution_over_several_bounces(objective, start, gate)


def test_multiple_shooting(gate):
    """Five bounces at once from 0.6, where the whole motion in one piece ends in a wrong minimum."""
    times = np.arange(151) / 60
    position = np.zeros((1, 151, 1, 3))
    position[0, :, 0, 1] = RADIUS + bounce_height(times, 0.8)
    position += 1e-3 * np.random.default_rng(0).normal(size=position.shape)
    parameter = Parameter(("restitution[ball]", "restitution[ground]"), start=0.6)
    data = Trajectories("ball", 1 / 60, position)
    result = fit(*dropped_ball(), [parameter], data, start="model", segments=10)
    gate("restitution - 0.8", result.values[0] - 0.8, 2e-3)
    assert result.lower[0] < 0.8 < result.upper[0]
    gate("noise factor - 1", result.noise_factor - 1, 0.15)


@pytest.mark.slow
def test_friction_of_a_puck_of_which_positions_are_known(gate):
    """Coulomb's law in closed form. Pucks that may spin on their edges explain the same with more friction.

    The interval holds the truth in 95 of 100 repetitions: in all of six but for one in 30.
    """
    label = "friction[puck] = friction[table]"
    parameter = Parameter(("friction[puck]", "friction[table]"), lower=0.01, upper=2.0)
    vector = parameter_vector(*puck(0.5), [parameter])
    objective = Objective(*puck(0.5), vector, slides(0.25, 0), Noise(), 1, 2, "free", Spread())
    inside = 0
    for seed in range(1, 7):
        result = solve(objective.with_data(slides(0.25, seed)), vector.start[None])
        gate("friction / truth - 1", result[label] / 0.25 - 1, 0.015)
        gate("noise factor - 1", result.noise_factor - 1, 0.1)
        assert result.converged and not result.warnings
        low, high = result.interval(label)
        inside += low < 0.25 < high < low + 0.01
    assert inside >= 5


def test_what_was_not_recorded_is_far_from_the_scene():
    """A ball that the scene does not let spin bounces to the side: it stuck to the ground, and kept 2/7 of its spin."""
    builder = SceneBuilder(gravity=(0.0, -GRAVITY, 0.0))
    builder.add_body(Plane((0, 1, 0)), static=True, friction=1.0, restitution=0.8, name="ground")
    builder.add_body(
        Sphere(RADIUS), mass=1.0, position=(0, RADIUS + 0.5, 0), friction=1.0, restitution=0.8, name="ball"
    )
    times, spin = np.arange(41) / 60, 30.0
    since = np.maximum(times - math.sqrt(2 * 0.5 / GRAVITY), 0.0)
    position = np.zeros((1, 41, 1, 3))
    position[0, :, 0, 0] = -2 / 7 * RADIUS * spin * since
    position[0, :, 0, 1] = RADIUS + bounce_height(times, 0.8, 0.5)
    result = fit(*builder.build(undamped()), ["gravity"], Trajectories("ball", 1 / 60, position), substeps=4)
    assert any("angular velocity of 'ball', which was not recorded" in warning for warning in result.warnings)
    assert result.initial.angular_velocity[0, 1, 2] == pytest.approx(spin, rel=0.1)


def test_many_starts_run_side_by_side(drop_objective):
    """From 0.6 alone the whole motion leads to a wrong minimum; other starts find the right one and it says so."""
    begin = drop_objective.vector.random_starts(6, seed=0)
    begin[0] = math.log(0.6 / 0.4)
    result = solve(drop_objective, begin)
    assert abs(result.starts[0].values[0] - 0.8) > 0.01
    assert abs(result.values[0] - 0.8) < 1e-3
    assert len(result.starts) == 6


def test_a_wrong_model_is_reported(drop_objective):
    """A ball that loses a tenth of its height whatever it does has no restitution."""
    data = drops()
    position = data.position * np.linspace(1.0, 0.5, 21)[None, :, None, None]
    result = solve(drop_objective.with_data(dataclasses.replace(data, position=position)), np.asarray([[1.0]]))
    assert any("times the noise given" in warning for warning in result.warnings)


@pytest.fixture(scope="module")
def throw_objective():
    """Four parameters by noisy throws, compiled once."""
    model, state = struck_ball()
    vector = parameter_vector(model, state, unknown(1.15))
    return Objective(model, state, vector, noisy(clean_throws(), 0), NOISE, 1, SUBSTEPS, "free", Spread())


def starts_around(vector):
    """The start and five others within a few percent of it: one alone may end in a wrong minimum."""
    return vector.start + 0.05 * np.vstack(
        [np.zeros(vector.start.size), np.random.default_rng(0).normal(size=(5, vector.start.size))]
    )


@pytest.mark.parametrize("seed", slow_but((0,), (0, 2)))
def test_friction_restitution_mass_and_size(throw_objective, seed, gate):
    """Each to 1 % from positions with 1 mm and orientations with 1 degree of noise, from starts 10 % to 15 % away."""
    data = noisy(clean_throws(), seed, with_velocity=True)
    begin = starts_around(throw_objective.vector)
    result = solve(throw_objective.with_data(data), begin, horizons=(0.3, 0.5, 0.65, 0.8, 1.0))
    for label, truth in TRUTH.items():
        gate(f"{label} / truth - 1", result[label] / truth - 1, 0.01)
        low, high = result.interval(label)
        assert low < high < low + 0.04 * truth
    assert abs(result.noise_factor - 1) < 0.05
    assert not result.warnings


def test_missing_frames(throw_objective, gate):
    """A third of the frames, and all orientations of the striker, are missing."""
    data = noisy(clean_throws(), 2, with_velocity=True)
    position, orientation = data.position.copy(), data.orientation.copy()
    lost = np.random.default_rng(0).random(position.shape[:3]) < 1 / 3
    position[lost], orientation[lost] = np.nan, np.nan
    orientation[:, 5:, 1] = np.nan
    data = dataclasses.replace(data, position=position, orientation=orientation)
    begin = starts_around(throw_objective.vector)
    result = solve(throw_objective.with_data(data), begin, horizons=(0.3, 0.65, 1.0), huber=3.0)
    for label, truth in TRUTH.items():
        gate(f"{label} / truth - 1", result[label] / truth - 1, 0.02)


@pytest.mark.slow
def test_intervals_cover_the_truth(throw_objective, gate):
    """95 % intervals hold the truth in 95 % of 200 repetitions, within the binomial spread of such a count."""
    begin = parameter_vector(*struck_ball(), unknown(1.0)).start[None]
    held = dict.fromkeys(TRUTH, 0)
    errors = {label: [] for label in TRUTH}
    for seed in range(200):
        data = noisy(clean_throws(), 1000 + seed, with_velocity=True)
        result = solve(throw_objective.with_data(data), begin)
        for label, truth in TRUTH.items():
            low, high = result.interval(label)
            held[label] += low <= truth <= high
            errors[label].append(result[label] / truth - 1)
    for label, count in held.items():
        print(f"{label}: {count} of 200, rms error {np.sqrt(np.mean(np.square(errors[label]))):.5f}")
        gate(f"{label}: coverage - 0.95", count / 200 - 0.95, 3 * math.sqrt(0.95 * 0.05 / 200))


def test_undetermined_parameters_are_named():
    """The mass of a body that falls alone, and size and friction of one that touches nothing, leave no trace."""
    builder = SceneBuilder(gravity=(0.0, -GRAVITY, 0.0))
    builder.add_body(Plane(normal=(0, 1, 0), offset=-100.0), static=True, name="ground")
    builder.add_body(Sphere(RADIUS), mass=1.0, name="ball")
    time = np.arange(9) * FRAME
    position = np.zeros((1, 9, 1, 3))
    position[0, :, 0, 1] = -9.0 * time**2 / 2 + 1e-4 * np.random.default_rng(0).normal(size=9)
    data = Trajectories("ball", FRAME, position)
    model, state = builder.build(undamped())
    result = fit(model, state, ["mass[ball]", "friction[ball]", "gravity"], data, start="model", noise=Noise(1e-4))
    assert abs(result["gravity"] - 9.0) < 0.05
    assert result.interval("mass[ball]") == (0.0, np.inf)
    for label in ("mass[ball]", "friction[ball]"):
        assert any(f"'{label}' is not determined" in warning for warning in result.warnings)
    assert not any("gravity" in warning for warning in result.warnings)
