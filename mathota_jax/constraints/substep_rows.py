"""What the small steps (`solver.soft_step`) need to know of joints and contacts beyond their rows."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.constraints import joint
from mathota_jax.constraints.assembly import pack_scalars, smaller_side
from mathota_jax.constraints.contact import ContactRows
from mathota_jax.constraints.decoupling import Decoupling
from mathota_jax.constraints.joint import JointMotion
from mathota_jax.constraints.joint_layout import joint_groups, most_joints_of_a_body
from mathota_jax.constraints.joints.rows import HOLD, STOP
from mathota_jax.model import Model
from mathota_jax.scene import Scene
from mathota_jax.solver.rows import Rows
from mathota_jax.solver.soft_laws import ForceLaws, PositionError
from mathota_jax.solver.table import Table
from mathota_jax.spatial.indexing import take

PUSH_OUT_RATE = 6.0
"""Largest push-out velocity, in radii of the smaller body [1/s]: 3 m/s for a cube of 1 m, as in Box2D; of rows that only
turn, in radians."""

SHORTEST_PUSH = 1.0 / 960.0
"""Substep [s] below which that velocity falls with it: its share that the sweeps do not take back stays in the scene. Boxes
on one another, pressed in by what a step of 1/60 s lets them, parted at 7 m/s in a single step of 1e-5 s."""


def substep_length(model: Model) -> Array:
    """Time [s] of a small step."""
    return model.dt / model.scene.options.substep_count


def joint_rows(scene: Scene, table: Table, model: Model, motion: JointMotion) -> tuple[Rows, Decoupling]:
    """Rows of one table whose laws are those of one substep, and how they were decoupled.

    The turning of the Jacobian and the errors of the rows that hold are left to `joint_error`.
    """
    error = jnp.where((motion.start.laws == HOLD)[:, None], 0.0, motion.start.error)
    still = motion._replace(start=motion.start._replace(error=error), turning=None)
    part = dataclasses.replace(model, dt=substep_length(model))
    return joint.decoupled_rows(scene, table, part, still)


def joint_error(scene: Scene, rows: Rows, model: Model, motion: JointMotion, decoupling: Decoupling) -> PositionError:
    """Errors of the rows of `joint_rows`."""
    table, worlds = rows.table, rows.bias.shape[-1]
    slots = np.maximum(table.order, 0)
    laws = motion.start.laws[slots]
    shape = (table.turn_count, 1, table.column_count, 1)

    def packed(values: Array) -> Array:
        return pack_scalars(table, [decoupling.rows(values)], worlds)

    assert motion.turning is not None
    linear = jax.tree.leaves((motion.start.parent.linear, motion.start.child.linear))
    moves = functools.reduce(jnp.logical_or, [take(part, slots) != 0 for part in linear])
    branches = _branches(scene)[slots]
    radius = pack_scalars(table, [_smallest_radius(scene, rows, model)], worlds)
    limit = _push_out_rate(model) * jnp.where(
        pack_scalars(table, [moves.astype(radius.dtype)], worlds) > 0, radius, 1.0
    )
    return PositionError(
        start=packed(take(motion.start.error, slots)),
        limit=limit,
        one_sided=jnp.asarray(laws == STOP).reshape(shape) if (laws == STOP).any() else None,
        curvature=packed(take(motion.turning, slots)),
        force=_force_laws(scene, rows, model, motion, laws.reshape(shape)),
        branches=jnp.asarray(branches).reshape(shape) if branches.any() else None,
    )


def _branches(scene: Scene) -> np.ndarray:
    """(slot,) whether each joint row belongs to a joint of a moving body that has more than two."""
    branches = most_joints_of_a_body(scene) > 2
    return np.concatenate([np.tile(branches[list(group.joints)], group.row_count) for group in joint_groups(scene)])


def _force_laws(scene: Scene, rows: Rows, model: Model, motion: JointMotion, laws: np.ndarray) -> ForceLaws | None:
    """How the biases of springs, dampers, friction and motors follow the coordinate; None where there are none."""
    acts = ~np.isin(laws, (HOLD, STOP))
    if not acts.any():
        return None

    def bias(error: Array, rate: Array) -> Array:
        at = motion._replace(start=motion.start._replace(error=error, rate=rate))
        return joint_rows(scene, rows.table, model, at)[0].bias

    error, rate = motion.start.error, motion.start.rate
    by_error = jax.jvp(lambda error: bias(error, rate), (error,), (jnp.ones_like(error),))[1]
    by_rate = jax.jvp(lambda rate: bias(error, rate), (rate,), (jnp.ones_like(rate),))[1]
    return ForceLaws(jnp.asarray(acts), by_error, by_rate)


def contact_error(scene: Scene, contact: ContactRows, model: Model) -> PositionError:
    """Gaps and overlaps of one table."""
    table, worlds = contact.rows.table, contact.rows.bias.shape[-1]
    limit = _push_out_rate(model) * pack_scalars(table, [_smallest_radius(scene, contact.rows, model)], worlds)
    return PositionError(contact.separation, limit, jnp.ones((1, 1, 1, 1), bool), contact.lever)


def _push_out_rate(model: Model) -> Array:
    """(world,) largest one [1/s] for the substep."""
    return PUSH_OUT_RATE * jnp.minimum(substep_length(model) / SHORTEST_PUSH, 1.0)


def _smallest_radius(scene: Scene, rows: Rows, model: Model) -> Array:
    """(turn * column, world) root mean square distance of the mass from the centre, of the smaller moving body.

    Not the inner radius: a thin card must not be held to its thickness.
    """
    mass, inertia = take((model.mass, model.inertia), scene.dynamic_bodies)
    return smaller_side(rows.table, jnp.sqrt(inertia.sum(1) / (2.0 * mass)), rows.places)
