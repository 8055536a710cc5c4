"""Train a policy on an environment: ``python -m training.train --env mathota/InvertedPendulum-v0``.

Writes the policy, ``metrics.json``, a learning curve (PNG) and a replay (HTML) to
``runs/<environment>-<backend>-<time>/``.
"""

import argparse
import json
import math
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mathota_envs import make
from mathota_envs.registration import registered_id
from mathota_jax import Model, State, contact_forces, contacts
from training.evaluate import Evaluation, Evaluator
from training.policies import save_policy
from training.presets import Hyperparameters, preset, require_whole_number
from training.requirements import REQUIRED_PACKAGES, MissingExtraError, require_packages
from training.run_folder import CURVE_FILE, METRICS_FILE, REPLAY_FILE, create_run_folder
from training.short_horizon_presets import ShortHorizonHyperparameters, short_horizon_preset

BACKENDS = {"sb3": "PPO (sb3)", "jax": "PPO (jax)", "gradient": "short-horizon actor-critic"}
"""What trains, and how its learning curve is labelled."""


@dataclass(frozen=True)
class Request:
    """What to train.

    Attributes:
        environment_id: For example ``mathota/InvertedPendulum-v0``.
        backend: ``sb3`` (PPO of stable-baselines3), ``jax`` (PPO on the device) or ``gradient`` (short-horizon actor-critic:
            the gradient of the simulated return).
        worlds: Worlds side by side; None takes the preset's.
        steps: World-steps, all worlds together, rounded up to whole rollouts; None takes the preset's.
        seed: Of everything random, in [0, 2**31).
        output: Folder to write to; None makes a new one under ``runs/``.
        evaluation_episodes: Episodes of each evaluation.
        target_return: Stop when an evaluation's mean return reaches this.
    """

    environment_id: str
    backend: str = "sb3"
    worlds: int | None = None
    steps: int | None = None
    seed: int = 0
    output: Path | None = None
    evaluation_episodes: int = 20
    target_return: float | None = None

    def __post_init__(self) -> None:
        if self.backend not in BACKENDS:
            raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {self.backend!r}")
        for name in ("worlds", "steps"):
            if getattr(self, name) is not None:
                require_whole_number(name, getattr(self, name), minimum=1)
        require_whole_number("evaluation_episodes", self.evaluation_episodes, minimum=1)
        require_whole_number("seed", self.seed, minimum=0)
        if self.seed >= 2**31:
            raise ValueError(f"seed must be less than 2**31, got {self.seed}")
        if self.target_return is not None and not math.isfinite(self.target_return):
            raise ValueError(f"target_return must be finite, got {self.target_return}")

    def hyperparameters(self) -> Hyperparameters | ShortHorizonHyperparameters:
        """The preset with the worlds and steps that were asked for."""
        asked = {name: getattr(self, name) for name in ("worlds", "steps") if getattr(self, name) is not None}
        environment_id = registered_id(self.environment_id)
        if self.backend == "gradient":
            return replace(short_horizon_preset(environment_id), **asked)
        return replace(preset(environment_id, self.backend), **asked)


@dataclass(frozen=True)
class Result:
    """What a run produced.

    Attributes:
        folder: Where the files are.
        evaluation: Of the final policy, on starts that no earlier evaluation used.
        metrics: What ``metrics.json`` holds.
    """

    folder: Path
    evaluation: Evaluation
    metrics: dict[str, Any]


@dataclass(frozen=True)
class Plan:
    """A request that was checked and can start.

    Attributes:
        request: What was asked for.
        environment: The functional environment.
        hyperparameters: The preset, changed as asked.
        folder: Where the files will be.
    """

    request: Request
    environment: Any
    hyperparameters: Hyperparameters | ShortHorizonHyperparameters
    folder: Path


def prepare(request: Request) -> Plan:
    """Check everything that can be wrong before the slow part begins.

    Raises:
        ValueError: If the environment is unknown or the folder cannot be used.
        MissingExtraError: (an ``ImportError``) If a package of the extra ``train`` is missing.
    """
    require_packages(REQUIRED_PACKAGES[request.backend], f"training with backend {request.backend!r}")
    environment = make(request.environment_id)
    name = f"{request.environment_id.rpartition('/')[2]}-{request.backend}"
    folder = create_run_folder(name, METRICS_FILE, request.output)
    return Plan(request, environment, request.hyperparameters(), folder)


