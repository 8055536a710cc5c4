"""What is measured and how often; every figure of a report carries these."""

from __future__ import annotations

import dataclasses

TIME_STEP = 1 / 240
GRADIENT_BATCH = 256
GRADIENT_STEPS = 100


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run.

    Attributes:
      mode: "full", or "quick" for a look that is too short for publication.
      batches: numbers of worlds at which throughput is measured; the best is reported.
      rounds: interleaved rounds; in each, every contestant runs one timed block.
      block_seconds: least CPU time of a timed block [s].
      warmup_blocks: blocks run before the first round.
      memory_steps: rollout lengths at which the memory of the gradient is read.
      compile_repeats: fresh processes for each compile time.
      time_steps: steps [s] at which error is set against cost.
      timeout_seconds: limit on each measurement; a run that hangs becomes a missing figure, not a stuck report.
    """

    mode: str = "full"
    batches: tuple[int, ...] = (64, 128, 256, 512, 1024, 2048, 4096)
    rounds: int = 50
    block_seconds: float = 0.1
    warmup_blocks: int = 3
    memory_steps: tuple[int, ...] = (25, 50, 100, 200)
    compile_repeats: int = 5
    time_steps: tuple[float, ...] = (1 / 60, 1 / 120, 1 / 240, 1 / 480, 1 / 1000)
    timeout_seconds: float = 1800.0


QUICK = Settings(
    mode="quick",
    batches=(64, 256, 1024, 4096),
    rounds=7,
    block_seconds=0.05,
    warmup_blocks=1,
    compile_repeats=2,
    time_steps=(1 / 60, 1 / 240),
    timeout_seconds=600.0,
)
