"""The scenes in mathota_jax."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mathota_jax import Hinge, Options, SceneBuilder, Sphere
from tests.benchmarks.hard_cases import TIERS
from tests.benchmarks.ours import batched_step, repeat
from tests.benchmarks.work_precision.jax_program import JaxProgram
from tests.benchmarks.work_precision.scenes import DOUBLE, OURS, TIGHT, TIGHT_QUICK, Scene, start_of
from tests.benchmarks.work_precision.worlds import Motion, World

SETTINGS = {**TIERS, "pgs, 30 sweeps": {"velocity_iterations": 30}, "pgs, split at impacts": {"impact_events": 2}}
ROOM: dict[str, dict] = {TIGHT: {}, TIGHT_QUICK: {"velocity_iterations": 6}}
DT = 1 / 240


def build(world: World, options: Options) -> tuple[Any, Any]:
    """Model and state of one world; the moving bodies come last."""
    builder = SceneBuilder(gravity=world.gravity)
    if world.anchors:
        parent = builder.add_body(Sphere(0.02), static=True, collides=False)
    anchors = iter(world.anchors)
    for body in world.bodies:
        fixed = body.mass is None
        motion = (
            {} if fixed else {"velocity": body.velocity, "angular_velocity": body.angular_velocity, "mass": body.mass}
        )
        index = builder.add_body(
            body.shape, static=fixed, position=body.position, orientation=body.orientation, friction=body.friction,
            restitution=body.restitution, collides=body.collides, **motion,
        )  # fmt: skip
        if world.anchors and not fixed:
            builder.add_joint(Hinge(parent=parent, child=index, anchor=next(anchors), axis=(0, 0, 1)))
            parent = index
    return builder.build(options)


def undamped(scene: Scene, setting: str) -> Options:
    """Options of a setting for a scene, without damping, which no truth contains."""
    if setting in ROOM:
        changes = {"pair_capacity": scene.capacity, **ROOM[setting]}
    else:
        changes = SETTINGS[OURS[0] if setting == DOUBLE else setting]
    return Options(dt=DT, linear_damping=0.0, angular_damping=0.0, **changes)


def program(scene: Scene, setting: str, count: int) -> JaxProgram:
    """The scene in `count` worlds."""
    return of_options(scene, undamped(scene, setting), count, setting == DOUBLE)


def of_options(scene: Scene, options: Options, count: int, double: bool = False) -> JaxProgram:
    """The scene with other options than those of a setting."""
    with jax.enable_x64(double):
        return _program(scene, options, count, double)


def _program(scene: Scene, options: Options, count: int, double: bool) -> JaxProgram:
    model, state = build(scene.world, options)
    static = len(state.position) - len(scene.world.moving)
    start = start_of(scene.name, count)
    states = repeat(state, count)
    leaves = {field.name: getattr(start, field.name) for field in dataclasses.fields(Motion)}
    states = dataclasses.replace(
        states,
        **{name: getattr(states, name).at[:, static:].set(jnp.asarray(values)) for name, values in leaves.items()},
    )

    def motion(states: Any, worlds: int) -> Motion:
        return Motion(*(np.asarray(getattr(states, name)[:worlds, static:], float) for name in leaves))

    def parameters(dt: float) -> Any:
        return dataclasses.replace(model, dt=jnp.full_like(model.dt, dt))

    return JaxProgram(parameters, states, batched_step, motion, count, double)
