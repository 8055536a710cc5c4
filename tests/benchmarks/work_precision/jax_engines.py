"""The scenes in other JAX engines, where they are installed: MJX (MuJoCo in JAX) and Brax's spring pipeline.

Both read MuJoCo's default profile; MJX with ten iterations of its Newton solver, Brax with its own contacts.
"""

from __future__ import annotations

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tests.benchmarks import jax_peers, mujoco_peer
from tests.benchmarks import scenes as closed_forms
from tests.benchmarks.work_precision import mujoco_engine
from tests.benchmarks.work_precision.jax_program import JaxProgram
from tests.benchmarks.work_precision.scenes import Scene, start_of
from tests.benchmarks.work_precision.worlds import Motion
from tests.scenes import rotation_matrix

DT = 1 / 240
BATCHES = {"MJX": jax_peers.MJX_BATCH, "Brax spring": jax_peers.BRAX_BATCH}
MJX_ITERATIONS = 10


def missing() -> dict[str, str]:
    """Engines that can not take part, and why."""
    absent = jax_peers.missing()
    if reason := mujoco_peer.missing():
        absent = {"MJX": reason, "Brax": reason}
    return {"Brax spring" if name == "Brax" else name: reason for name, reason in absent.items()}


def program(name: str, scene: Scene, count: int | None = None) -> JaxProgram:
    """The scene of free bodies in one of the engines, in as many worlds as suit it, or `count`."""
    return {"MJX": _mjx, "Brax spring": _brax}[name](scene, count or BATCHES[name])


def _coordinates(scene: Scene, count: int) -> tuple[jax.Array, jax.Array]:
    """Positions (world, 7 bodies) and velocities (world, 6 bodies), angular velocities in the body frame."""
    start = start_of(scene.name, count)
    spin = np.einsum("...ji,...j->...i", rotation_matrix(start.orientation), start.angular_velocity)
    position = np.concatenate([start.position, start.orientation], axis=-1).reshape(count, -1)
    velocity = np.concatenate([start.velocity, spin], axis=-1).reshape(count, -1)
    return jnp.asarray(position, jnp.float32), jnp.asarray(velocity, jnp.float32)


def _motion(position: Any, velocity: Any, worlds: int) -> Motion:
    position = np.asarray(position[:worlds], float).reshape(worlds, -1, 7)
    linear, spin = np.moveaxis(np.asarray(velocity[:worlds], float).reshape(worlds, -1, 2, 3), 2, 0)
    orientation = position[..., 3:]
    return Motion(
        position[..., :3], orientation, linear, np.einsum("...ij,...j->...i", rotation_matrix(orientation), spin)
    )


def _mjx(scene: Scene, count: int) -> JaxProgram:
    import mujoco
    from mujoco import mjx

    compiled = mujoco.MjModel.from_xml_string(mujoco_engine.xml(scene, "default", DT))
    compiled.opt.iterations = MJX_ITERATIONS
    model, data = mjx.put_model(compiled), mjx.put_data(compiled, mujoco.MjData(compiled))
    states = jax.vmap(lambda q, v: data.replace(qpos=q, qvel=v))(*_coordinates(scene, count))
    return JaxProgram(
        lambda dt: model.replace(opt=model.opt.replace(timestep=jnp.full_like(model.opt.timestep, dt))),
        states,
        jax.vmap(mjx.step, (None, 0)),
        lambda states, worlds: _motion(states.qpos, states.qvel, worlds),
        count,
    )


def _brax(scene: Scene, count: int) -> JaxProgram:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from brax.io import mjcf
        from brax.spring import pipeline

        system = mjcf.loads(mujoco_engine.xml(scene, "default", DT))
    if any(body.restitution for body in scene.world.bodies):
        system = system.replace(elasticity=jnp.full_like(system.elasticity, closed_forms.BOUNCE_RESTITUTION))
    states = jax.vmap(lambda q, v: pipeline.init(system, q, v))(*_coordinates(scene, count))

    def step(system: Any, states: Any) -> Any:
        return jax.vmap(lambda state: pipeline.step(system, state, jnp.zeros(0)))(states)

    return JaxProgram(
        lambda dt: system.replace(opt=system.opt.replace(timestep=jnp.asarray(dt, jnp.float32))),
        states,
        step,
        lambda states, worlds: _motion(states.q, states.qd, worlds),
        count,
    )
