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
    forces_on_links,
    of_slots,
    only_held,
    pack,
    rates,
    rates_of_links,
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


class Solution(NamedTuple):
    """Impulses, and what they change.

    Attributes:
      impulses: of the rows.
      motion: velocities of the links (link, 3, world). They do not come from the impulses: on a light link between heavy
        ones these all but cancel each other, and what their round-off made of a carriage of 1 g under 12 kg grew from step
        to step.
    """

    impulses: Impulses
    motion: tree.Pair

    def change(self, links: Links) -> Array:
        """Change of the velocities (component, block, world)."""
        return to_blocks(links.layout, pack_blocks(*unpack(self.motion)))


class Solutions(NamedTuple):
    """What `solve` finds in a step.

    Attributes:
      held: of the step where there are mechanisms alone, else None.
      closed: what closes the joints at its end, of all rounds, (round, link, ...).
    """

    held: Solution | None
    closed: Solution


def rounds(scene: Scene) -> int:
    """How often the joints of a scene with mechanisms are closed at the end of a step."""
    found = layout(scene)
    assert found is not None
    if not scene.options.position_iterations:
        return 0
    return LOOP_ROUNDS if found.closings else ROUNDS


def solve(links: Links, wanted: Impulses, known: Solution | None = None) -> Solution:
    """Impulses that change the rates of the rows by `wanted`; differentiable in both modes.

    Where the solution is `known`, derivatives are computed without finding it again.
    """
    leaves = jax.tree.leaves((wanted, known, links.factors.offset, links.offset.x))
    wanted, known = in_every_world((wanted, known), max(leaf.shape[-1] for leaf in leaves))
    if known is None:
        known = _solution(*lax.stop_gradient((links, wanted)))
    return _as_found(links, wanted, None, known)


def _as_found(links: Links, wanted: Impulses | None, against: tree.Pair | None, found: Solution) -> Solution:
    """What was found, with the derivative of the solution; arguments as of `_solution`, None for 0."""
    leaves, structure = jax.tree.flatten((links, wanted, against, lax.stop_gradient(found)))
    return jax.tree.unflatten(jax.tree.structure(found), _solution_p.bind(*leaves, structure=structure))


def _linear_solve(links: Links, right: Solution) -> Solution:
    """Solution x of ``_product(links, x) = right``; differentiable in both modes."""
    return lax.custom_linear_solve(
        lambda x: _product(links, x), right, lambda _, right: _solution(links, *right), symmetric=True
    )


def _product(links: Links, solution: Solution) -> Solution:
    """The symmetric system ``J v = wanted`` (and rows that close loops give way), ``J^T impulses - M v = 0``.

    In the place of impulses where nothing is held: themselves.
    """
    linear, angular = unpack(solution.motion)
    changes = rates_of_links(links, linear, angular)
    of_trees = (
        jnp.where(flags[:, None], change, impulse)
        for flags, change, impulse in zip(links.layout.held, changes[:6], solution.impulses[:6], strict=True)
    )
    closing = changes[6:]
    if links.loops is not None:
        closing = (changes[6] + links.loops.compliance * solution.impulses[6],)
    force, torque = forces_on_links(links, only_held(links, solution.impulses))
    left = pack(force - linear * (1.0 / links.inertia.inverse_mass), torque - links.inertia.apply(angular))
    return Solution((*of_trees, *closing), left)


def _known(*leaves: Array, structure: Any) -> list[Array]:
    return jax.tree.leaves(jax.tree.unflatten(structure, leaves)[3])


def _solution_jvp(
    primals: Sequence[Array], tangents: Sequence[Any], *, structure: Any
) -> tuple[list[Array], list[Array]]:
    links, _, _, known = jax.tree.unflatten(structure, primals)
    instantiated = [ad.instantiate_zeros(tangent) for tangent in tangents]
    d_links, d_wanted, d_against, _ = jax.tree.unflatten(structure, instantiated)
    # Not `known` itself, which is constant: this depends on the links and wanted rates when it is differentiated again.
    leaves = tuple(_solution_p.bind(*primals, structure=structure))
    found = jax.tree.unflatten(jax.tree.structure(known), leaves)
    changes = jax.jvp(lambda links: _product(links, found), (links,), (d_links,))[1]
    rates, momentum = jax.tree.map(jnp.negative, changes)
    if d_wanted is not None:
        rates = jax.tree.map(jnp.add, d_wanted, rates)
    if d_against is not None:
        momentum = jax.tree.map(jnp.add, d_against, momentum)
    return list(leaves), jax.tree.leaves(_linear_solve(links, Solution(only_held(links, rates), momentum)))


