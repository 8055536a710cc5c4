"""Intervals, correlations and what is said of parameters: against linear least squares in closed form, and its scatter."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from mathota_jax import Box, Hinge, SceneBuilder, Sphere, rollout
from mathota_jax.fit import Noise, Parameter, Spread, Trajectories, fit
from mathota_jax.fit.fitting import solve
from mathota_jax.fit.normal_equations import Weights
from mathota_jax.fit.objective import Linearised, Objective
from mathota_jax.fit.parameters import parameter_vector
from mathota_jax.fit.residual_scale import residual_scale
from mathota_jax.fit.uncertainty import uncertainty
from tests.fit.scenes import GRAVITY
from tests.scenes import undamped

FRAME = 1 / 60
TIMES = np.arange(31) * FRAME
SIGMA = 1e-3
QUANTILE = 0.975


def thrown_ball():
    builder = SceneBuilder(gravity=(0.0, -9.0, 0.0))
    builder.add_body(Sphere(0.1), mass=1.0, name="ball")
    return builder.build(undamped(dt=FRAME))


def throws(seed):
    """Positions of a thrown ball with noise, far from where the scene has it."""
    path = np.stack([1 + 2 * TIMES, 2 + 3 * TIMES - GRAVITY / 2 * TIMES**2, 0.3 + 0.1 * TIMES], -1)
    position = path + SIGMA * np.random.default_rng(seed).normal(size=path.shape)
    return Trajectories("ball", FRAME, position[None, :, None])


def flat(data):
    """What a camera that looks along z records."""
    position = data.position.copy()
    position[..., 2] = np.nan
    return dataclasses.replace(data, position=position)


def least_squares(data, gravity=None):
    """Gravity, its standard deviation and degrees of freedom by straight lines and a parabola; or about a given gravity."""
    components = [values for values in data.position[0, :, 0].T if np.isfinite(values).all()]
    square, count = 0.0, 0
    line = np.stack([np.ones_like(TIMES), TIMES], 1)
    parabola = np.column_stack([line, -(TIMES**2) / 2])
    best = np.linalg.lstsq(parabola, components[1], rcond=None)[0][2]
    gravity = best if gravity is None else gravity
    for axis, values in enumerate(components):
        level = values + (gravity * TIMES**2 / 2 if axis == 1 else 0.0)
        square += np.sum((level - line @ np.linalg.lstsq(line, level, rcond=None)[0]) ** 2)
        count += len(values) - 2
    variance = square / (count - 1) * np.linalg.inv(parabola.T @ parabola)[2, 2]
    return best, np.sqrt(variance), count - 1


@pytest.fixture(scope="module")
def ball_objective():
    """Gravity by the throw of a ball, compiled once."""
    model, state = thrown_ball()
    vector = parameter_vector(model, state, ["gravity"])
    return Objective(model, state, vector, throws(0), Noise(SIGMA), 1, 1, "free", Spread())


@pytest.mark.parametrize("camera", [lambda data: data, flat], ids=["space", "plane"])
def test_components_that_were_never_recorded_tell_nothing(ball_objective, camera):
    """Motions along x, y and z are independent: without z, gravity and its interval are those of x and y."""
    data = camera(throws(0))
    result = solve(ball_objective.with_data(data), ball_objective.vector.start[None])
    best, deviation, freedom = least_squares(data)
    assert abs(result["gravity"] - best) < 0.01 * deviation
    half = deviation * stats.t.ppf(QUANTILE, freedom)
    np.testing.assert_allclose(np.subtract(result.interval("gravity"), best), [-half, half], rtol=0.02)
    assert not result.warnings


def test_components_far_from_the_scene_are_named(ball_objective):
    """A beginning that is pulled along z alone says so."""
    objective = ball_objective.with_data(flat(throws(0)))
    charts = np.zeros((1, 1, objective.chart_size))
    charts[..., 2], charts[..., 6] = 0.1, 100.0
    away = objective.pulled(charts)
    assert away["ball", "position (z)"] == pytest.approx(0.1 / Spread().position)
    assert away["ball", "velocity (z)"] == 0.0 and away["ball", "orientation"] == 0.0


@pytest.mark.parametrize(
    ("parameter", "bound"),
    [
        (Parameter("gravity", lower=0.01, upper=5000.0), None),
        (Parameter("gravity", lower=1.0, upper=9.5), 9.5),
        (Parameter("gravity", lower=10.0, upper=20.0, start=12.0), 10.0),
        (Parameter("gravity", lower=10.0, start=11.0), 10.0),
        (Parameter("gravity", lower=10.0, start=11.0, transform="softplus"), 10.0),
    ],
    ids=str,
)
def test_bounds_are_told_from_the_estimate(parameter, bound):
    """At a bound beyond which the least squares lie the interval is that of least squares, cut off; else all of it."""
    data = throws(0)
    result = fit(*thrown_ball(), [parameter], data, noise=Noise(SIGMA))
    best, deviation, freedom = least_squares(data, bound)
    half = deviation * stats.t.ppf(QUANTILE, freedom)
    centre = best if bound is None else bound
    expected = np.clip([centre - half, centre + half], parameter.lower, parameter.upper)
    np.testing.assert_allclose(result.interval("gravity"), expected, atol=0.03 * half)
    said = [warning for warning in result.warnings if "'gravity'" in warning]
    assert not any("not determined" in warning for warning in said)
    assert [f"at its bound {bound:g}" in warning for warning in said] == [True] if bound else not said


@pytest.mark.parametrize(("distance", "told"), [(0.5, False), (3.0, True)])
def test_bounds_near_the_estimate(distance, told):
    """A bound is told from the estimate by standard deviations, be the other one as far as it may."""
    data = throws(0)
    best, deviation, freedom = least_squares(data)
    parameter = Parameter("gravity", lower=best - distance * deviation, upper=1e4, start=10.0)
    result = fit(*thrown_ball(), [parameter], data, noise=Noise(SIGMA))
    assert abs(result["gravity"] - best) < 0.02 * deviation
    assert any("at its bound" in warning for warning in result.warnings) != told
    low, high = result.interval("gravity")
    half = deviation * stats.t.ppf(QUANTILE, freedom)
    # The logarithm of the distance to the bound, of which the deviation is a third, is taken for normal.
    assert low >= parameter.lower and best + 0.97 * half < high < best + (2.0 if told else 1.03) * half


def linear_problem(slopes, precision, seed=0):
    """Moments of inertia of a box by residuals that are linear in them, slopes (residual, 3): estimate and `Linearised`."""
    builder = SceneBuilder()
    builder.add_body(Box((0.05, 0.3, 0.2)), mass=1.0, name="box")
    vector = parameter_vector(*builder.build(), ["inertia[box]"])
    unbounded = vector.start + 0.1
    second = np.exp(unbounded)
    residual = np.random.default_rng(seed).normal(size=len(slopes))
    values = second.sum() - second
    complement = np.eye(len(slopes)) - slopes @ np.linalg.pinv(slopes)
    residual = complement @ residual  # at the least squares
    by_parameters = slopes @ (second[None] * (1.0 - np.eye(3)))
    none = np.zeros((1, 0, 0))
    found = Linearised(
        residual[None, None],
        by_parameters[None, None],
        np.zeros((1, 1, len(slopes), 0)),
        none,
        np.zeros((1, 0, 0, 3)),
        none[..., None],
        none[..., None],
    )
    found = Linearised(*(part.astype(precision) for part in found))
    weights = Weights(np.ones((1, 1, len(slopes))), np.zeros(0), None)
    outcome = uncertainty(
        vector, unbounded, found, weights, np.zeros(0, bool), np.zeros(len(slopes), bool), 0, confidence=0.95
    )
    return values, residual, outcome


def test_moments_of_inertia(precision):
    """Covariance, correlation and intervals are those of the moments, not of the logarithms that the optimiser moves."""
    slopes = np.random.default_rng(1).normal(size=(40, 3)) * [300.0, 500.0, 400.0]
    values, residual, outcome = linear_problem(slopes, precision)
    covariance = residual @ residual / 37 * np.linalg.inv(slopes.T @ slopes)
    deviation = np.sqrt(np.diagonal(covariance))
    np.testing.assert_allclose(outcome.covariance, covariance, rtol=1e-4, atol=1e-5 * covariance.max())
    np.testing.assert_allclose(outcome.correlation, covariance / deviation / deviation[:, None], atol=1e-4)
    half = deviation * stats.t.ppf(QUANTILE, 37)
    np.testing.assert_allclose(outcome.upper, values + half, rtol=1e-5)
    np.testing.assert_allclose(outcome.lower, values - half, rtol=1e-5)


def test_the_moment_that_is_determined_is_told_from_the_others(precision):
    """A body that turns about its third axis shows that moment alone."""
    slopes = np.random.default_rng(1).normal(size=(40, 1)) * [0.0, 0.0, 400.0]
    values, residual, outcome = linear_problem(slopes, precision)
    half = stats.t.ppf(QUANTILE, 37) * np.sqrt(residual @ residual / 37 / np.sum(slopes[:, 2] ** 2))
    np.testing.assert_allclose(outcome.lower, [0.0, 0.0, values[2] - half], rtol=1e-5)
    np.testing.assert_allclose(outcome.upper, [np.inf, np.inf, values[2] + half], rtol=1e-5)
    undetermined = [f"'inertia[box][{k}]' is not determined" in " ".join(outcome.warnings) for k in range(3)]
    assert undetermined == [True, True, False]


def test_moments_of_which_ratios_alone_are_known(precision):
    """A body that falls freely moves as one with twice the moments: none of the three has an interval."""
    values = linear_problem(np.ones((5, 3)), precision)[0]
    across = np.eye(3) - np.outer(values, values) / (values @ values)
    _, _, outcome = linear_problem(np.random.default_rng(1).normal(size=(40, 3)) @ across * 400, precision)
    np.testing.assert_array_equal(outcome.lower, 0.0)
    np.testing.assert_array_equal(outcome.upper, np.inf)
    assert sum("is not determined" in warning for warning in outcome.warnings) == 3


@pytest.mark.slow
def test_pendulum(precision):
    """On its hinge, by positions: of the moments of inertia that about the hinge alone, within its interval."""
    builder = SceneBuilder(gravity=(0.0, -GRAVITY, 0.0))
    builder.add_body(Box((0.1, 0.1, 0.1)), static=True, name="base", collides=False)
    builder.add_body(
        Box((0.05, 0.3, 0.1)),
        mass=1.0,
        name="rod",
        position=(0.0, -0.3, 0.0),
        collides=False,
        velocity=(0.6, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 2.0),
    )
    builder.add_joint(Hinge("base", "rod", anchor=(0, 0, 0), axis=(0, 0, 1)))
    model, state = builder.build(undamped(dt=1 / 240))
    truth = model.inertia * 1.3
    later = rollout(dataclasses.replace(model, inertia=truth), state, 120)[1].position[:, 1]
    position = np.concatenate([state.position[None, 1], later])[None, :, None]
    position = position + SIGMA * np.random.default_rng(1).normal(size=position.shape)
    result = fit(model, state, ["inertia[rod]"], Trajectories("rod", 1 / 240, position), start="model")
    assert result.interval("inertia[rod][0]") == result.interval("inertia[rod][1]") == (0.0, np.inf)
    low, high = result.interval("inertia[rod][2]")
    assert low < float(truth[1, 2]) < high < 1.02 * low


def huber_line(values, design, limit):
    """Huber's estimates (repetition, 2) of a line with unit noise by Newton steps of the weighted sums, NumPy."""
    found = values @ np.linalg.pinv(design).T
    for _ in range(200):
        residual = values - found @ design.T
        found = found + np.clip(residual, -limit, limit) @ np.linalg.pinv(design).T
    return found, values - found @ design.T


