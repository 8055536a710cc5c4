"""What every learner on the device keeps: the same seed gives the same policy, and divergence is an error."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.training import test_ppo, test_short_horizon
from tests.training.toy_environments import MatchTarget, ignore
from training import ppo, short_horizon
from training.learning import DivergedError

LEARNERS = pytest.mark.parametrize(
    ("train", "settings", "rate"),
    [
        pytest.param(ppo.train, test_ppo.SMALL, "learning_rate", id="ppo"),
        pytest.param(short_horizon.train, test_short_horizon.SMALL, "critic_learning_rate", id="short horizon"),
    ],
)


@LEARNERS
def test_same_seed_same_policy(train, settings, rate):
    short = replace(settings, steps=1024)
    first, second, other = (
        train(MatchTarget(), short, seed, report=ignore, should_stop=ignore).layers for seed in (3, 3, 4)
    )
    jax.tree.map(np.testing.assert_array_equal, first, second)
    assert not np.array_equal(first[0]["weight"], other[0]["weight"])


@LEARNERS
def test_divergence_is_reported(train, settings, rate):
    with pytest.raises(DivergedError, match="lower the learning rate"):
        train(MatchTarget(), replace(settings, **{rate: 1e38}), 0, report=ignore, should_stop=ignore)
