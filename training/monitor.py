"""Follow a training run: progress bar, learning curve, evaluations and early stop."""

import sys
import time

from tqdm import tqdm

from training.evaluate import Evaluator
from training.policies import Policy


class Monitor:
    """What both backends report to.

    Args:
        evaluator: Runs the evaluations.
        total_steps: World-steps of the whole run.
        seed: Seed of the run; every evaluation has starts of its own.
        target_return: Stop as soon as the mean return of an evaluation reaches this; None never stops.

    Attributes:
        curve: One entry for each update in which an episode finished: ``steps``, ``seconds``, ``mean_return`` (of the
            exploring policy), ``episodes``.
        evaluations: One entry for each evaluation: ``steps``, ``seconds``, ``mean_return``, ``std_return``.
        steps: World-steps so far.
        target_reached: Whether an evaluation reached the target.
    """

    def __init__(self, evaluator: Evaluator, total_steps: int, seed: int, target_return: float | None = None) -> None:
        self.curve: list[dict[str, float]] = []
        self.evaluations: list[dict[str, float]] = []
        self.steps = 0
        self.target_reached = False
        self._evaluator = evaluator
        self._seed = seed
        self._target_return = target_return
        self._start = time.perf_counter()
        interactive = sys.stderr.isatty()
        self._bar = tqdm(
            total=total_steps, unit="step", unit_scale=True, desc="training", mininterval=0.1 if interactive else 5.0
        )

    @property
    def seconds(self) -> float:
        """Wall seconds since the start."""
        return time.perf_counter() - self._start

    def report(self, steps: int, mean_return: float, episodes: int) -> None:
        """Note one update.

        Args:
            steps: World-steps so far.
            mean_return: Of the episodes that finished since the last report; ignored if there were none.
            episodes: Their number.
        """
        self._bar.update(steps - self.steps)
        self.steps = steps
        if episodes:
            self._bar.set_postfix({"return": f"{mean_return:.1f}"}, refresh=False)
            self.curve.append(
                {"steps": steps, "seconds": self.seconds, "mean_return": mean_return, "episodes": episodes}
            )

    def should_stop(self, policy: Policy) -> bool:
        """Evaluate the policy; True when the target is reached."""
        evaluation = self._evaluator.run(policy.act, seed=self.next_seed())
        summary = evaluation.summary()
        self.evaluations.append(
            {
                "steps": self.steps,
                "seconds": self.seconds,
                "mean_return": summary["mean_return"],
                "std_return": summary["std_return"],
            }
        )
        self.target_reached = self._target_return is not None and summary["mean_return"] >= self._target_return
        return self.target_reached

    def next_seed(self) -> int:
        """A seed that no earlier evaluation of this run used."""
        return self._seed + 1_000_003 * (len(self.evaluations) + 1)

    def close(self) -> None:
        """End the progress bar."""
        self._bar.close()
