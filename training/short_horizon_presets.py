"""Hyperparameters of short-horizon actor-critic (backend ``gradient``), by environment."""

import math
from dataclasses import dataclass, fields

from training.presets import require_whole_number


@dataclass(frozen=True)
class ShortHorizonHyperparameters:
    """Everything that SHAC can be told (Xu et al. 2022, https://arxiv.org/abs/2204.07137).

    Attributes:
        worlds: Worlds stepped side by side.
        steps: World-steps to train for, all worlds together.
        horizon: Control steps of each world in one update, through which the return is differentiated.
        actor_learning_rate: Of Adam, at the start; it falls linearly to a tenth at ``steps``.
        critic_learning_rate: Likewise, for the critic.
        discount: Discount per control step.
        trace_decay: Lambda of the critic's targets, TD(lambda).
        target_decay: Share of the target critic that is kept in each update.
        critic_epochs: Passes of the critic over the samples of an update.
        minibatch_count: Minibatches that one pass is cut into.
        maximum_gradient_norm: Gradients of actor and critic are scaled down to this norm.
        maximum_state_norm: Bound, for each world and control step, on the gradient of this world's discounted return by
            the state (`clip_cotangent`), where a reward of 1 for ever is worth 1. Whatever the number of worlds and the
            horizon. The default is meant for gradients that explode.
        hidden_sizes: Widths of the hidden layers, for the actor and for the critic.
        initial_log_standard_deviation: Of the exploration noise, in units of the bounds of the actions.
        evaluations: Number of evaluations during training, evenly spread.
    """

    worlds: int = 64
    steps: int = 1_000_000
    horizon: int = 16
    actor_learning_rate: float = 2e-3
    critic_learning_rate: float = 2e-3
    discount: float = 0.98
    trace_decay: float = 0.95
    target_decay: float = 0.8
    critic_epochs: int = 8
    minibatch_count: int = 4
    maximum_gradient_norm: float = 1.0
    maximum_state_norm: float = 1e4
    hidden_sizes: tuple[int, ...] = (64, 64)
    initial_log_standard_deviation: float = -1.0
    evaluations: int = 10

    def __post_init__(self) -> None:
        for name in ("worlds", "steps", "horizon", "critic_epochs", "minibatch_count", "evaluations"):
            require_whole_number(name, getattr(self, name), minimum=1)
        for name in ("actor_learning_rate", "critic_learning_rate", "maximum_gradient_norm", "maximum_state_norm"):
            if not (getattr(self, name) > 0 and math.isfinite(getattr(self, name))):
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if not 0 <= self.discount < 1:
            raise ValueError(f"discount must be in [0, 1), got {self.discount}")
        for name in ("trace_decay", "target_decay"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")

    @property
    def rollout_length(self) -> int:
        """Steps of each world in one update: the horizon, or enough to cut the samples into equal minibatches."""
        multiple = self.minibatch_count // math.gcd(self.worlds, self.minibatch_count)
        return math.ceil(self.horizon / multiple) * multiple

    @property
    def update_count(self) -> int:
        """Updates needed for ``steps``; the last rollout is always whole."""
        return math.ceil(self.steps / (self.rollout_length * self.worlds))

    def to_dictionary(self) -> dict[str, object]:
        """The fields, for ``metrics.json``."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


SHORT_HORIZON_PRESETS: dict[str, ShortHorizonHyperparameters] = {
    "mathota/InvertedPendulum-v0": ShortHorizonHyperparameters(
        worlds=20, steps=200_000, discount=0.99, evaluations=100
    ),
    "mathota/BallBalance-v0": ShortHorizonHyperparameters(steps=300_000),
}


def short_horizon_preset(environment_id: str) -> ShortHorizonHyperparameters:
    """The tuned hyperparameters of an environment, or the defaults where none were tuned."""
    return SHORT_HORIZON_PRESETS.get(environment_id, ShortHorizonHyperparameters())
