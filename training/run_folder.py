"""Where a training run writes its results."""

import time
from pathlib import Path

METRICS_FILE = "metrics.json"
CURVE_FILE = "learning_curve.png"
REPLAY_FILE = "replay.html"


def create_run_folder(environment_id: str, backend: str, output: Path | None = None) -> Path:
    """Create ``runs/<environment>-<backend>-<time>``, or the folder that was asked for.

    Args:
        environment_id: Its part before the last slash is left out.
        backend: Name of the backend.
        output: The folder to use instead; it may exist but must not hold an earlier run.

    Raises:
        ValueError: If ``output`` holds a run already, or cannot be a folder.
    """
    if output is not None:
        if output.exists() and not output.is_dir():
            raise ValueError(f"--output {output} is not a folder; give another")
        if (output / METRICS_FILE).exists():
            raise ValueError(f"--output {output} holds an earlier run; give another folder or remove that one")
        output.mkdir(parents=True, exist_ok=True)
        return output
    base = f"{environment_id.rpartition('/')[2]}-{backend}-{time.strftime('%Y%m%d-%H%M%S')}"
    attempt = 1
    while True:
        folder = Path("runs") / (base if attempt == 1 else f"{base}-{attempt}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            attempt += 1
        else:
            return folder
