"""Joint rows of a scene: joints of one kind side by side, their rows one after the other."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.bodies import Bodies, Inertia
from mathota_jax.constraints.assembly import (
    Side,
    inner,
    pack_scalars,
    pack_sides,
    push_out_speed,
    respond,
    select,
    select_blocks,
)
from mathota_jax.constraints.joints import JOINTS
from mathota_jax.constraints.joints.frames import JointFrames, JointRow, damping_row, joint_frames, limit_rows
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.solver.laws import Bounded
from mathota_jax.solver.pgs import Rows
from mathota_jax.solver.soft_step import PositionError
from mathota_jax.solver.table import Constraint, Table, make_tables
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.quaternion import exponential, multiply
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.vector import Vec3

LARGEST_DECAY = 30.0
"""Cap on damping * J M^-1 J^T * dt, beyond which the velocity left is below round-off of either precision."""


class JointGroup(NamedTuple):
    """Joints with the same rows."""

    kind: str
    limited: bool
    damped: bool
    joints: tuple[int, ...]

    @property
    def row_count(self) -> int:
        """Rows of each joint."""
        return JOINTS[self.kind].fixed_row_count + 2 * self.limited + self.damped


def joint_groups(scene: Scene) -> list[JointGroup]:
    """Groups in order of first appearance; row slots are numbered group, row, joint."""
    members: dict[tuple[str, bool, bool], list[int]] = {}
    for joint, entry in enumerate(scene.joints):
        members.setdefault((entry.kind, entry.limited, entry.damped), []).append(joint)
    return [JointGroup(*key, tuple(joints)) for key, joints in members.items()]


def joint_row_count(scene: Scene) -> int:
    """Number of joint rows of a scene."""
    return sum(group.row_count * len(group.joints) for group in joint_groups(scene))


def joint_tables(scene: Scene) -> tuple[Table, ...]:
    """Order in which the solver visits the joint rows."""
    block_of = {body: block for block, body in enumerate(scene.dynamic_bodies)}
    constraints, start = [], 0
    for group in joint_groups(scene):
        for place, joint in enumerate(group.joints):
            entry = scene.joints[joint]
            blocks = tuple(block_of[body] for body in (entry.parent, entry.child) if body in block_of)
            slots = tuple(start + row * len(group.joints) + place for row in range(group.row_count))
            constraints.append(Constraint(blocks, slots))
        start += group.row_count * len(group.joints)
    return make_tables(constraints, len(block_of), together=False)


class JointRows(NamedTuple):
    """All joint rows in slot order, components of shape (slot, world); `rate` is the Jacobian times the velocities."""

    parent: Side
    child: Side
    error: Array
    rate: Array
    damping: Array
    one_sided: np.ndarray
    damped: np.ndarray


def joint_rows(model: Model, bodies: Bodies) -> JointRows:
    """Jacobians and errors of all joint rows at the poses of all bodies."""
    rows: list[JointRow] = []
    rates: list[Array] = []
    counts: list[int] = []
    for group in joint_groups(model.scene):
        kind = JOINTS[group.kind]
        frames = joint_frames(model, bodies, group.joints)
        group_rows = kind.fixed_rows(frames)
        if group.limited:
            limits = take(model.joint_limits, group.joints)
            group_rows += limit_rows(kind.free_sides(frames), kind.coordinate(frames), limits)
        if group.damped:
            group_rows.append(damping_row(kind.free_sides(frames), take(model.joint_damping, group.joints)))
        members = [[getattr(model.scene.joints[joint], name) for joint in group.joints] for name in ("parent", "child")]
        parent_motion, child_motion = (Side(*take((bodies.velocity, bodies.angular_velocity), m)) for m in members)
        rates += [inner(row.parent, parent_motion) + inner(row.child, child_motion) for row in group_rows]
        rows += group_rows
        counts += [len(group.joints)] * len(group_rows)

    def side(name: str) -> Side:
        sides = [getattr(row, name) for row in rows]
        return Side(*(_stack_vectors([getattr(s, part) for s in sides], counts) for part in ("linear", "angular")))

    zero = jnp.zeros((1, 1), model.dt.dtype)
    parent, child, error, rate = compute_once(
        (side("parent"), side("child"), _stack([row.error for row in rows], counts), _stack(rates, counts)),
        bodies.position.x,
    )
    return JointRows(
        parent=parent,
        child=child,
        error=error,
        rate=rate,
        damping=_stack([zero if row.damping is None else row.damping for row in rows], counts),
        one_sided=np.repeat([row.one_sided for row in rows], counts),
        damped=np.repeat([row.damping is not None for row in rows], counts),
    )


def _stack(values: list[Array], counts: list[int]) -> Array:
    worlds = max(value.shape[1] for value in values)
    return jnp.concatenate([jnp.broadcast_to(v, (count, worlds)) for v, count in zip(values, counts, strict=True)])


def _stack_vectors(values: list[Vec3], counts: list[int]) -> Vec3:
    return Vec3(*(_stack([value[axis] for value in values], counts) for axis in range(3)))


def midpoint(bodies: Bodies, dt: Array) -> Bodies:
    """Where the bodies are after half a step at their present velocities."""
    turn = exponential(bodies.angular_velocity * (0.5 * dt))
    return bodies._replace(
        position=bodies.position + bodies.velocity * (0.5 * dt), orientation=multiply(turn, bodies.orientation)
    )


def velocity_rows(
    scene: Scene, table: Table, model: Model, joints: JointRows, middle: JointRows, inertia: Inertia
) -> Rows:
    """Rows of one table for the velocity solver.

    Args:
      scene, table, model: structure and parameters.
      joints: rows at the start of the step, whose errors are corrected.
      middle: rows at the middle of the step, whose Jacobians are used. A joint holds on average over the step:
        ``J_middle (u_start + u_end) = 0``, where what already violates the joint at the start, ``J_start u_start``, is left
        out and so damped away. With the Jacobian of the start, a turning body would lose (omega dt)^2 of its energy in
        each step.
      inertia: of the moving bodies.
    """
    jacobians, responses, mass = _sides(scene, table, middle, inertia)
    error, damping, one_sided, damped = _chosen(table, joints)
    curvature = select(table, middle.rate - joints.rate)
    worlds = max(mass.shape[-1], error.shape[-1])
    pull = scene.options.baumgarte * error / model.dt
    # The small steps damp by implicit Euler in each substep and have a bias of their own.
    small = scene.options.solver == "soft_step"
    time = model.dt / scene.options.substep_count if small else model.dt
    decay = jnp.clip(damping * mass * time, 0.0, LARGEST_DECAY)
    # Where nothing is damped the row is void: an infinite softness, expressed by a zero effective mass.
    moves = ~damped | (decay > 0)
    safe_decay = jnp.where(damped & (decay > 0), decay, 1.0)
    end_weight = jnp.ones_like(safe_decay) if small else _end_weight(safe_decay)
    softness = jnp.where(damped & (decay > 0), mass / (end_weight * safe_decay), 0.0)
    start_rate = select(table, joints.rate) * (1.0 / end_weight - 1.0)
    bias = jnp.where(damped, start_rate, jnp.where(one_sided & (error > 0), error / model.dt, pull))
    bias = bias + jnp.where(damped | one_sided, 0.0, curvature)
    law = Bounded(
        effective_mass=jax.lax.stop_gradient(
            pack_scalars(table, [jnp.where(moves, 1.0 / (mass + softness), 0.0)], worlds)
        ),
        softness=pack_scalars(table, [softness], worlds),
        lower=_bounds(table, np.where(one_sided, 0.0, -np.inf)),
        upper=_bounds(table, np.full(one_sided.shape, np.inf)),
    )
    return _pack(table, jacobians, responses, bias, law, worlds)


def position_error(
    scene: Scene, table: Table, model: Model, joints: JointRows, middle: JointRows, worlds: int
) -> PositionError:
    """What the small steps need to know of the errors of one table; the arguments are those of `velocity_rows`."""
    error, _, one_sided, damped = _chosen(table, joints)
    curvature = jnp.where(one_sided | damped, 0.0, select(table, middle.rate - joints.rate))
    limit = jnp.where(damped, 0.0, push_out_speed(scene, table, model))
    packed_error, packed_limit, packed_curvature = (
        pack_scalars(table, [value], worlds) for value in (error, limit, curvature)
    )
    sided = jnp.asarray(one_sided).reshape(table.turn_count, 1, table.column_count, 1)
    return PositionError(packed_error, packed_limit, sided, None, packed_curvature)


def _end_weight(decay: Array) -> Array:
    """Weight of the velocity at the end of a step, against that at its start, in the mean that viscous damping acts on.

    With ``theta = 1 / (1 - exp(-decay)) - 1 / decay`` a lone coordinate under a constant force moves exactly as
    ``u' = f - c u`` says. The weight lies between 1/2 (second order for small steps) and 1 (stable for large ones).
    Source: the exponentially fitted theta method (W. Liniger and R. Willoughby, SIAM J. Numer. Anal. 7, 1970).
    """
    small = decay < 0.1  # there the quotients cancel and the series is exact to round-off
    squared = decay * decay
    series = 0.5 + decay * (1.0 / 12.0 - squared * (1.0 / 720.0 - squared / 30240.0))
    usual = jnp.where(small, 1.0, decay)
    return jnp.where(small, series, -1.0 / jnp.expm1(-usual) - 1.0 / usual)


def position_rows(
    scene: Scene, table: Table, joints: JointRows, error: Array, inertia: Inertia, percent: float
) -> Rows:
    """Rows of one table for the position correction; `error` (slot, world) is that after the step."""
    jacobians, responses, mass = _sides(scene, table, joints, inertia)
    _, _, one_sided, damped = _chosen(table, joints)
    error = select(table, error)
    worlds = max(mass.shape[-1], error.shape[-1])
    free = np.where(damped, 0.0, np.inf)
    law = Bounded(
        effective_mass=jax.lax.stop_gradient(pack_scalars(table, [1.0 / mass], worlds)),
        softness=_bounds(table, np.zeros(one_sided.shape)),
        lower=_bounds(table, np.where(one_sided, 0.0, -free)),
        upper=_bounds(table, free),
    )
    bias = jnp.where(one_sided & (error > 0), error, percent * error)
    return _pack(table, jacobians, responses, bias, law, worlds)


def _chosen(table: Table, joints: JointRows) -> tuple[Array, Array, np.ndarray, np.ndarray]:
    slots = np.maximum(table.order, 0)
    error, damping = select(table, (joints.error, joints.damping))
    return error, damping, joints.one_sided[slots][:, None], joints.damped[slots][:, None]


def _bounds(table: Table, values: np.ndarray) -> Array:
    return jnp.asarray(values, jnp.float32).reshape(table.turn_count, 1, len(table.slots[0]), 1)


def _pack(table: Table, jacobians: list[Side], responses: list[Side], bias: Array, law: Bounded, worlds: int) -> Rows:
    return Rows(
        jacobian=tuple(pack_sides(table, [jacobian], worlds) for jacobian in jacobians),
        response=tuple(pack_sides(table, [response], worlds) for response in responses),
        bias=pack_scalars(table, [bias], worlds),
        law=law,
        table=table,
    )


def _sides(scene: Scene, table: Table, joints: JointRows, inertia: Inertia) -> tuple[list[Side], list[Side], Array]:
    """Jacobian and response of the moving bodies of a table, and ``J M^-1 J^T``."""
    if len(table.blocks) == 2:
        jacobians = [select(table, joints.parent), select(table, joints.child)]
    else:
        jacobians = [_moving_side(scene, table, joints)]
    responses = [respond(j, select_blocks(table, side, inertia)) for side, j in enumerate(jacobians)]
    mass = sum((inner(j, r) for j, r in zip(jacobians, responses, strict=True)), jnp.zeros(()))
    return jacobians, responses, mass


def _moving_side(scene: Scene, table: Table, joints: JointRows) -> Side:
    """The side of the body that moves, where the other body is static."""
    child_moves = np.concatenate(
        [
            np.tile([not scene.static[scene.joints[joint].child] for joint in group.joints], group.row_count)
            for group in joint_groups(scene)
        ]
    )[np.maximum(table.order, 0)]
    if child_moves.all():
        return select(table, joints.child)
    parent, child = select(table, joints.parent), select(table, joints.child)
    parts = (
        Vec3(
            *(
                jnp.where(child_moves[:, None], c, p)
                for c, p in zip(getattr(child, part), getattr(parent, part), strict=True)
            )
        )
        for part in ("linear", "angular")
    )
    return Side(*parts)


def motor_forces(model: Model, bodies: Bodies, action: Array) -> tuple[Vec3, Vec3]:
    """Forces and torques of the motors on all bodies, components (body, world).

    Args:
      action: (motor, world); clipped to the limit of each motor and multiplied by its gear.
    """
    scene = model.scene
    effort = jnp.clip(action, -model.motor_limit, model.motor_limit) * model.motor_gear
    worlds = max(effort.shape[-1], bodies.position.x.shape[-1])
    totals = [jnp.zeros((scene.body_count, worlds), effort.dtype) for _ in range(6)]
    for kind_name, kind in JOINTS.items():
        motors = [motor for motor, joint in enumerate(scene.motors) if scene.joints[joint].kind == kind_name]
        if not motors:
            continue
        joints = tuple(scene.motors[motor] for motor in motors)
        sides = kind.free_sides(joint_frames(model, bodies, joints))
        chosen = take(effort, motors)
        for side, name in zip(sides, ("parent", "child"), strict=True):
            receivers = np.asarray([getattr(scene.joints[joint], name) for joint in joints])
            assert side.angular is not None
            for axis, component in enumerate((*side.linear, *side.angular)):
                totals[axis] = totals[axis].at[receivers].add(component * chosen)
    return Vec3(*totals[:3]), Vec3(*totals[3:])


def joint_coordinates(model: Model, bodies: Bodies) -> tuple[Array, Array]:
    """Position and velocity (joint, world) of the free coordinate of every joint."""
    scene = model.scene
    positions: dict[int, Array] = {}
    velocities: dict[int, Array] = {}
    for group in joint_groups(scene):
        kind = JOINTS[group.kind]
        frames: JointFrames = joint_frames(model, bodies, group.joints)
        position, velocity = kind.coordinate(frames), jnp.zeros(())
        for side, name in zip(kind.free_sides(frames), ("parent", "child"), strict=True):
            members = [getattr(scene.joints[joint], name) for joint in group.joints]
            velocity = velocity + inner(side, Side(*take((bodies.velocity, bodies.angular_velocity), members)))
        for place, joint in enumerate(group.joints):
            positions[joint], velocities[joint] = position[place], velocity[place]
    order = range(len(scene.joints))
    return jnp.stack([positions[j] for j in order]), jnp.stack([velocities[j] for j in order])


def joint_impulse_start(table: Table, force: Array, dt: Array, worlds: int) -> Array:
    """Impulses (turn, 1, column, world) from the generalized forces of the last step (slot, world)."""
    return pack_scalars(table, [select(table, force) * dt], worlds)
