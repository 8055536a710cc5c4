"""Sweeps over contacts and other rows with bounds of mechanisms, from where stiff drives want them to start.

See `mechanism_drives`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.constraints import fixed_point, mechanism_drives
from mathota_jax.constraints.joint_rows import JointRows
from mathota_jax.constraints.mechanism_contacts import (
    Reduced,
    by_group,
    contact_groups,
    in_order,
    scalar_group,
    with_rates,
)
from mathota_jax.constraints.mechanism_layout import bounded_slots
from mathota_jax.scene import Scene
from mathota_jax.solver import pgs
from mathota_jax.solver.delassus import Delassus
from mathota_jax.solver.laws import Bounded, Cone
from mathota_jax.solver.rows import Rows
from mathota_jax.spatial.indexing import in_every_world, take
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import store_cotangents


def solve(
    scene: Scene,
    joints: JointRows,
    contacts: Sequence[Rows],
    reduced: Reduced,
    rates: Array,
    start: tuple[Array, ...],
) -> tuple[Array, ...]:
    """Impulses of the reduced groups, with the derivative of the solution.

    Args:
      scene: whose mechanisms take contacts.
      joints: all joint rows, of which the laws matter.
      contacts: all contacts.
      reduced: all rows, reduced.
      rates: (row, world) without impulses.
      start: impulses of the last step, without derivative.
    """
    fixed, of_contacts, without = lax.stop_gradient((reduced, tuple(contacts), rates))
    laws = joints.laws[np.asarray(bounded_slots(scene), int)]
    if mechanism_drives.are_stiff(laws):
        start = _closer_start(scene, laws, fixed, _drives(fixed, of_contacts, without), without, start)
    found = in_order(_sweep(scene, fixed.rows, without, start, fixed.delassus))
    errors = store_cotangents(rates + reduced.rates(reduced.change(found)))
    return by_group(reduced.rows, fixed_point.derive(reduced.rows, reduced.delassus, errors, found))


def _sweep(
    scene: Scene, rows: Sequence[Rows], rates: Array, start: tuple[Array, ...], delassus: Delassus
) -> tuple[Array, ...]:
    """Impulses of groups, from `rates` (row, world) without any."""
    started, state = with_rates(rows, delassus, rates)
    return pgs.solve(scene.options.velocity_iterations, 1, False, started, state, start)[1]


class _Drives(NamedTuple):
    """All rows, those with bounds on joints with their biases in their errors.

    Attributes:
      law: of the rows on joints (row, world), with the masses of two bodies alone.
      errors: (row, world) of all rows, without impulses.
      contacts: groups of the others.
    """

    law: Bounded
    errors: Array
    contacts: tuple[Rows, ...]

    def others(self, scene: Scene, without: mechanism_drives.Elimination, start: Array) -> Array:
        """Impulses (row, world) of the rows that an elimination leaves."""
        scalar = without.left[without.left < len(self.law.softness)]
        groups = contact_groups(self.contacts, without.delassus, len(scalar))
        if len(scalar):
            law = take(self.law, scalar)
            groups.insert(0, scalar_group(law, jnp.zeros_like(law.softness), without.delassus))
        return in_order(_sweep(scene, groups, without.errors, by_group(groups, start), without.delassus))


def _drives(reduced: Reduced, contacts: Sequence[Rows], rates: Array) -> _Drives:
    law, bias = jax.tree.map(lambda x: x[:, 0, 0], (reduced.rows[0].law, reduced.rows[0].bias))
    worlds = max(bias.shape[-1], rates.shape[-1])
    law, bias, rates = in_every_world((law, bias, rates), worlds)
    errors = jnp.concatenate([rates[: len(bias)] + bias, rates[len(bias) :]])
    return _Drives(law, errors, tuple(contacts))


def _closer_start(
    scene: Scene, laws: np.ndarray, reduced: Reduced, rows: _Drives, rates: Array, impulses: tuple[Array, ...]
) -> tuple[Array, ...]:
    """Impulses of the reduced groups from which to sweep over all of them, without derivative."""
    found = mechanism_drives.closer_start(
        laws,
        rows.law,
        reduced.delassus,
        rows.errors,
        in_order(in_every_world(impulses, rows.errors.shape[-1])),
        lambda found, start: rows.others(scene, found, start),
        functools.partial(_left_to_do, reduced, rates),
    )
    return by_group(reduced.rows, found)


def _left_to_do(reduced: Reduced, rates: Array, impulses: Array) -> Array:
    """Energy (world,) of what one more update of each row alone would change; (row, world), rates without impulses."""
    rates = rates + reduced.delassus.times(impulses)
    total = jnp.zeros(rates.shape[-1], rates.dtype)
    groups = (reduced.rows, by_group(reduced.rows, rates), by_group(reduced.rows, impulses))
    for group, rate, impulse in zip(*groups, strict=True):
        change = group.law.update(impulse, group.bias + rate) - impulse
        if isinstance(group.law, Cone):
            normal, tangent = group.law.normal_mass, group.law.tangent_mass
            mass = jnp.stack([normal, tangent, tangent], axis=1)
        else:
            mass = group.law.effective_mass
        total = total + safe_divide(change * change, jnp.broadcast_to(mass, change.shape)).sum((0, 1, 2))
    return total
