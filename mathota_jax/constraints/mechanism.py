"""Mechanisms: trees of joints, whose rows that hold are solved together, exactly.

One row after the other, an error travels one joint a sweep: n links need n^2 sweeps, and what is left over from each step
grows at large ones. Rows that hold have no bounds to respect, and the impulses with which all of a tree do follow from a few
passes over its bodies (`solver.tree`). Rows of other laws and contacts are left to the sweeps, which start from the exact
impulses and are followed by one more exact solution. With nothing but rows that hold no sweep is needed at all.

Joints that close loops are added to the tree of the others (`mechanism_loops`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, mlir

from mathota_jax.bodies import pack_blocks, unpack_blocks
from mathota_jax.constraints import mechanism_loops
from mathota_jax.constraints.assembly import collect, pack_scalars, select
from mathota_jax.constraints.mechanism_layout import Layout, layout
from mathota_jax.constraints.mechanism_links import (
    Impulses,
    Links,
    along_directions,
    column,
    of_slots,
    only_held,
    pack,
    push,
    rates,
    shift_of_turn,
    to_blocks,
    to_slots,
    unpack,
)
from mathota_jax.scene import Scene
from mathota_jax.solver import tree
from mathota_jax.solver.rows import Rows
from mathota_jax.solver.table import EMPTY
from mathota_jax.spatial.indexing import in_every_world, take
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.spread import add_all_slices
from mathota_jax.spatial.vector import dot

ROUNDS = 1
"""Times that joints are closed by impulses before what is left of the gaps is taken by shifting links.

