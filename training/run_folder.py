"""Where training and fits write their results."""

import tempfile
import time
from pathlib import Path

METRICS_FILE = "metrics.json"
CURVE_FILE = "learning_curve.png"
REPLAY_FILE = "replay.html"


def create_run_folder(name: str, result_file: str, output: Path | None = None) -> Path:
    """Create ``runs/<name>-<time>``, or the folder that was asked for.

    Args:
        name: What is run.
        result_file: Name of the file by which an earlier run is known.
        output: The folder to use instead; it may exist but must not hold an earlier run.

    Raises:
        ValueError: If ``output`` holds a run already, or the folder cannot be made or written to.
    """
    if output is not None:
        if (output / result_file).exists():
            raise ValueError(f"--output {output} holds an earlier run; give another folder or remove that one")
        make_folder(output)
        return output
    base = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    attempt = 1
    while True:
        folder = Path("runs") / (base if attempt == 1 else f"{base}-{attempt}")
        try:
            make_folder(folder, exist_ok=False)
        except FileExistsError:
            attempt += 1
        else:
            return folder


def make_folder(folder: Path, exist_ok: bool = True) -> None:
    """Make a folder that can be written to: what takes hours must not be lost at its end.

    Args:
        folder: The folder; those above it are made too.
        exist_ok: Whether it may exist.

    Raises:
        ValueError: If it is no folder, or cannot be made or written to.
        FileExistsError: If it exists and must not.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--output {folder} is not a folder; give another")
    try:
        folder.mkdir(parents=True, exist_ok=exist_ok)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        if isinstance(error, FileExistsError) and not exist_ok:
            raise
        raise ValueError(f"--output {folder}: nothing can be written there ({error}); give another") from error
