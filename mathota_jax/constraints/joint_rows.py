"""Joint rows of a scene: joints of one group side by side, their rows one after the other."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.bodies import Bodies
from mathota_jax.constraints.assembly import Side, inner
from mathota_jax.constraints.joint_layout import JointGroup, joint_groups
from mathota_jax.constraints.joints.frames import JointFrames, joint_frames
from mathota_jax.constraints.joints.rows import (
    DRIVE,
    DRY,
    ELASTIC,
    HOLD,
    SERVO,
    VISCOUS,
    JointRow,
    Sides,
    free_row,
    lower_row,
    upper_row,
)
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.quaternion import exponential, multiply
from mathota_jax.spatial.settle import compute_once, settle, store_cotangents
from mathota_jax.spatial.vector import Vec3, cross, dot

BEYOND_STOP = 0.1
"""Angle [rad] by which a joint with one limit can be beyond it, and not before it by a full turn less."""

FOLLOWED_TURN = 1.0
"""Angle [rad] by which a body may turn in a step for its joints to follow all of its turning."""


class JointRows(NamedTuple):
    """All joint rows in slot order, components of shape (slot, world).

    Attributes:
      parent, child: Jacobians.
      error: what the law of each row acts on.
      rate: the Jacobian times the velocities.
      laws, angular: (slot,) law; whether the error is an angle.
    """

    parent: Side
    child: Side
    error: Array
    rate: Array
    laws: np.ndarray
    angular: np.ndarray


def joint_rows(model: Model, bodies: Bodies) -> JointRows:
    """Jacobians and errors of all joint rows at the poses of all bodies."""
    rows: list[JointRow] = []
    rates: list[Array] = []
    counts: list[int] = []
    angular: list[bool] = []
    motion = (bodies.velocity, bodies.angular_velocity)
    for group in joint_groups(model.scene):
        group_rows = rows_of(model, group, joint_frames(model, bodies, group.joints))
        parent_motion, child_motion = (
            Side(*store_cotangents(take(motion, group.members(model.scene, side)), for_one_reader=True))
            for side in ("parent", "child")
        )
        rates += [inner(row.parent, parent_motion) + inner(row.child, child_motion) for row in group_rows]
        rows += group_rows
        counts += [len(group.joints)] * len(group_rows)
        angular += [group.kind.coordinate is not None and group.kind.coordinate.angular] * len(group_rows)

    def side(name: str) -> Side:
        sides = [getattr(row, name) for row in rows]
        return Side(*(_stack_vectors([getattr(s, part) for s in sides], counts) for part in ("linear", "angular")))

    parent, child, error, rate = compute_once(
        (side("parent"), side("child"), stack_rows([row.error for row in rows], counts), stack_rows(rates, counts)),
        bodies.position.x,
    )
    return JointRows(
        parent=parent,
        child=child,
        error=error,
        rate=rate,
        laws=np.repeat([row.law for row in rows], counts),
        angular=np.repeat(angular, counts),
    )


def rows_of(model: Model, group: JointGroup, frames: JointFrames) -> list[JointRow]:
    """Rows of the joints of a group: those of their kind, then those of their features."""
    kind = group.kind
    rows = kind.fixed_rows(frames)
    limits = functools.partial(take, model.joint_limits, group.joints)
    for feature in group.features:
        if feature == "swing":
            assert kind.swing_row is not None
            rows.append(kind.swing_row(frames, take(model.joint_swing, group.joints)))
        elif feature in ("damping", "friction"):
            law = VISCOUS if feature == "damping" else DRY
            rows += [free_row(sides, law) for sides in kind.free_sides(frames)]
        else:
            rows.append(_coordinate_row(feature, group, frames, limits()))
    return rows


def _coordinate_row(feature: str, group: JointGroup, frames: JointFrames, limits: Array) -> JointRow:
    """Row of a feature that acts along the coordinate."""
    coordinate = group.kind.coordinate
    assert coordinate is not None
    sides, value = coordinate.sides(frames), coordinate.value(frames)
    if coordinate.angular and feature in ("lower", "upper", "locked"):
        value = _turned_into(value, limits)
    if feature == "lower":
        return lower_row(sides, value, limits[:, 0])
    if feature == "upper":
        return upper_row(sides, value, limits[:, 1])
    if feature == "locked":
        return JointRow(*sides, value - 0.5 * (limits[:, 0] + limits[:, 1]), HOLD)
    if feature == "velocity":
        return free_row(sides, DRIVE)
    return JointRow(*sides, value, {"spring": ELASTIC, "position": SERVO}[feature])


def _turned_into(angle: Array, limits: Array) -> Array:
    """The angle with the full turn that brings it closest to the middle of its limits.

    A stop at half a turn would else be passed by any round-off. Beside an open side, where an arm may come round, what is up
    to `BEYOND_STOP` beyond the limit counts as pressed into it.
    """
    lower, upper = limits[:, 0], limits[:, 1]
    turn = 2.0 * math.pi
    least = jnp.where(lower < -turn, upper - turn + 2.0 * BEYOND_STOP, lower)
    greatest = jnp.where(upper > turn, lower + turn - 2.0 * BEYOND_STOP, upper)
    middle = jax.lax.stop_gradient(0.5 * (least + greatest))
    return angle - turn * settle(jnp.round((angle - middle) / turn))


def stack_rows(values: list[Array], counts: list[int]) -> Array:
    """(slot, world) from the values of each row, (joint or 1, world or 1)."""
    worlds = max(value.shape[1] for value in values)
    return jnp.concatenate([jnp.broadcast_to(v, (count, worlds)) for v, count in zip(values, counts, strict=True)])


def _stack_vectors(values: list[Vec3], counts: list[int]) -> Vec3:
    return Vec3(*(stack_rows([value[axis] for value in values], counts) for axis in range(3)))


def moved_by(bodies: Bodies, time: Array) -> Bodies:
    """Where the bodies are after some time at their present velocities."""
    turn = store_cotangents(exponential(bodies.angular_velocity * time))
    orientation = store_cotangents(multiply(turn, bodies.orientation))
    return bodies._replace(position=bodies.position + bodies.velocity * time, orientation=orientation)


def turning(model: Model, bodies: Bodies, start: JointRows, middle: JointRows) -> Array:
    """What the turning of the Jacobians and of the inertia adds to the rates (slot, world) in half a step of `bodies`.

    The rate at the end of a step is that of its middle with this added. Without it a rotor on a turning carrier would take
    half of the change of its rate for none at all, whatever the step.

    Nothing where a body turns by more than a radian or so: the chord of so large a turn says nothing of where the step ends,
    and what it makes up in one step is energy for the next.
    """
    followed = []
    for group in joint_groups(model.scene):
        spins = (take(bodies.angular_velocity, group.members(model.scene, side)) for side in ("parent", "child"))
        most = functools.reduce(jnp.maximum, (dot(spin, spin) for spin in spins))
        share = jnp.clip(2.0 - most * (model.dt / FOLLOWED_TURN) ** 2, 0.0, 1.0)
        followed += [share] * group.row_count
    share = stack_rows(followed, [value.shape[0] for value in followed])
    return share * (middle.rate - start.rate)


def joint_coordinates(model: Model, bodies: Bodies) -> tuple[Array, Array]:
    """Value and rate (joint, world) of the coordinate of every joint, 0 for joints without."""
    scene = model.scene
    values: dict[int, Array] = {}
    rates: dict[int, Array] = {}
    for group in joint_groups(scene):
        frames = joint_frames(model, bodies, group.joints)
        coordinate = group.kind.coordinate
        value = rate = jnp.zeros_like(frames.offset.x)
        if coordinate is not None:
            value = coordinate.value(frames)
            rate = _rate(scene, group, bodies, coordinate.sides(frames))
        for place, joint in enumerate(group.joints):
            values[joint], rates[joint] = value[place], rate[place]
    order = range(len(scene.joints))
    return jnp.stack([values[j] for j in order]), jnp.stack([rates[j] for j in order])


def _rate(scene: Scene, group: JointGroup, bodies: Bodies, sides: Sides) -> Array:
    motion = (bodies.velocity, bodies.angular_velocity)
    parts = [
        inner(side, Side(*take(motion, group.members(scene, name))))
        for side, name in zip(sides, ("parent", "child"), strict=True)
    ]
    return parts[0] + parts[1]


def reactions(model: Model, bodies: Bodies, row_force: Array) -> tuple[Vec3, Vec3]:
    """Force on the child of each joint and its torque about the child's anchor, components (joint, world).

    Args:
      model: parameters.
      bodies: at the poses at which the rows act.
      row_force: (slot, world) generalized force of each row.
    """
    found: dict[int, tuple[Vec3, Vec3]] = {}
    for group in joint_groups(model.scene):
        frames = joint_frames(model, bodies, group.joints)
        force = torque = frames.offset * 0.0
        for row, entry in enumerate(rows_of(model, group, frames)):
            size = row_force[group.slots(row)]
            assert entry.child.angular is not None
            force = force + entry.child.linear * size
            torque = torque + (entry.child.angular - cross(frames.arm_child, entry.child.linear)) * size
        for place, joint in enumerate(group.joints):
            found[joint] = tuple(v.map(lambda x, place=place: x[place]) for v in (force, torque))  # type: ignore[assignment]
    order = range(len(model.scene.joints))
    return tuple(  # type: ignore[return-value]
        Vec3(*(jnp.stack([found[j][part][axis] for j in order]) for axis in range(3))) for part in range(2)
    )
