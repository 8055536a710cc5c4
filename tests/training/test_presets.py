"""The arithmetic of rollouts and minibatches."""

from dataclasses import replace

import pytest

from training.presets import PRESETS, Hyperparameters, preset
from training.short_horizon_presets import SHORT_HORIZON_PRESETS, ShortHorizonHyperparameters, short_horizon_preset
from training.train import Request


@pytest.mark.parametrize("worlds", [1, 3, 32, 100, 5000])
@pytest.mark.parametrize("steps", [1, 1000, 10**6])
def test_minibatches_divide_the_samples(worlds, steps):
    hyperparameters = Hyperparameters(worlds=worlds, steps=steps)
    samples = hyperparameters.rollout_length * worlds
    assert hyperparameters.minibatch_size * hyperparameters.minibatch_count == samples
    assert hyperparameters.minibatch_size >= 2  # stable-baselines3 divides by their spread
    assert samples >= min(hyperparameters.samples_per_update, steps)
    assert hyperparameters.update_count * samples >= steps > (hyperparameters.update_count - 1) * samples


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("worlds", 0),
        ("steps", 1.5),
        ("learning_rate", 0.0),
        ("learning_rate", float("nan")),
        ("discount", 1.1),
        ("trace_decay", -0.1),
        ("clip_range", 0.0),
    ],
)
def test_impossible_hyperparameters_are_named(name, value):
    with pytest.raises(ValueError, match=name):
        replace(Hyperparameters(), **{name: value})


@pytest.mark.parametrize("backend", ["jax", "gradient"])
def test_an_id_with_its_package_has_the_same_preset(backend):
    plain, with_package = (
        Request(prefix + "mathota/BallBalance-v0", backend).hyperparameters() for prefix in ("", "mathota_envs:")
    )
    assert plain == with_package


def test_presets_name_known_environments_and_backends():
    registration = pytest.importorskip("mathota_envs.registration")
    assert {(environment, backend) for environment in registration.ENVIRONMENTS for backend in ("sb3", "jax")} == set(
        PRESETS
    )
    assert preset("somebody/Else-v0", "jax") == Hyperparameters()
    assert set(SHORT_HORIZON_PRESETS) == set(registration.ENVIRONMENTS)
    assert short_horizon_preset("somebody/Else-v0") == ShortHorizonHyperparameters()


@pytest.mark.parametrize("worlds", [1, 3, 64])
def test_short_horizons_are_whole(worlds):
    hyperparameters = ShortHorizonHyperparameters(worlds=worlds, steps=10_000)
    samples = hyperparameters.rollout_length * worlds
    assert samples % hyperparameters.minibatch_count == 0
    assert hyperparameters.horizon <= hyperparameters.rollout_length < hyperparameters.horizon + 4
    assert hyperparameters.update_count * samples >= 10_000 > (hyperparameters.update_count - 1) * samples


@pytest.mark.parametrize(
    ("name", "value"),
    [("horizon", 0), ("discount", 1.0), ("trace_decay", 1.1), ("target_decay", -0.1), ("maximum_state_norm", 0.0)],
)
def test_impossible_short_horizons_are_named(name, value):
    with pytest.raises(ValueError, match=name):
        replace(ShortHorizonHyperparameters(), **{name: value})