def train(plan: Plan) -> Result:
    """Train, evaluate and write everything to the folder.

    Raises:
        FloatingPointError: If the training diverges.
    """
    from training.monitor import Monitor

    request, environment, hyperparameters = plan.request, plan.environment, plan.hyperparameters
    evaluator = Evaluator(environment, request.evaluation_episodes)
    planned_steps = hyperparameters.update_count * hyperparameters.rollout_length * hyperparameters.worlds
    print(
        f"training {request.environment_id}: backend {request.backend}, {hyperparameters.worlds} worlds, "
        f"at most {planned_steps} steps, on {jax.devices()[0].device_kind} (the first steps wait for the compiler)",
        flush=True,
    )
    monitor = Monitor(evaluator, planned_steps, request.seed, request.target_return)
    try:
        policy = _backend(request.backend)(
            environment, hyperparameters, request.seed, monitor.report, monitor.should_stop
        )
    finally:
        monitor.close()
    training_seconds = monitor.seconds
    evaluation = evaluator.run(policy.act, seed=monitor.next_seed(), record=True)
    metrics = {
        "environment": request.environment_id,
        "backend": request.backend,
        "seed": request.seed,
        "steps": monitor.steps,
        "training_seconds": training_seconds,
        "steps_per_second": monitor.steps / training_seconds,
        "target_return": request.target_return,
        "target_reached_in_training": monitor.target_reached,
        "evaluation": evaluation.summary(),
        "training_curve": monitor.curve,
        "training_evaluations": monitor.evaluations,
        "hyperparameters": hyperparameters.to_dictionary(),
        "machine": _machine(),
    }
    save_policy(policy, plan.folder, request.environment_id, request.backend)
    (plan.folder / METRICS_FILE).write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
    _save_pictures(plan, evaluation, metrics)
    return Result(plan.folder, evaluation, metrics)


def print_result(result: Result) -> None:
    """Say what was reached and where the outputs are."""
    print(
        f"trained {result.metrics['steps']} steps in {result.metrics['training_seconds']:.1f} s "
        f"({result.metrics['steps_per_second']:.0f} steps/s, compilation and evaluations included)"
    )
    if result.metrics["target_reached_in_training"]:
        print(f"stopped early: an evaluation reached the target {result.metrics['target_return']:g}")
    print(f"final evaluation: {result.evaluation}")
    print("outputs:")
    for path in sorted(result.folder.iterdir()):
        print(f"  {path}")


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m training.train", description="Train a policy on an environment of mathota_envs."
    )
    parser.add_argument("--env", required=True, metavar="ID", help="for example mathota/InvertedPendulum-v0")
    parser.add_argument("--worlds", type=int, metavar="N", help="worlds side by side (default: the preset's)")
    parser.add_argument("--steps", type=int, metavar="M", help="steps of all worlds together (default: the preset's)")
    parser.add_argument(
        "--backend",
        default="sb3",
        help="sb3: PPO of stable-baselines3 (default); jax: PPO, everything on the device; gradient: short-horizon "
        "actor-critic, which differentiates the simulation, on the device",
    )
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default 0)")
    parser.add_argument("--output", type=Path, metavar="FOLDER", help="default: a new folder under runs/")
    parser.add_argument("--eval-episodes", type=int, default=20, metavar="N", help="default 20")
    parser.add_argument("--target-return", type=float, metavar="X", help="stop early when an evaluation reaches it")
    options = parser.parse_args(arguments)
    started = time.perf_counter()
    try:
        request = Request(
            environment_id=options.env,
            backend=options.backend,
            worlds=options.worlds,
            steps=options.steps,
            seed=options.seed,
            output=options.output,
            evaluation_episodes=options.eval_episodes,
            target_return=options.target_return,
        )
        plan = prepare(request)
    except (ValueError, MissingExtraError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        result = train(plan)
    except FloatingPointError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print_result(result)
    print(f"finished in {time.perf_counter() - started:.1f} s")
    return 0


def _backend(name: str) -> Callable[..., Any]:
    if name == "sb3":
        from training.sb3_backend import train as train_with_sb3

        return train_with_sb3
    if name == "gradient":
        from training.short_horizon import train as train_by_gradient

        return train_by_gradient
    from training.ppo import train as train_on_device

    return train_on_device


def _save_pictures(plan: Plan, evaluation: Evaluation, metrics: dict[str, Any]) -> None:
    from training.plots import save_learning_curve
    from training.replay import write_replay

    name = plan.request.environment_id.rpartition("/")[2]
    final = {"steps": metrics["steps"], **evaluation.summary()}
    save_learning_curve(
        plan.folder / CURVE_FILE,
        metrics["training_curve"],
        [*metrics["training_evaluations"], final],
        f"{name}, {BACKENDS[plan.request.backend]}, {plan.hyperparameters.worlds} worlds",
        plan.request.target_return,
    )
    environment, states = plan.environment, evaluation.trajectory.state
    write_replay(
        plan.folder / REPLAY_FILE,
        environment.model,
        states,
        environment.dt,
        contacts=_contact_data(environment.model, states),
        title=f"{name}: return {evaluation.returns[0]:.1f}",
    )


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def _contact_data(model: Model, state: State) -> dict[str, jax.Array]:
    points = contacts(model, state)
    return {
        "position": points.position,
        "normal": points.normal,
        "separation": points.separation,
        "active": points.active,
        "force": contact_forces(model, state),
    }


def _machine() -> dict[str, Any]:
    device = jax.devices()[0]
    return {
        "platform": platform.platform(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
        "device": f"{device.platform}: {device.device_kind}",
    }


if __name__ == "__main__":
    sys.exit(main())
