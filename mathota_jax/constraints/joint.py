"""Joint rows as the solver wants them: one table after the other, velocities or positions."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.bodies import Inertia
from mathota_jax.constraints.assembly import Side, inner, pack_scalars, pack_sides, respond, select, select_blocks
from mathota_jax.constraints.decoupling import Decoupling, decouple
from mathota_jax.constraints.effective_mass import step_length
from mathota_jax.constraints.joint_layout import child_moves
from mathota_jax.constraints.joint_rows import JointRows
from mathota_jax.constraints.joints.kind import OUT_OF_REACH
from mathota_jax.constraints.joints.rows import DRIVE, ELASTIC, HOLD, STOP
from mathota_jax.constraints.mechanism_layout import bounded_slots
from mathota_jax.constraints.mechanism_rows import Responses, felt_mass
from mathota_jax.constraints.row_coefficients import Coefficients
from mathota_jax.constraints.row_laws import CORRECTED, LAWS, LEAST, Columns
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.solver.laws import Bounded
from mathota_jax.solver.row_matrix import Dense
from mathota_jax.solver.rows import Rows
from mathota_jax.solver.table import Table
from mathota_jax.spatial.indexing import take
from mathota_jax.spatial.settle import store_cotangents
from mathota_jax.spatial.spread import diagonal
from mathota_jax.spatial.vector import where

REACHED = 1e-5
"""Room [m or rad] left before a stop at which it takes part in a collision."""


class JointMotion(NamedTuple):
    """What the joint rows of a step are made of.

    A joint holds on average over the step: ``J_middle (u_start + u_end) = 0``, where what already violates the joint at
    the start, ``J_start u_start``, is left out and so damped away. With the Jacobian of the start, a turning body would
    lose (omega dt)^2 of its energy in each step.

    Attributes:
      start: rows at the start of the step, whose errors are corrected.
      middle: rows at the middle of the step, whose Jacobians are used.
      coefficients: of the laws.
      inertia: of the moving bodies.
      turning: (slot, world) what the turning of the Jacobians adds to the rates until then; None where others follow it.
      responses: to the rows with bounds of mechanisms; None where there are none.
    """

    start: JointRows
    middle: JointRows
    coefficients: Coefficients
    inertia: Inertia
    turning: Array | None = None
    responses: Responses | None = None


def velocity_rows(scene: Scene, table: Table, model: Model, motion: JointMotion) -> Rows:
    """Rows of one table for the velocity solver."""
    return _rows(scene, table, model, motion, False)[0]


def decoupled_rows(scene: Scene, table: Table, model: Model, motion: JointMotion) -> tuple[Rows, Decoupling]:
    """The same with rows that are independent within each joint; also how they were made so."""
    rows, decoupling = _rows(scene, table, model, motion, True)
    assert decoupling is not None
    return rows, decoupling


def _rows(
    scene: Scene, table: Table, model: Model, motion: JointMotion, decouples: bool
) -> tuple[Rows, Decoupling | None]:
    jacobians, responses, mass = _sides(scene, table, motion.middle, motion.inertia)
    decoupling = None
    if decouples:
        decoupling = decouple(scene, table, jacobians, responses)
        mass = decoupling.mass
        jacobians, responses = decoupling.sides(jacobians), decoupling.sides(responses)
    slots = np.maximum(table.order, 0)
    laws, angular = (values[slots] for values in (motion.start.laws, motion.start.angular))
    if decoupling is not None and not np.isin(laws, CORRECTED).all():
        # With the derivatives that it owes to the bodies: springs and dampers respond by it.
        mass = _mass(jacobians, responses)
    error, rate, coefficients = select(table, (motion.start.error, motion.start.rate, motion.coefficients))
    felt = mass if motion.responses is None else _with_trees(scene, slots, mass, motion.responses)
    # An error turned into velocity whips a chain that starts open, and feeds a loop that can not close without bound. The
    # position correction takes it back without energy.
    baumgarte = 0.0 if scene.options.position_iterations else scene.options.baumgarte
    felt, error, rate, coefficients = store_cotangents((felt, error, rate, coefficients))
    columns = Columns(felt, error, rate, angular[:, None], coefficients, model.dt, baumgarte)
    found = {law: LAWS[law](columns) for law in sorted(set(laws.tolist()))}

    def of_each(name: str) -> Any:
        return _by_law(laws, {law: getattr(response, name) for law, response in found.items()})

    bias = of_each("bias")
    if motion.turning is not None:
        bias = bias + select(table, motion.turning)
    if decoupling is not None:
        bias = decoupling.rows(bias)
    worlds = max(jnp.shape(value)[-1] for value in (mass, error, *coefficients.values()))
    # Where a soft row does nothing it is void: an infinite softness, expressed by a zero effective mass.
    works = of_each("works")
    softness = jnp.where(works, of_each("softness"), 0.0)
    law = Bounded(
        effective_mass=step_length(
            scene, pack_scalars(table, [jnp.where(works, 1.0 / (mass + softness), 0.0)], worlds)
        ),
        softness=pack_scalars(table, [softness], worlds),
        lower=_pack_bound(table, of_each("lower"), worlds),
        upper=_pack_bound(table, of_each("upper"), worlds),
    )
    return _pack(table, jacobians, responses, bias, law, worlds), decoupling


def _with_trees(scene: Scene, slots: np.ndarray, mass: Array, responses: Responses) -> Array:
    """``J M^-1 J^T`` of columns, for the rows of mechanisms with all that hangs on their joints.

    A spring that saw two bodies alone would take a heavy arm for a fast oscillator, and damp it.
    """
    bounded = bounded_slots(scene)
    inside = np.isin(slots, bounded)
    rows = [bounded.index(slot) if slot in bounded else 0 for slot in slots.tolist()]
    own = felt_mass(take(diagonal(responses.matrix), rows), mass)
    return own if inside.all() else jnp.where(inside[:, None], own, mass)


def _by_law(laws: np.ndarray, values: dict[str, Any]) -> Any:
    """Selects for each column (column, world) the value of its law."""
    names = iter(values)
    chosen = values[next(names)]
    for name in names:
        if values[name] is not chosen:
            chosen = jnp.where((laws == name)[:, None], values[name], chosen)
    return chosen


def _pack_bound(table: Table, bound: Any, worlds: int) -> Array:
    if jnp.ndim(bound) == 2 and bound.shape[-1] > 1:
        return pack_scalars(table, [bound], worlds)
    columns = jnp.broadcast_to(jnp.asarray(bound), (len(table.order), 1))
    return columns.reshape(table.turn_count, 1, len(table.slots[0]), 1)


def position_rows(
    scene: Scene, table: Table, joints: JointRows, error: Array, inertia: Inertia, left_out: tuple[int, ...] = ()
) -> Rows:
    """Rows of one table for the position correction, void in slots `left_out`; `error` (slot, world) after the step."""
    jacobians, responses, mass = _sides(scene, table, joints, inertia)
    worlds = max(mass.shape[-1], error.shape[-1])
    bias, law = _position_laws(scene, table, joints, select(table, error), mass, worlds, left_out)
    return _pack(table, jacobians, responses, bias, law, worlds)


def collision_rows(scene: Scene, table: Table, joints: JointRows, coefficients: Coefficients, inertia: Inertia) -> Rows:
    """Rows of one table while bodies collide, in no time; their biases are left at 0.

    What holds, and motors without a cap, keep their rates, rotors resist a change of theirs, and stops that are reached let
    none pass. What acts by bounded forces does nothing.
    """
    jacobians, responses, mass = _sides(scene, table, joints, inertia)
    laws = joints.laws[np.maximum(table.order, 0)][:, None]
    none = jnp.zeros((1, 1), mass.dtype)
    wanted = (joints.error, coefficients.get("armature", none), coefficients.get("cap", none))
    error, armature, cap = (select(table, jnp.broadcast_to(v, joints.error.shape)) for v in wanted)
    rotor = (laws == ELASTIC) & (mass * armature > LEAST)
    softness = jnp.where(rotor, 1.0 / jnp.where(rotor, armature, 1.0), 0.0)
    reached = (laws == STOP) & (error <= REACHED)
    works = (laws == HOLD) | reached | rotor | ((laws == DRIVE) & (cap >= OUT_OF_REACH))
    free = jnp.where(works, jnp.inf, 0.0)
    worlds = max(mass.shape[-1], error.shape[-1])
    law = Bounded(
        effective_mass=pack_scalars(table, [jnp.where(works, 1.0 / (mass + softness), 0.0)], worlds),
        softness=pack_scalars(table, [softness], worlds),
        lower=pack_scalars(table, [jnp.where(laws == STOP, 0.0, -free)], worlds),
        upper=pack_scalars(table, [free], worlds),
    )
    return _pack(table, jacobians, responses, jnp.zeros_like(mass), law, worlds)


def decoupled_position_rows(scene: Scene, rows: Rows, decoupling: Decoupling, joints: JointRows, error: Array) -> Rows:
    """The same from the rows of the velocity solver, where they were decoupled."""
    worlds = max(rows.bias.shape[-1], error.shape[-1])
    bias, law = _position_laws(scene, rows.table, joints, select(rows.table, error), decoupling.mass, worlds)
    return dataclasses.replace(rows, bias=pack_scalars(rows.table, [decoupling.rows(bias)], worlds), law=law)


def _position_laws(
    scene: Scene,
    table: Table,
    joints: JointRows,
    error: Array,
    mass: Array,
    worlds: int,
    left_out: tuple[int, ...] = (),
) -> tuple[Array, Bounded]:
    """Bias and law of position rows; `error` and `mass` (turn * column, world)."""
    slots = np.maximum(table.order, 0)
    laws = joints.laws[slots]
    one_sided = laws == STOP
    # Others are void. Of bounds that leave nothing alone derivatives make a tie, at rest, and a share of a row.
    works = np.isin(laws, CORRECTED) & ~np.isin(slots, left_out)
    free = np.where(works, np.inf, 0.0)
    law = Bounded(
        effective_mass=jax.lax.stop_gradient(pack_scalars(table, [jnp.where(works[:, None], 1.0 / mass, 0.0)], worlds)),
        softness=_bounds(table, np.zeros(one_sided.shape)),
        lower=_bounds(table, np.where(one_sided, 0.0, -free)),
        upper=_bounds(table, free),
    )
    # A stop is taken at once: there is no manifold whose points could fight over it.
    return jnp.where(one_sided[:, None], error, scene.options.position_percent * error), law


def _bounds(table: Table, values: np.ndarray) -> Array:
    return jnp.asarray(values, jnp.float32).reshape(table.turn_count, 1, len(table.slots[0]), 1)


def _pack(table: Table, jacobians: list[Side], responses: list[Side], bias: Array, law: Bounded, worlds: int) -> Rows:
    return Rows(
        matrix=Dense(
            tuple(pack_sides(table, [jacobian], worlds) for jacobian in jacobians),
            tuple(pack_sides(table, [response], worlds) for response in responses),
        ),
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
    return jacobians, responses, _mass(jacobians, responses)


def _mass(jacobians: Sequence[Side], responses: Sequence[Side]) -> Array:
    return sum((inner(j, r) for j, r in zip(jacobians, responses, strict=True)), jnp.zeros(()))


def _moving_side(scene: Scene, table: Table, joints: JointRows) -> Side:
    """The side of the body that moves, where the other body is static."""
    moves = child_moves(scene)[np.maximum(table.order, 0)]
    if moves.all():
        return select(table, joints.child)
    parent, child = select(table, joints.parent), select(table, joints.child)
    assert parent.angular is not None and child.angular is not None
    moves = moves[:, None]
    return Side(where(moves, child.linear, parent.linear), where(moves, child.angular, parent.angular))


def joint_impulse_start(table: Table, force: Array, dt: Array, worlds: int, decoupling: Decoupling | None) -> Array:
    """Impulses (turn, 1, column, world) from the generalized forces of the last step (slot, world)."""
    impulse = select(table, force) * dt
    return pack_scalars(table, [impulse if decoupling is None else decoupling.impulses(impulse)], worlds)
