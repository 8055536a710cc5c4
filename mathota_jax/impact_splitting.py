"""A step split at its impacts: forces act before and after each (`Options.impact_events`)."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.bodies import Bodies, merge, moving, moving_inertia, unpack
from mathota_jax.constraints import collisions, contact, joint_layout
from mathota_jax.constraints.lever import levers
from mathota_jax.constraints.problem import constrain, last_impulses, starting_impulses
from mathota_jax.dynamics.flight import Flight, flight, with_static
from mathota_jax.dynamics.impact_times import FirstImpact, first_impact
from mathota_jax.dynamics.integrate import advance
from mathota_jax.model import Model
from mathota_jax.outcome import forces, new_state
from mathota_jax.phases import correct_positions, external, free_velocities, gravity, let_rest, solve_rows
from mathota_jax.scene import Scene
from mathota_jax.spatial.indexing import in_every_world, take
from mathota_jax.spatial.quaternion import Quaternion, multiply
from mathota_jax.spatial.settle import compute_once, materialize
from mathota_jax.spatial.vector import cross
from mathota_jax.state import State


class _Progress(NamedTuple):
    """How far a step with impacts has come: the state, the time left, whether it ended, and the forces so far.

    The forces are those that the scene has (`_forces_of`), means over the whole step.
    """

    state: State
    left: Array
    ended: Array
    forces: list[Array]


def split_at_impacts(model: Model, state: State, action: Array) -> State:
    """The phases of a step, split at its first impacts; what follows the last of them is an ordinary step."""
    count = model.scene.options.impact_events
    worlds = max(leaf.shape[-1] for leaf in jax.tree.leaves((model, state, action)))
    state = in_every_world(state, worlds)
    begin = _Progress(
        state,
        jnp.broadcast_to(model.dt, (worlds,)),
        jnp.zeros(worlds, bool),
        [jnp.zeros_like(getattr(state, name)) for name in _forces_of(model.scene)],
    )

    def part(progress: _Progress, index: Array) -> tuple[_Progress, None]:
        new = lax.cond(
            progress.ended.all(),
            lambda progress: progress,
            lambda progress: _until_impact(model, progress, action, index == count),
            progress,
        )
        return new, None

    end = lax.scan(part, begin, jnp.arange(count + 1))[0]
    return dataclasses.replace(
        end.state,
        **dict(zip(_forces_of(model.scene), end.forces, strict=True)),
        applied_force=jnp.zeros_like(state.applied_force),
        applied_torque=jnp.zeros_like(state.applied_torque),
    )


def _forces_of(scene: Scene) -> list[str]:
    """Names of the forces in a state that a scene has."""
    return ["contact_force", "joint_force"] if joint_layout.joint_row_count(scene) else ["contact_force"]


def _until_impact(whole: Model, progress: _Progress, action: Array, last: Array) -> _Progress:
    """The step up to the next impact and the impact itself, or to its end; worlds that have ended stay."""
    scene, state = whole.scene, progress.state
    left = jnp.where(progress.ended, whole.dt, progress.left)
    model = dataclasses.replace(whole, dt=left)
    bodies = materialize(unpack(state))
    blocks = moving(scene, bodies)
    inertia = compute_once(moving_inertia(scene, model, blocks.orientation), state.position)
    force, torque = external(model, state, bodies, action)
    free, decay = compute_once(free_velocities(model, blocks, inertia, None, force, torque), state.position)
    problem = constrain(model, bodies, blocks, inertia, free, None, gravity(model), action)
    packed = contact.pack_motion(scene, *free)
    now = contact.pack_motion(scene, blocks.velocity, blocks.angular_velocity)
    foreseen, bounces = collisions.foreseen(whole, problem, bodies, now, packed, gravity(model), left)
    split = bounces & ~last & ~progress.ended
    # Rows would hold together what has just rebounded and is still near.
    counting = [collisions.corrected(*one, split) for one in zip(problem.contact_rows, foreseen, strict=True)]
    problem = problem._replace(contact_rows=[group for group, _ in counting])
    dropped = [none for _, none in counting]
    carried = last_impulses(model, state, problem)
    problem = let_rest(model, problem, carried, whole.dt)
    start, _ = starting_impulses(model, state, problem, carried, inertia, packed)
    joint_count = len(problem.joint_rows)
    start = start[:joint_count] + tuple(
        jnp.where(none, 0.0, impulse) for impulse, none in zip(start[joint_count:], dropped, strict=True)
    )
    solved, impulses, failed, *_ = solve_rows(scene, problem, inertia, packed, start)
    lever, beyond = levers(scene, left, problem.joint_rows, problem.contact_rows, impulses, packed, solved)
    moved, displacement = advance(blocks, inertia, inertia, None, free, torque, decay, solved, lever, left, beyond)
    path = flight(blocks, inertia, free, torque, decay, solved, left)
    nobody = jnp.zeros((scene.body_count, *left.shape), left.dtype)
    quiet = FirstImpact(left, jnp.zeros_like(split), nobody)
    assert problem.contacts is not None
    gaps = problem.contacts.separation
    impact = lax.cond(
        split.any(),
        lambda path: first_impact(whole, with_static(scene, bodies, path), gaps, gravity(whole), left, split),
        lambda path: quiet,
        path,
    )
    delay = take(impact.delay, scene.dynamic_bodies)
    moved, displacement = jax.tree.map(
        lambda split, whole: jnp.where(impact.happens, split, whole),
        path.at(impact.time + delay),
        (moved, displacement),
    )
    moved, displacement = compute_once((moved, displacement), state.position)
    moved = correct_positions(model, problem, bodies, inertia, moved, displacement)
    kept = forces(model, problem, impulses)
    share = impact.time / whole.dt
    means = [kept[name] * share for name in _forces_of(scene)]
    collision = lax.cond(
        impact.happens.any(),
        lambda moved: collisions.collide(whole, merge(scene, bodies, moved), moved, impact.happens, gravity(whole)),
        lambda moved: collisions.nothing(scene, moved, means),
        moved,
    )
    moved = _back(path, collision.moved, delay)
    if failed is not None and collision.failed is not None:
        failed = jnp.maximum(failed, collision.failed)
    new = new_state(scene, state, moved, kept, failed)
    new = dataclasses.replace(new, applied_force=state.applied_force, applied_torque=state.applied_torque)
    total = [old + mean + more for old, mean, more in zip(progress.forces, means, collision.forces, strict=True)]
    after = _Progress(new, left - impact.time, progress.ended | ~impact.happens, total)
    return jax.tree.map(lambda old, new: jnp.where(progress.ended, old, new), progress, after)


def _back(path: Flight, moved: Bodies, delay: Array) -> Bodies:
    """The bodies as they would be now, had they met something after a `delay` (body, world) that is 0: its derivative."""
    inertia = path.inertia if path.inertia.rotation is None else path.inertia.at(moved.orientation)
    spin = moved.angular_velocity
    turning = inertia.solve(path.torque - cross(spin, inertia.apply(spin)))
    half = spin * (-0.5 * delay)
    turned = multiply(Quaternion(jnp.zeros_like(half.x), *half), moved.orientation)
    return Bodies(
        moved.position - moved.velocity * delay,
        Quaternion(*(now + change for now, change in zip(moved.orientation, turned, strict=True))),
        moved.velocity - path.acceleration * delay,
        spin - turning * delay,
    )