@pytest.mark.parametrize("limit", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_scale_of_clipped_residuals(limit, scale, gate):
    """95 % intervals of a line by Huber's estimate hold the truth in 95 % of 2000 repetitions, at any size of the noise."""
    design = np.stack([np.ones(40), np.linspace(-1, 1, 40)], 1)
    values = scale * np.random.default_rng(0).normal(size=(2000, 40))
    found, residuals = huber_line(values, design, limit)
    shape = np.sqrt(np.linalg.inv(design.T @ design)[1, 1])
    scales = [residual_scale(residual, np.zeros(0), limit, 38) for residual in residuals]
    half = np.asarray([s.spread * stats.t.ppf(QUANTILE, s.freedom) * shape for s in scales])
    gate("coverage - 0.95", np.mean(np.abs(found[:, 1]) < half) - 0.95, 0.02)
    gate("noise factor / truth - 1", np.mean([s.noise_factor for s in scales]) / scale - 1, 0.2)


def test_clipped_residuals_widen_intervals(ball_objective, gate):
    """Normal noise: clipped at 0.3 deviations the estimate scatters 1.17 times as far as least squares (P. Huber, 1964)."""
    begin, objective = ball_objective.vector.start[None], ball_objective
    widths = []
    for huber in (None, 0.3):
        results = [solve(objective.with_data(throws(seed)), begin, huber=huber) for seed in range(20)]
        widths.append(np.mean([result.upper[0] - result.lower[0] for result in results]))
    gate("widening - 1.17", widths[1] / widths[0] - 1.17, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("huber", [0.3, 1.0])
def test_intervals_of_clipped_residuals_cover_the_truth(ball_objective, huber, gate):
    """95 % intervals hold the truth in 95 % of 300 repetitions, within the binomial spread of such a count."""
    begin, held = ball_objective.vector.start[None], 0
    for seed in range(300):
        low, high = solve(ball_objective.with_data(throws(seed)), begin, huber=huber).interval("gravity")
        held += low <= GRAVITY <= high
    gate("coverage - 0.95", held / 300 - 0.95, 3 * np.sqrt(0.95 * 0.05 / 300))
