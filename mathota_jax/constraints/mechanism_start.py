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
from mathota_jax.constraints.mechanism_contacts import Reduced, contact_groups, in_order, scalar_group
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
    impulses = in_every_world(impulses, worlds)

    def solve_all(_: Array, before: tuple[tuple[Array, ...], Array]) -> tuple[tuple[Array, ...], Array]:
        (old, *begin), pushes = impulses, before[0][0][:, 0, 0]
        found = mechanism_drives.eliminate(laws, law, reduced.matrix, errors, pushes)
        scalar = found.left[found.left < len(bounded)]
        groups = contact_groups(contacts, found.matrix, len(scalar))
        if len(scalar):
            # Their errors have their biases already.
            groups.insert(0, scalar_group(take(law, scalar), jnp.zeros_like(take(bias, scalar)), found.matrix))
            begin.insert(0, take(old, scalar))
        sweeps = scene.options.velocity_iterations
        swept = pgs.solve(sweeps, 1, tuple(groups), found.errors[:, None], tuple(begin))[1]
        pushes, solved = found.impulses(pushes, in_order(swept))
        return (pushes[:, None, None], *swept[bool(len(scalar)) :]), solved

    start = (impulses, jnp.zeros_like(errors[0]))
    found, solved = lax.fori_loop(0, mechanism_drives.passes(laws), solve_all, start)
    left = [_left_to_do(reduced, rates, values) for values in (found, impulses)]
    return jax.tree.map(functools.partial(jnp.where, mechanism_drives.are_better(solved, *left)), found, impulses)


def _left_to_do(reduced: Reduced, rates: Array, impulses: Sequence[Array]) -> Array:
    """Energy (world,) of what one more update of each row alone would change; `rates` (row, world) without impulses."""
    rates = rates + add_scaled(reduced.matrix, in_order(impulses))
    total, first = jnp.zeros(rates.shape[-1], rates.dtype), 0
    for group, impulse in zip(reduced.rows, impulses, strict=True):
        turns, rows, points, worlds = impulse.shape
        own = rates[first : first + turns * rows * points].reshape(turns, points, rows, worlds)
        change = group.law.update(impulse, group.bias + jnp.swapaxes(own, 1, 2)) - impulse
        if isinstance(group.law, Cone):
            normal, tangent = group.law.normal_mass, group.law.tangent_mass
            mass = jnp.stack([normal, tangent, tangent], axis=1)
        else:
            mass = group.law.effective_mass
        total = total + safe_divide(change * change, jnp.broadcast_to(mass, change.shape)).sum((0, 1, 2))
        first += turns * rows * points
    return total
