"""What ``make demo`` runs: train a balancing cart-pole from nothing and check that it balances."""

import sys
import time

from training.requirements import MissingExtraError
from training.train import Request, prepare, print_result, train

ENVIRONMENT_ID = "mathota/InvertedPendulum-v0"
GOAL = 950.0
# Training stops at a stricter mark than the goal, since the final evaluation has other random starts.
TRAINING_TARGET = 990.0


def main() -> int:
    """Train with stable-baselines3; the exit status is 1 if the goal is missed."""
    started = time.perf_counter()
    try:
        plan = prepare(Request(ENVIRONMENT_ID, backend="sb3", evaluation_episodes=20, target_return=TRAINING_TARGET))
    except MissingExtraError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    result = train(plan)
    print_result(result)
    mean_return = result.metrics["evaluation"]["mean_return"]
    seconds = time.perf_counter() - started
    if mean_return < GOAL:
        print(
            f"goal missed: mean return {mean_return:.1f} of {GOAL:g} over 20 episodes after {seconds:.0f} s; "
            "please report this with the metrics.json above",
            file=sys.stderr,
        )
        return 1
    print(f"goal met: mean return {mean_return:.1f} (goal {GOAL:g}, best 1000) in {seconds:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