Two change nothing for ten and twenty links at 1/60 s, and little for a heavy end.
"""

LOOP_ROUNDS = 2
"""The same where there are loops. A bridge as long as its span opens by half as much with two as with one."""


class Solutions(NamedTuple):
    """What `solve` finds in a step.

    Attributes:
      held: impulses of the step where there are mechanisms alone, else None.
      closed: those that close the joints at its end, of all rounds, (round, link, world).
    """

    held: Impulses | None
    closed: Impulses


def rounds(scene: Scene) -> int:
    """How often the joints of a scene with mechanisms are closed at the end of a step."""
    found = layout(scene)
    assert found is not None
    if not scene.options.position_iterations:
        return 0
    return LOOP_ROUNDS if found.closings else ROUNDS


def solve(links: Links, wanted: Impulses, known: Impulses | None = None) -> Impulses:
    """Impulses that change the rates of the rows by `wanted`; differentiable in both modes.

    Where they are `known`, derivatives are computed without finding them again.
    """
    worlds = max(leaf.shape[-1] for leaf in (*wanted, *(known or ()), links.factors.offset, links.offset.x))
    wanted, known = in_every_world((wanted, known), worlds)
    if known is not None:
        leaves, tree = jax.tree.flatten((links, wanted, known))
        return tuple(_known_solution_p.bind(*leaves, tree=tree))

    def product(impulses: Impulses) -> Impulses:
        changes = _changes(links, only_held(links, impulses))
        of_trees = (
            jnp.where(flags[:, None], change, impulse)
            for flags, change, impulse in zip(links.layout.held, changes[:6], impulses[:6], strict=True)
        )
        return *of_trees, *changes[6:]

    return lax.custom_linear_solve(product, wanted, lambda _, right: _impulses(links, right), symmetric=True)


def _changes(links: Links, impulses: Impulses) -> Impulses:
    """Changes of the rates by impulses, and how far the rows that close loops give way to them."""
    changes = rates(links, push(links, impulses))
    if links.loops is None:
        return changes
    return *changes[:6], changes[6] + links.loops.compliance * impulses[6]


def _known_solution(*leaves: Array, tree: Any) -> list[Array]:
    return list(jax.tree.unflatten(tree, leaves)[2])


def _known_solution_jvp(
    primals: Sequence[Array], tangents: Sequence[Any], *, tree: Any
) -> tuple[list[Array], list[Array]]:
    links = jax.tree.unflatten(tree, primals)[0]
    d_links, d_wanted, _ = jax.tree.unflatten(tree, [ad.instantiate_zeros(tangent) for tangent in tangents])
    # Not `known` itself, which is constant: this depends on the links and wanted rates when it is differentiated again.
    found = tuple(_known_solution_p.bind(*primals, tree=tree))
    changes = jax.jvp(lambda links: _changes(links, found), (links,), (d_links,))[1]
    right = only_held(links, jax.tree.map(jnp.subtract, d_wanted, changes))
    return list(found), list(solve(links, right))


# A primitive: a `custom_jvp` loses its rule where JAX splits a program into what is known and what is linear, and with it
# the second derivatives.
_known_solution_p = Primitive("known_solution")
_known_solution_p.multiple_results = True
_known_solution_p.def_impl(_known_solution)
_known_solution_p.def_abstract_eval(
    lambda *leaves, tree: [ShapedArray(x.shape, x.dtype) for x in _known_solution(*leaves, tree=tree)]
)
ad.primitive_jvps[_known_solution_p] = _known_solution_jvp
mlir.register_lowering(_known_solution_p, mlir.lower_fun(_known_solution, multiple_results=True))


def _impulses(links: Links, wanted: Impulses) -> Impulses:
    """`solve` without derivatives."""
    found = _of_trees(links, wanted[:6])
    if links.loops is None:
        return found
    loops, links = lax.stop_gradient((links.loops, links))
    without = rates(links, push(links, (*found, jnp.zeros_like(wanted[6]))))
    closing = mechanism_loops.impulses(loops, compute_once(wanted[6] - without[6], wanted[6]))
    alone = rates(links, push(links, (*map(jnp.zeros_like, found), closing)))
    found = _of_trees(links, tuple(map(jnp.subtract, wanted[:6], alone[:6])))
    return *found, closing


def _of_trees(links: Links, wanted: Impulses) -> Impulses:
    """The same where nothing closes loops."""
    translations, duals = lax.stop_gradient((links.translations, links.duals))
    # Each goes into all components of a motion.
    wanted = compute_once(wanted, wanted[0])
    turn = compute_once(along_directions(duals[1], wanted[3:]), wanted[0])
    shift = along_directions(duals[0], wanted[:3]) + shift_of_turn(translations, duals[0], turn)
    shift = compute_once(shift, wanted[0])
    force = tree.force_for(links.layout.tree, links.factors, pack(shift, turn))
    along, about = unpack(force)
    linear = [dot(dual, along) for dual in duals[0]]
    for side, impulse in zip(translations, linear, strict=True):
        about = about - side.angular * impulse
    return compute_once(only_held(links, [*linear, *(dot(dual, about) for dual in duals[1])]), wanted[0])


@jax.custom_jvp
def respond(links: Links, impulse: Array) -> Array:
    """Velocities (component, block, world) under impulses on the bodies, likewise, with the joints held.

    Differentiable in both modes.
    """
    of_links = take(unpack_blocks(impulse), links.layout.blocks)
    worlds = max(impulse.shape[-1], links.factors.offset.shape[-1])
    motion = tree.respond(links.layout.tree, links.factors, in_every_world(pack(*of_links), worlds))
    if links.loops is not None:
        motion = mechanism_loops.respond_to(links.loops, motion)
    return to_blocks(links.layout, pack_blocks(*unpack(motion)))


@respond.defjvp
def _respond_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    found = respond(*primals)

    def again(links: Links, impulse: Array) -> Array:
        """The same from the bodies alone, whose motion along the rows is taken back."""
        force, torque = take(unpack_blocks(impulse), links.layout.blocks)
        alone = pack_blocks(force * links.inertia.inverse_mass, links.inertia.solve(torque))
        excess = to_blocks(links.layout, alone) - found
        # Of what is found the rates are 0, but not once the rows turn.
        wanted = jax.tree.map(lambda *parts: -sum(parts), rates(links, excess), rates(links, found))
        return excess + push(links, solve(links, wanted))

    return found, jax.jvp(again, primals, tangents)[1]


def sum_by_mechanism(found: Layout, values: Array) -> Array:
    """Sums of values (..., block, world) over the mechanism of each moving body; of a body of none its own value."""
    number, sums = np.arange(found.block_count), [values]
    for place, links in enumerate(found.trees):
        blocks = [found.blocks[link] for link in links]
        number[blocks] = found.block_count + place
        sums.append(take(values, blocks, axis=-2).sum(-2, keepdims=True))
    return jnp.broadcast_to(take(jnp.concatenate(sums, axis=-2), number, axis=-2), values.shape)


def closing_shift(links: Links, errors: Impulses) -> Array:
    """Displacement (component, block, world) without turns that closes the joints, the floating trees about their centres.

    The place of a link follows from that of its parent: this is exact where all three translations of a joint are held. What
    is then left at the joints that close loops is shared by all.
    """
    duals = links.duals[0]
    jump = along_directions(duals, errors[:3]) * -1.0
    shift, turn = unpack(tree.follow(links.layout.tree, links.factors.offset, pack(jump, jump * 0.0)))
    if links.loops is not None:
        left = errors[6] + mechanism_loops.rates(links.loops, shift, turn)
        shift = shift + mechanism_loops.share_gaps(links.layout, mechanism_loops.gaps(links.loops, left))
    mass = 1.0 / links.inertia.inverse_mass
    for members in links.layout.floating_trees:
        of_tree = column(np.isin(np.arange(len(links.layout.links)), members))
        weight = jnp.where(of_tree, mass, 0.0)
        weight = weight / add_all_slices(weight)
        shift = shift.map(
            lambda x, weight=weight, of_tree=of_tree: x - jnp.where(of_tree, add_all_slices(weight * x), 0.0)
        )
    return to_blocks(links.layout, pack_blocks(shift, shift * 0.0))


def hold(
    links: Links,
    joint_rows: Sequence[Rows],
    velocity: Array,
    impulses: tuple[Array, ...],
    known: Impulses | None = None,
) -> tuple[Array, tuple[Array, ...], Impulses]:
    """Velocity and impulses with which the rows of mechanisms hold exactly.

    Args:
      links: mechanisms at the pose at which the rows hold.
      joint_rows: all joint rows.
      velocity: (component, block, world) with the impulses so far.
      impulses: of all groups, those of the joints first.
      known: change of the impulses of the links; None if it is not known yet.

    Returns:
      Velocity, impulses, and the change.
    """
    tables = [group.table for group in joint_rows]
    slot_count = sum(int((table.order != EMPTY).sum()) for table in tables)
    bias = collect(tables, [group.bias[:, 0] for group in joint_rows], slot_count)
    wanted = jax.tree.map(lambda rate, bias: -(rate + bias), rates(links, velocity), of_slots(links, bias))
    change = solve(links, wanted, known)
    of_all = to_slots(links.layout, change, slot_count)
    new = [
        impulse + pack_scalars(table, [select(table, of_all)], of_all.shape[-1])
        for table, impulse in zip(tables, impulses[: len(tables)], strict=True)
    ]
    return velocity + push(links, change), (*new, *impulses[len(tables) :]), change
