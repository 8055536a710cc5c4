"""The state at the end of a step, from moved bodies and solved impulses."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jax import Array

from mathota_jax.bodies import Bodies, place
from mathota_jax.constraints import compact_matching, joint_layout, loops
from mathota_jax.constraints.assembly import collect
from mathota_jax.constraints.contact import ContactRows
from mathota_jax.constraints.contact_force import slot_force
from mathota_jax.constraints.decoupling import Decoupling
from mathota_jax.constraints.mechanism_layout import layout
from mathota_jax.constraints.mechanism_links import Impulses, to_slots
from mathota_jax.constraints.problem import Problem
from mathota_jax.constraints.substep_rows import substep_length
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.spread import add_all_slices, add_slices
from mathota_jax.state import EndForces, Flag, State

DEEP = 0.5
"""Overlap from which on it is deep, as a share of the inner radius of the smaller moving body: of half as much, the shortest
way out is soon through the other side. Cubes that rest on each other, ten with the defaults, overlap by 0.01 of it."""


def new_state(scene: Scene, state: State, moved: Bodies, kept: dict[str, Array], failed: Array | None = None) -> State:
    """The new state with its flags.

    Args:
      scene: static structure.
      state: before the step.
      moved: the moving bodies after it.
      kept: what `forces` gives.
      failed: (world,) 1 where the constraints were not solved; None if that can not be.
    """
    moved = compute_once(moved, moved.position.x)
    position, orientation, velocity, angular_velocity = (
        place(scene, getattr(state, name), getattr(moved, name))
        for name in ("position", "orientation", "velocity", "angular_velocity")
    )
    broken = jnp.where(_finite((position, orientation, velocity, angular_velocity)), 0, int(Flag.NON_FINITE))
    if failed is not None:
        broken = broken | jnp.where(failed > 0, int(Flag.SOLVER_NOT_CONVERGED), 0)
    changes: dict[str, Any] = {
        "position": position,
        "orientation": orientation,
        "velocity": velocity,
        "angular_velocity": angular_velocity,
        "applied_force": jnp.zeros_like(state.applied_force),
        "applied_torque": jnp.zeros_like(state.applied_torque),
        "flags": state.flags | broken.astype(state.flags.dtype),
    }
    if "flags" in kept:
        kept = {**kept, "flags": changes["flags"] | kept["flags"].astype(state.flags.dtype)}
    return dataclasses.replace(state, **{**changes, **kept})


def _finite(values: Sequence[Array]) -> Array:
    """(world,) whether all (body, component, world) are finite.

    Zero times anything else is NaN, and a sum of slices runs side by side for all worlds; a reduction does not.
    """
    return jnp.isfinite(add_all_slices(functools.reduce(jnp.add, [add_slices(value * 0.0, 1) for value in values])))


def forces(model: Model, problem: Problem, impulses: tuple[Array, ...]) -> dict[str, Array]:
    """Mean forces over the step and what they belong to, in the form in which the state keeps them; new flags."""
    scene = model.scene
    changes = _mean_forces(scene, problem, impulses, model.dt)
    flags: list[Array] = []
    if problem.joints is not None and (open_loops := loops.are_open(model, problem.joints)) is not None:
        flags.append(jnp.where(open_loops, int(Flag.OPEN_LOOP), 0))
    if problem.contacts is not None:
        changes["contact_feature"] = jnp.where(problem.contacts.active, problem.contacts.feature, -1)
        if problem.offsets is not None:
            changes["contact_offset"] = jnp.stack(problem.offsets, axis=1)
        flags.append(_collision_flags(problem))
        if problem.close is not None:
            changes["contact_pair"] = compact_matching.pair_keys(scene, problem.close)
    return {**changes, "flags": functools.reduce(jnp.bitwise_or, flags)} if flags else changes


def closing_force(model: Model, closed: Impulses) -> Array:
    """Mean joint forces (slot, world) of what closes mechanisms at the end of a step, see `close_joints`.

    It turns the velocities with the joints, which those do that bear a swinging load: without it the tension of a pendulum
    was 3 % off at 1/60 s, and in proportion to the step. Sweeps in small steps leave more to it.
    """
    found = layout(model.scene)
    assert found is not None
    last = tuple(of_rounds[-1] for of_rounds in closed)
    return to_slots(found, last, joint_layout.joint_row_count(model.scene)) / model.dt


def end_forces(model: Model, problem: Problem, before: EndForces, impulses: tuple[Array, ...]) -> EndForces:
    """Mean forces over the last substep, from its impulses."""
    time = substep_length(model)
    found = _mean_forces(model.scene, problem, impulses, time)
    return dataclasses.replace(before, time=time + jnp.zeros_like(before.time), **found)


def _mean_forces(scene: Scene, problem: Problem, impulses: tuple[Array, ...], time: Array) -> dict[str, Array]:
    """Of joints and contacts, where there are any."""
    found, count = {}, len(problem.joint_rows)
    if problem.joints is not None:
        tables = [rows.table for rows in problem.joint_rows]
        values = [
            _original(impulse[:, 0], decoupling) / time
            for impulse, decoupling in zip(impulses[:count], problem.of_joint_rows, strict=True)
        ]
        found["joint_force"] = collect(tables, values, joint_layout.joint_row_count(scene))
    if problem.contacts is not None:
        found["contact_force"] = slot_force(problem.contact_rows, list(impulses[count:]), scene.slot_count, time)
    return found


def _original(impulse: Array, decoupling: Decoupling | None) -> Array:
    """Impulses (turn, column, world) of the rows as the joints have them."""
    if decoupling is None:
        return impulse
    return decoupling.original_impulses(impulse.reshape(-1, impulse.shape[-1])).reshape(impulse.shape)


def _collision_flags(problem: Problem) -> Array:
    """Bits (world,) for what the collision phases could not do, and for what they found that should not be."""
    assert problem.contacts is not None
    flags = jnp.where(_overlap_deeply(problem.contact_rows), int(Flag.DEEP_OVERLAP), 0)
    if problem.contacts.converged is not None:
        failed = (problem.contacts.active & ~problem.contacts.converged).any(0)
        flags = flags | jnp.where(failed, int(Flag.NOT_CONVERGED), 0)
    if problem.overflow is not None:
        flags = flags | jnp.where(problem.overflow, int(Flag.CONTACT_OVERFLOW), 0)
    return flags


def _overlap_deeply(groups: Sequence[ContactRows]) -> Array:
    """(world,) whether any contact is deeper than `DEEP`."""
    found = [add_all_slices(jnp.where(group.separation < -DEEP * group.size, 1.0, 0.0)) for group in groups]
    return functools.reduce(jnp.add, found) > 0
