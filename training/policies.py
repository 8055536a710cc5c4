"""Save and load policies of either backend; ``policy.json`` beside the weights says which it is."""

import json
from pathlib import Path
from typing import Protocol

import numpy as np

DESCRIPTION_FILE = "policy.json"


class Policy(Protocol):
    """A deterministic policy."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        """``(world, observation) -> (world, action)``."""
        ...

    def save(self, directory: Path) -> None:
        """Write the weights to a folder."""
        ...


def save_policy(policy: Policy, directory: Path, environment_id: str, backend: str) -> None:
    """Write the policy and what is needed to load it again.

    Args:
        policy: Of either backend.
        directory: An existing folder.
        environment_id: The environment that it was trained on.
        backend: ``sb3``, ``jax`` or ``gradient``.
    """
    policy.save(directory)
    description = {"format": 1, "environment": environment_id, "backend": backend}
    (directory / DESCRIPTION_FILE).write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")


def load_policy(directory: Path | str) -> tuple[str, Policy]:
    """Read what :func:`save_policy` wrote.

    Returns:
        ``(environment id, policy)``.

    Raises:
        FileNotFoundError: If the folder holds no policy.
        ValueError: If the description cannot be understood.
        ImportError: If the backend's packages are not installed.
    """
    directory = Path(directory)
    path = directory / DESCRIPTION_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{directory} holds no {DESCRIPTION_FILE}: give a folder written by training.train")
    try:
        description = json.loads(path.read_text(encoding="utf-8"))
        environment_id, backend = description["environment"], description["backend"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error!r}; train again") from error
    if backend in ("jax", "gradient"):
        from training.jax_policy import JaxPolicy

        return environment_id, JaxPolicy.load(directory)
    if backend == "sb3":
        from training.requirements import REQUIRED_PACKAGES, require_packages

        require_packages(REQUIRED_PACKAGES["sb3"], "a policy of backend 'sb3'")
        from training.sb3_policy import SB3Policy

        return environment_id, SB3Policy.load(directory)
    raise ValueError(f"{path} names the unknown backend {backend!r}; known: 'gradient', 'jax', 'sb3'")
