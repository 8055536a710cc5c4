"""Fit parameters of a scene to recorded motions: ``python -m training.fit --scene scene.py --data motion.npz ...``.

The scene is a Python file (or a module) with a function ``build_scene() -> SceneBuilder``; another name follows a colon:
``--scene scenes.py:cube``. A parameter is given as ``NAME``, ``NAME=START`` or ``NAME=START:LOWER:UPPER`` (an empty part
keeps the default), and tied ones as ``friction[cube]+friction[ground]=0.2``. The data are trajectories in NPZ or CSV; see
`mathota_jax.fit.load_npz` and `mathota_jax.fit.load_csv` for the layouts. Writes ``report.html`` and ``fit.json`` to a new
folder under ``runs/``, or to ``--output``, which must not hold an earlier fit.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mathota_jax import Options, SceneBuilder
from mathota_jax.fit import FitResult, Noise, Parameter, fit, load
from training.requirements import require_packages
from training.run_folder import create_run_folder

DEFAULT_FUNCTION = "build_scene"
REPORT_FILE = "report.html"
RESULT_FILE = "fit.json"


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        require_packages(("matplotlib", "tqdm", "optax"), "the command line of the fit")
        result, folder = _run(options)
    except (ValueError, ImportError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(result)
    print(f"report: {folder / REPORT_FILE}")
    return 0


def parse_parameter(text: str) -> Parameter:
    """The parameter that a word of the command line stands for.

    Raises:
        ValueError: it has another form; the message shows the forms.
    """
    names, _, rest = text.partition("=")
    parts = rest.split(":") if rest else []
    if len(parts) not in (0, 1, 3) or not all(name.strip() for name in names.split("+")):
        raise ValueError(f"--parameter {text!r}: write NAME, NAME=START or NAME=START:LOWER:UPPER")
    try:
        start, lower, upper = ([float(part) if part.strip() else None for part in parts] + [None] * 3)[:3]
    except ValueError as error:
        raise ValueError(f"--parameter {text!r}: start and bounds must be numbers ({error})") from error
    found = tuple(name.strip() for name in names.split("+"))
    return Parameter(found[0] if len(found) == 1 else found, lower, upper, start)


def load_scene(text: str) -> SceneBuilder:
    """The builder that a function of a file or module returns.

    Raises:
        ValueError: there is no such file, module or function, it fails, or it returns something else.
    """
    source, _, name = text.rpartition(":") if not text.endswith(".py") and ":" in text else (text, "", "")
    name = name or DEFAULT_FUNCTION
    function = getattr(_module(source), name, None)
    if not callable(function):
        raise ValueError(f"--scene {text}: {source} has no function {name}()")
    try:
        builder = function()
    except Exception as error:  # whatever a user's function raises
        raise ValueError(f"--scene {text}: {name}() failed{_failure(error)}") from error
    if not isinstance(builder, SceneBuilder):
        raise ValueError(f"--scene {text}: {name}() must return a SceneBuilder, got {type(builder).__name__}")
    return builder


def _module(source: str) -> Any:
    if not source.endswith(".py"):
        try:
            return importlib.import_module(source)
        except ImportError as error:
            raise ValueError(
                f"--scene: no module {source!r} ({error}); give a file ending in .py or a module"
            ) from error
    path = Path(source)
    if not path.is_file():
        raise ValueError(f"--scene: no file {source}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever a user's file raises
        raise ValueError(f"--scene: {source} can not be loaded{_failure(error)}") from error
    return module


def _failure(error: Exception) -> str:
    """Where and why the user's code failed: the innermost line of the file in which it began."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__)[1:] if "importlib" not in frame.filename]
    own = [frame for frame in frames if frame.filename == frames[0].filename]
    place = f" in line {own[-1].lineno} of {own[-1].filename}" if own else ""
    return f"{place}: {type(error).__name__}: {error}"


