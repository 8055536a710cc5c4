"""The environments by id. Registering one here is all that Gymnasium, the wrappers and the tests need."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium

from mathota_envs.ball_balance import BallBalance
from mathota_envs.base import Environment
from mathota_envs.inverted_pendulum import InvertedPendulum

ENVIRONMENTS: dict[str, type[Environment]] = {
    "mathota/InvertedPendulum-v0": InvertedPendulum,
    "mathota/BallBalance-v0": BallBalance,
}


def make(id: str, **options: Any) -> Environment:
    """Makes a functional environment.

    Args:
        id: one of `ENVIRONMENTS`, for example ``"mathota/BallBalance-v0"``; a prefix ``"mathota_envs:"``, as
            `gymnasium.make` takes it, is allowed.
        **options: fields of the environment's class, for example ``max_episode_steps``.

    Raises:
        ValueError: the id or an option is unknown, or an option has an impossible value.
    """
    environment_class = ENVIRONMENTS.get(registered_id(id)) if isinstance(id, str) else None
    if environment_class is None:
        raise ValueError(f"unknown environment {id!r}; known environments: {', '.join(ENVIRONMENTS)}")
    valid = option_names(environment_class)
    for name in options:
        if name not in valid:
            raise ValueError(f"{id}: unknown option {name!r}; valid options: {', '.join(valid)}")
    return environment_class(**options)


def registered_id(id: str) -> str:
    """The id without the name of the package, which `gymnasium.make` imports."""
    return id.removeprefix("mathota_envs:")


def option_names(environment_class: type[Environment]) -> list[str]:
    """Names of the options of an environment."""
    return [field.name for field in dataclasses.fields(environment_class) if field.init]


def resolve(environment: Any, options: dict[str, Any]) -> Any:
    """The functional environment that a wrapper was given, itself or by its id.

    Raises:
        ValueError: as `make`, or options were given for an environment that is already made.
    """
    if isinstance(environment, str):
        return make(environment, **options)
    if options:
        raise ValueError(
            f"unknown argument {next(iter(options))!r}: an environment that is already made takes no options"
        )
    return environment


def register_environments() -> None:
    """Registers all `ENVIRONMENTS` with Gymnasium. Importing `mathota_envs` does it.

    `gymnasium.make` adds its `TimeLimit`, so the single environments it makes have no limit of their own; the vector
    environments get the limit as an option. Each episode is thus counted once.
    """
    for id, environment_class in ENVIRONMENTS.items():
        gymnasium.register(
            id,
            entry_point="mathota_envs.gym_env:make_without_time_limit",
            vector_entry_point="mathota_envs.vector_env:GymVectorEnv",
            max_episode_steps=environment_class.max_episode_steps,
            kwargs={"environment": id},
        )
