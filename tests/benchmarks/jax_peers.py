"""The scenes in other JAX engines, where they are installed: MJX (MuJoCo in JAX) and Brax's spring pipeline."""

from __future__ import annotations

import importlib.util
import warnings
from typing import Any

import jax
import jax.numpy as jnp

from tests.benchmarks import mujoco_peer, scenes
from tests.benchmarks.batched import BatchedScene
from tests.benchmarks.settings import TIME_STEP
from tests.benchmarks.timing import Contestant

MJX_BATCH = 256
MJX_ROUNDS = 5
BRAX_BATCH = 512
MJX_VARIANT = {"solver": "Newton", "cone": "pyramidal", "iterations": 10}
BOUNCE_FREQUENCY = 50.0


def missing() -> dict[str, str]:
    """Engines that can not take part, and why."""
    needed = {"MJX": ("mujoco.mjx", "mujoco-mjx"), "Brax": ("brax", "brax")}
    return {
        name: f"not installed (pip install {package})"
        for name, (module, package) in needed.items()
        if not _found(module)
    }


def _found(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def slide_contestants() -> dict[str, Contestant]:
    """The sliding cube in every engine that is installed."""
    found = {}
    if "MJX" not in missing():
        worlds = _mjx(mujoco_peer.slide_xml(TIME_STEP, **MJX_VARIANT), "slide", MJX_BATCH)
        found["MJX"] = _slide(worlds, {"batch": MJX_BATCH, **MJX_VARIANT}, MJX_ROUNDS)
    if "Brax" not in missing():
        worlds = _brax(mujoco_peer.slide_xml(TIME_STEP, **MJX_VARIANT), "slide", BRAX_BATCH)
        found["Brax spring"] = _slide(worlds, {"batch": BRAX_BATCH}, None)
    return found


def bounce_contestants() -> dict[str, Contestant]:
    """The bouncing sphere in every engine that is installed."""
    found = {}
    xml = mujoco_peer.bounce_xml(TIME_STEP, BOUNCE_FREQUENCY)
    if "MJX" not in missing():
        worlds = _mjx(xml, "bounce", MJX_BATCH)
        found["MJX"] = _bounce(worlds, {"batch": MJX_BATCH, "contact frequency": BOUNCE_FREQUENCY}, MJX_ROUNDS)
    if "Brax" not in missing():
        worlds = _brax(xml, "bounce", BRAX_BATCH)
        found["Brax spring"] = _bounce(worlds, {"batch": BRAX_BATCH}, None)
    return found


def _slide(worlds: BatchedScene, settings: dict, rounds: int | None) -> Contestant:
    speeds = scenes.spread(scenes.SLIDE_SPEEDS, worlds.count)
    track = worlds.track(scenes.step_count(scenes.SLIDE_SECONDS, TIME_STEP))
    error = scenes.slide_errors(speeds, track[-1] - track[0], TIME_STEP)
    return Contestant(worlds.block(scenes.SLIDE_TIMED_STEPS), {"dt": TIME_STEP, **settings}, error, rounds)


def _bounce(worlds: BatchedScene, settings: dict, rounds: int | None) -> Contestant:
    gaps = scenes.spread(scenes.BOUNCE_GAPS, worlds.count)
    track = worlds.track(scenes.step_count(scenes.BOUNCE_SECONDS, TIME_STEP))
    error = scenes.bounce_errors(gaps, scenes.first_apex(track))
    return Contestant(worlds.block(scenes.BOUNCE_TIMED_STEPS), {"dt": TIME_STEP, **settings}, error, rounds)


def _starts(scene: str, count: int) -> tuple[jax.Array, jax.Array]:
    """Positions (world, 7) and velocities (world, 6) in MuJoCo's coordinates."""
    position = jnp.tile(jnp.array([0, 0, scenes.SLIDE_HALF_EXTENT, 1, 0, 0, 0], jnp.float32), (count, 1))
    velocity = jnp.zeros((count, 6), jnp.float32)
    if scene == "slide":
        return position, velocity.at[:, 0].set(scenes.spread(scenes.SLIDE_SPEEDS, count))
    return position.at[:, 2].set(scenes.BOUNCE_RADIUS + scenes.spread(scenes.BOUNCE_GAPS, count)), velocity


def _coordinate(scene: str) -> tuple[int, float]:
    return (0, 0.0) if scene == "slide" else (2, scenes.BOUNCE_RADIUS)


def _mjx(xml: str, scene: str, count: int) -> BatchedScene:
    import mujoco
    from mujoco import mjx

    model = mujoco.MjModel.from_xml_string(xml)
    parameters, data = mjx.put_model(model), mjx.put_data(model, mujoco.MjData(model))
    states = jax.vmap(lambda q, v: data.replace(qpos=q, qvel=v))(*_starts(scene, count))
    index, origin = _coordinate(scene)
    step = jax.vmap(mjx.step, (None, 0))
    return BatchedScene(parameters, states, step, lambda states: states.qpos[:, index] - origin, count)


def _brax(xml: str, scene: str, count: int) -> BatchedScene:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from brax.io import mjcf
        from brax.spring import pipeline

        system = mjcf.loads(xml)
    if scene == "bounce":
        system = system.replace(elasticity=jnp.full_like(system.elasticity, scenes.BOUNCE_RESTITUTION))
    states = jax.vmap(lambda q, v: pipeline.init(system, q, v))(*_starts(scene, count))
    index, origin = _coordinate(scene)

    def step(system: Any, states: Any) -> Any:
        return jax.vmap(lambda state: pipeline.step(system, state, jnp.zeros(0)))(states)

    return BatchedScene(system, states, step, lambda states: states.q[:, index] - origin, count)