def _run(options: argparse.Namespace) -> tuple[FitResult, Path]:
    """The result and the folder in which it is."""
    from training.fit_report import write_report  # needs matplotlib

    builder = load_scene(options.scene)
    data = load(options.data)
    optimiser = _optimiser(options)
    parameters = [parse_parameter(text) for text in options.parameter]
    model, state = builder.build(Options(linear_damping=options.damping, angular_damping=options.damping))
    folder = create_run_folder("fit", RESULT_FILE, options.output)
    try:
        with _progress(options.steps, options.quiet) as progress:
            result = fit(
                model,
                state,
                parameters,
                data,
                start=options.start,
                noise=Noise(options.position_noise, float(np.radians(options.orientation_noise))),
                substeps=options.substeps,
                segments=options.segments,
                horizons=options.horizons,
                huber=options.huber,
                start_count=options.starts,
                seed=options.seed,
                optimiser=optimiser,
                step_limit=options.steps,
                progress=progress,
            )
    except BaseException:
        if options.output is None:
            folder.rmdir()
        raise
    write_report(folder / REPORT_FILE, result, f"Fit of {Path(options.data).name}")
    (folder / RESULT_FILE).write_text(json.dumps(summary(result), indent=2) + "\n")
    return result, folder


def summary(result: FitResult) -> dict[str, Any]:
    """The figures for ``fit.json``; what is not finite becomes null."""
    finite: Callable[[float], float | None] = lambda x: float(x) if np.isfinite(x) else None  # noqa: E731
    rows = zip(result.labels, result.values, result.units, result.lower, result.upper, strict=True)
    return {
        "parameters": {
            label: {"estimate": finite(value), "unit": unit, "lower": finite(low), "upper": finite(high)}
            for label, value, unit, low, high in rows
        },
        "confidence": result.confidence,
        "noise_factor": finite(result.noise_factor),
        "cost": finite(result.cost),
        "steps": result.steps,
        "converged": result.converged,
        "warnings": list(result.warnings),
    }


def _optimiser(options: argparse.Namespace) -> Any:
    if not (options.learning_rate > 0 and np.isfinite(options.learning_rate)):
        raise ValueError(f"--learning-rate must be a positive number, got {options.learning_rate}")
    if options.method == "lm":
        return None
    import optax

    return {"adam": optax.adam, "sgd": optax.sgd}[options.method](options.learning_rate)


class _progress:  # noqa: N801 - used like a function
    """Progress bar as a callback."""

    def __init__(self, limit: int, quiet: bool) -> None:
        from tqdm import tqdm

        self._bar = tqdm(total=limit, disable=quiet, unit="step", desc="compiling")

    def __enter__(self) -> Callable[[int, int, float], None]:
        return self._step

    def _step(self, done: int, limit: int, cost: float) -> None:
        self._bar.set_description(f"cost {cost:.4g}", refresh=False)
        self._bar.update(done - self._bar.n)

    def __exit__(self, *error: object) -> None:
        self._bar.close()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m training.fit", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", required=True, help="FILE.py, FILE.py:FUNCTION or MODULE:FUNCTION")
    parser.add_argument("--data", required=True, help="trajectories, .npz or .csv")
    parser.add_argument("--parameter", action="append", required=True, help="NAME[=START[:LOWER:UPPER]]; repeat")
    parser.add_argument(
        "--start", choices=("free", "recorded", "model"), default="free", help="where simulations begin"
    )
    parser.add_argument("--method", choices=("lm", "adam", "sgd"), default="lm", help="Levenberg-Marquardt or optax")
    parser.add_argument("--learning-rate", type=float, default=0.02, help="of adam and sgd (default 0.02)")
    parser.add_argument("--steps", type=int, default=100, help="most steps (default 100)")
    parser.add_argument("--starts", type=int, default=1, help="starts side by side; all but the first random")
    parser.add_argument("--seed", type=int, default=0, help="of the random starts")
    parser.add_argument("--substeps", type=int, default=1, help="steps of the engine between two frames")
    parser.add_argument("--segments", type=int, default=1, help="of multiple shooting")
    parser.add_argument("--horizons", type=float, nargs="+", default=[1.0], help="shares of the frames, the last one 1")
    parser.add_argument("--huber", type=float, help="standard deviations beyond which residuals count linearly")
    parser.add_argument("--position-noise", type=float, default=1e-3, help="[m] (default 0.001)")
    parser.add_argument("--orientation-noise", type=float, default=1.0, help="[degree] (default 1)")
    parser.add_argument("--damping", type=float, default=0.0, help="of the motion of all bodies [1/s] (default 0)")
    parser.add_argument("--output", type=Path, metavar="FOLDER", help="default: a new folder under runs/")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


if __name__ == "__main__":
    sys.exit(main())
