"""Hyperparameters of PPO, by environment and backend."""

import math
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Hyperparameters:
    """Everything that PPO can be told (Schulman et al. 2017, https://arxiv.org/abs/1707.06347).

    Attributes:
        worlds: Worlds stepped side by side.
        steps: World-steps to train for, all worlds together.
        samples_per_update: World-steps collected before each update; kept when ``worlds`` changes.
        minibatch_count: Minibatches that one pass over the samples is cut into.
        epochs: Passes over the samples in each update.
        learning_rate: Of Adam, at the start; it falls linearly to zero at ``steps`` when ``anneal`` is set.
        anneal: Whether the learning rate falls.
        discount: Discount per control step.
        trace_decay: Lambda of generalized advantage estimation.
        clip_range: Largest relative change of a probability that is rewarded.
        entropy_coefficient: Weight of the entropy bonus.
        value_coefficient: Weight of the critic's loss.
        maximum_gradient_norm: Gradients are scaled down to this norm.
        hidden_sizes: Widths of the hidden layers, for the actor and for the critic.
        initial_log_standard_deviation: Of the exploration noise. Backend ``jax`` measures actions in units of their
            bounds, backend ``sb3`` in the units of the action space.
        normalize_observations: Shift and scale observations by their running mean and standard deviation.
        normalize_rewards: Divide rewards by the running standard deviation of the discounted return.
        evaluations: Number of evaluations during training, evenly spread.
    """

    worlds: int = 64
    steps: int = 1_000_000
    samples_per_update: int = 8192
    minibatch_count: int = 16
    epochs: int = 10
    learning_rate: float = 3e-4
    anneal: bool = False
    discount: float = 0.99
    trace_decay: float = 0.95
    clip_range: float = 0.2
    entropy_coefficient: float = 0.0
    value_coefficient: float = 0.5
    maximum_gradient_norm: float = 0.5
    hidden_sizes: tuple[int, ...] = (64, 64)
    initial_log_standard_deviation: float = 0.0
    normalize_observations: bool = True
    normalize_rewards: bool = True
    evaluations: int = 10

    def __post_init__(self) -> None:
        for name in ("worlds", "steps", "samples_per_update", "minibatch_count", "epochs", "evaluations"):
            require_whole_number(name, getattr(self, name), minimum=1)
        if not (self.learning_rate > 0 and math.isfinite(self.learning_rate)):
            raise ValueError(f"learning_rate must be positive and finite, got {self.learning_rate}")
        for name in ("discount", "trace_decay"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        for name in ("clip_range", "maximum_gradient_norm"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    @property
    def rollout_length(self) -> int:
        """Steps of each world in one update: enough for the samples, and divisible into minibatches of two or more."""
        samples = max(min(self.samples_per_update, self.steps), 2 * self.minibatch_count)
        length = math.ceil(samples / self.worlds)
        multiple = self.minibatch_count // math.gcd(self.worlds, self.minibatch_count)
        return math.ceil(length / multiple) * multiple

    @property
    def minibatch_size(self) -> int:
        """Samples in one minibatch."""
        return self.rollout_length * self.worlds // self.minibatch_count

    @property
    def update_count(self) -> int:
        """Updates needed for ``steps``; the last rollout is always whole."""
        return math.ceil(self.steps / (self.rollout_length * self.worlds))

    def to_dictionary(self) -> dict[str, object]:
        """The fields, for ``metrics.json``."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def require_whole_number(name: str, value: object, minimum: int) -> None:
    """Raise ``ValueError`` unless ``value`` is an integer of at least ``minimum``."""
    if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
        raise ValueError(f"{name} must be a whole number of at least {minimum}, got {value!r}")


# As many worlds as evaluation episodes, so that backend sb3 trains and evaluates with one compiled program.
_INVERTED_PENDULUM = Hyperparameters(
    worlds=20, steps=200_000, samples_per_update=2000, minibatch_count=20, epochs=10, evaluations=100
)

_BALL_BALANCE = Hyperparameters(
    worlds=64,
    steps=300_000,
    samples_per_update=4096,
    minibatch_count=16,
    epochs=10,
    learning_rate=6e-4,
    anneal=True,
    discount=0.98,
)

PRESETS: dict[tuple[str, str], Hyperparameters] = {
    ("mathota/InvertedPendulum-v0", "sb3"): _INVERTED_PENDULUM,
    ("mathota/InvertedPendulum-v0", "jax"): _INVERTED_PENDULUM,
    ("mathota/BallBalance-v0", "sb3"): _BALL_BALANCE,
    ("mathota/BallBalance-v0", "jax"): _BALL_BALANCE,
}


def preset(environment_id: str, backend: str) -> Hyperparameters:
    """The tuned hyperparameters of an environment, or the defaults where none were tuned."""
    return PRESETS.get((environment_id, backend), Hyperparameters())