# A primitive: a `custom_jvp` loses its rule where JAX splits a program into what is known and what is linear, and with it
# the second derivatives.
_solution_p = Primitive("solution")
_solution_p.multiple_results = True
_solution_p.def_impl(_known)
_solution_p.def_abstract_eval(
    lambda *leaves, structure: [ShapedArray(x.shape, x.dtype) for x in _known(*leaves, structure=structure)]
)
ad.primitive_jvps[_solution_p] = _solution_jvp
mlir.register_lowering(_solution_p, mlir.lower_fun(_known, multiple_results=True))


def _solution(links: Links, wanted: Impulses, against: tree.Pair | None = None) -> Solution:
    """Solution of `_product`, without derivatives: joints part as `wanted` against forces on the links."""
    found = _of_trees(links, wanted[:6], against)
    if links.loops is None:
        return found
    left = wanted[6] - mechanism_loops.rates(links.loops, *unpack(found.motion))
    closing = mechanism_loops.impulses(links.loops, compute_once(left, left))
    impulses, motion = _of_trees(links, wanted[:6], _against_closing(links, closing, against))
    return Solution((*impulses, closing), motion)


def _of_trees(links: Links, wanted: Impulses, against: tree.Pair | None) -> Solution:
    """The same where nothing closes loops."""
    duals = links.duals
    # Each goes into all components of a motion.
    wanted = compute_once(wanted, wanted[0])
    turn = compute_once(along_directions(duals[1], wanted[3:]), wanted[0])
    shift = along_directions(duals[0], wanted[:3]) + shift_of_turn(links.translations, duals[0], turn)
    shift = compute_once(shift, wanted[0])
    force, motion = tree.force_for(links.layout.tree, links.factors, pack(shift, turn), against)
    return Solution(*compute_once((_of_rows(links, force), motion), wanted[0]))


def _of_rows(links: Links, force: tree.Pair) -> Impulses:
    """Impulses of the rows of trees that are these forces of the joints on the links."""
    along, about = unpack(force)
    linear = [dot(dual, along) for dual in links.duals[0]]
    for side, impulse in zip(links.translations, linear, strict=True):
        about = about - side.angular * impulse
    return only_held(links, [*linear, *(dot(dual, about) for dual in links.duals[1])])


def _against_closing(links: Links, closing: Array, against: tree.Pair | None) -> tree.Pair:
    """What the joints of trees work against where others close loops with impulses (row, world)."""
    assert links.loops is not None
    pulls = pack(*(-part for part in mechanism_loops.forces(links.loops, closing)))
    return pulls if against is None else jax.tree.map(jnp.add, against, pulls)


def respond(links: Links, impulse: Array) -> Array:
    """Velocities (component, block, world) under impulses on the bodies, likewise, with the joints held.

    Differentiable in both modes.
    """
    of_links = take(unpack_blocks(impulse), links.layout.blocks)
    worlds = max(impulse.shape[-1], links.factors.offset.shape[-1])
    against = in_every_world(pack(*(-part for part in of_links)), worlds)
    return _as_found(links, None, against, _response(*lax.stop_gradient((links, against)))).change(links)


def _response(links: Links, against: tree.Pair) -> Solution:
    """`_solution` where the joints hold."""
    motion, closing = tree.respond(links.layout.tree, links.factors, jax.tree.map(jnp.negative, against)), ()
    if links.loops is not None:
        motion, found = mechanism_loops.respond_to(links.loops, motion)
        closing, against = (found,), _against_closing(links, found, against)
    force = tree.force_of(links.layout.tree, links.factors, motion, against)
    return Solution((*_of_rows(links, force), *closing), motion)


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
    known: Solution | None = None,
) -> tuple[Array, tuple[Array, ...], Solution]:
    """Velocity and impulses with which the rows of mechanisms hold exactly.

    Args:
      links: mechanisms at the pose at which the rows hold.
      joint_rows: all joint rows.
      velocity: (component, block, world) with the impulses so far.
      impulses: of all groups, those of the joints first.
      known: solution for the links; None if it is not known yet.

    Returns:
      Velocity, impulses, and the solution.
    """
    tables = [group.table for group in joint_rows]
    slot_count = sum(int((table.order != EMPTY).sum()) for table in tables)
    bias = collect(tables, [group.bias[:, 0] for group in joint_rows], slot_count)
    wanted = jax.tree.map(lambda rate, bias: -(rate + bias), rates(links, velocity), of_slots(links, bias))
    found = solve(links, wanted, known)
    of_all = to_slots(links.layout, found.impulses, slot_count)
    new = [
        impulse + pack_scalars(table, [select(table, of_all)], of_all.shape[-1])
        for table, impulse in zip(tables, impulses[: len(tables)], strict=True)
    ]
    return velocity + found.change(links), (*new, *impulses[len(tables) :]), found
