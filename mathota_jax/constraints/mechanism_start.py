"""Where the sweeps over contacts and other rows with bounds start, of mechanisms on stiff drives; see `mechanism_drives`."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.constraints import mechanism_drives
from mathota_jax.constraints.joint_rows import JointRows
from mathota_jax.constraints.mechanism_contacts import Reduced, by_group, contact_groups, in_order, scalar_group
from mathota_jax.constraints.mechanism_layout import bounded_slots
from mathota_jax.scene import Scene
from mathota_jax.solver import pgs
from mathota_jax.solver.laws import Cone
from mathota_jax.solver.rows import Rows
from mathota_jax.spatial.indexing import in_every_world, take
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.spread import add_scaled


def closer_start(
    scene: Scene,
    joints: JointRows,
    contacts: Sequence[Rows],
    reduced: Reduced,
    rates: Array,
    impulses: tuple[Array, ...],
) -> tuple[Array, ...]:
    """Impulses of the reduced groups from which to sweep over all of them, without derivative.

    Args:
      scene: whose mechanisms take contacts.
      joints: all joint rows, of which the laws matter.
      contacts: all contacts.
      reduced: all rows, reduced.
      rates: (row, 1, world) without impulses.
      impulses: of the last step.
    """
    bounded = bounded_slots(scene)
    laws = joints.laws[np.asarray(bounded, int)]
    if not mechanism_drives.are_stiff(laws):
        return impulses
    reduced, contacts, rates = lax.stop_gradient((reduced, tuple(contacts), rates[:, 0]))
    law, bias = jax.tree.map(lambda x: x[:, 0, 0], (reduced.rows[0].law, reduced.rows[0].bias))
    worlds = max(bias.shape[-1], rates.shape[-1])
    errors = jnp.concatenate(in_every_world([rates[: len(bounded)] + bias, rates[len(bounded) :]], worlds))

    def sweep(found: mechanism_drives.Elimination, start: Array) -> Array:
        scalar = found.left[found.left < len(bounded)]
        groups = contact_groups(contacts, found.matrix, len(scalar))
        if len(scalar):
            # Their errors have their biases already.
            groups.insert(0, scalar_group(take(law, scalar), jnp.zeros_like(take(bias, scalar)), found.matrix))
        sweeps = scene.options.velocity_iterations
        return in_order(pgs.solve(sweeps, 1, tuple(groups), found.errors[:, None], by_group(groups, start))[1])

    found = mechanism_drives.closer_start(
        laws,
        law,
        reduced.matrix,
        errors,
        in_order(in_every_world(impulses, worlds)),
        sweep,
        functools.partial(_left_to_do, reduced, rates),
    )
    return by_group(reduced.rows, found)


def _left_to_do(reduced: Reduced, rates: Array, impulses: Array) -> Array:
    """Energy (world,) of what one more update of each row alone would change; (row, world), rates without impulses."""
    rates = rates + add_scaled(reduced.matrix, impulses)
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
