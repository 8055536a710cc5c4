"""Mechanisms: trees of joints, whose rows that hold are solved together, exactly.

One row after the other, an error travels one joint a sweep: n links need n^2 sweeps, and what is left over from each step
grows at large ones. Rows that hold have no bounds to respect, and the impulses with which all of a tree do follow from a few
passes over its bodies (`solver.tree`). Rows of other laws and contacts are left to the sweeps, which start from the exact
impulses and are followed by one more exact solution. With nothing but rows that hold no sweep is needed at all.

Joints that close loops are added to the tree of the others (`mechanism_loops`).
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, mlir

from mathota_jax.bodies import Inertia, pack_blocks, unpack_blocks
from mathota_jax.constraints import mechanism_loops
from mathota_jax.constraints.assembly import Side, collect, pack_scalars, select
from mathota_jax.constraints.joint_rows import JointRows
from mathota_jax.constraints.mechanism_layout import Layout, layout
from mathota_jax.scene import Scene
from mathota_jax.solver import tree
from mathota_jax.solver.rows import Rows
from mathota_jax.solver.table import EMPTY
from mathota_jax.spatial.indexing import in_every_world, take, unstack
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once, store, store_cotangents
from mathota_jax.spatial.vector import Vec3, cross, dot, normalize, tangent_basis, where
from mathota_jax.struct import pytree, static

ROUNDS = 1
"""Times that joints are closed by impulses before what is left of the gaps is taken by shifting links.

Two change nothing for ten and twenty links at 1/60 s, and little for a heavy end.
"""

LOOP_ROUNDS = 2
"""The same where there are loops. A bridge as long as its span opens by half as much with two as with one."""

Impulses = tuple[Array, ...]
"""Of the three translations and then the three rotations between each link and its parent, (link, world); 0 where free.

Where there are loops, those of the rows that close them, (row, world), follow.
"""


class Solutions(NamedTuple):
    """What `solve` finds in a step.

    Attributes:
      held: impulses of the step where there are mechanisms alone, else None.
      closed: those that close the joints at its end, of all rounds, (round, link, world).
    """

    held: Impulses | None
    closed: Impulses


@pytree
class Links:
    """All mechanisms at one pose; components (link, world).

    Attributes:
      translations: Jacobians, on the link, of the three translations relative to its parent: those that are held, completed
        by others.
      rotations: directions of the three rotations, likewise.
      offset: from the parent's centre of mass to the link's, 0 without parent.
      inertia: of the links.
      duals: translations and rotations along which one of the above is 1 and the others are 0.
      factors: of the elimination.
      loops: rows that close loops; None where there are none.
      layout: which links there are.
    """

    translations: tuple[Side, ...]
    rotations: tuple[Vec3, ...]
    offset: Vec3
    inertia: Inertia
    duals: tuple[tuple[Vec3, ...], tuple[Vec3, ...]]
    factors: tree.Factors
    loops: mechanism_loops.Loops | None
    layout: Layout = static()


def rounds(scene: Scene) -> int:
    """How often the joints of a scene with mechanisms are closed at the end of a step."""
    found = layout(scene)
    assert found is not None
    if not scene.options.position_iterations:
        return 0
    return LOOP_ROUNDS if found.closings else ROUNDS


def links(scene: Scene, joints: JointRows, position: Vec3, inertia: Inertia, yielding: Array | None = None) -> Links:
    """The mechanisms of a scene at given poses.

    Args:
      scene: that has some.
      joints: rows at these poses.
      position: of the moving bodies.
      inertia: with which the moving bodies respond.
      yielding: how far rows (slot, world) that close loops give way, see `mechanism_loops`.
    """
    found = layout(scene)
    assert found is not None
    inertia, position = take((inertia, position), found.blocks)
    offset = position - _of_parents(found, position)
    grounded = _column([link.parent == tree.GROUND for link in found.links])
    offset = offset.map(lambda x: jnp.where(grounded, 0.0, x))
    translations, rotations = compute_once(_basis(found, joints, position.x), position.x)
    fixed = lax.stop_gradient((translations, rotations, offset, inertia))
    duals, factors = _factorize(found, *fixed)
    loops = mechanism_loops.loops(found, joints, inertia, factors, yielding) if found.closings else None
    return Links(translations, rotations, offset, inertia, duals, factors, loops, found)


def _column(flags: Any) -> np.ndarray:
    return np.asarray(flags)[:, None]


def _basis(found: Layout, joints: JointRows, like: Array) -> tuple[tuple[Side, ...], tuple[Vec3, ...]]:
    is_child = np.array([link.is_child for link in found.links])

    def row(slots: np.ndarray) -> Side:
        child, parent = (take(side, slots) for side in (joints.child, joints.parent))
        if is_child.all():
            return child
        return jax.tree.map(lambda a, b: jnp.where(is_child[:, None], a, b), child, parent)

    rows = [row(slots) for slots in found.row_slots]
    held = [_column(flags) for flags in found.held]
    zero = jnp.zeros_like(like)
    units = [Vec3(*(zero + float(axis == k) for axis in range(3))) for k in range(3)]
    linear = _complete([side.linear for side in rows[:3]], held[:3], units)
    angular = [
        Vec3(*(jnp.where(flags, x, 0.0) for x in side.angular))  # type: ignore[misc]
        for side, flags in zip(rows[:3], held[:3], strict=True)
    ]
    rotations = _complete([side.angular for side in rows[3:]], held[3:], units)
    return tuple(Side(*pair) for pair in zip(linear, angular, strict=True)), tuple(rotations)


def _complete(rows: list[Any], held: list[np.ndarray], units: list[Vec3]) -> list[Vec3]:
    """Three independent directions of which the first are those that are held."""
    first, second, third = rows
    counts = np.sum(held, axis=0)
    if (counts == 3).all():
        return [first, second, third]
    found = units
    if (counts == 1).any():
        beside = tangent_basis(normalize(first))
        found = [where(counts == 1, new, old) for new, old in zip((first, *beside), found, strict=True)]
    if (counts >= 2).any():
        across = cross(first, second)
        full = where(counts == 3, third, across) if (counts == 3).any() else across
        found = [where(counts >= 2, new, old) for new, old in zip((first, second, full), found, strict=True)]
    return found


def _factorize(
    found: Layout, translations: tuple[Side, ...], rotations: tuple[Vec3, ...], offset: Vec3, inertia: Inertia
) -> tuple[tuple[tuple[Vec3, ...], tuple[Vec3, ...]], tree.Factors]:
    duals = compute_once((_dual([side.linear for side in translations]), _dual(rotations)), offset.x)
    zero = offset * 0.0
    shifts = [_pack(dual, zero) for dual in duals[0]]
    turns = [_pack(_shift_of_turn(translations, duals[0], dual), dual) for dual in duals[1]]
    free = [*~found.held[3:], *~found.held[:3]]
    columns: list[tree.Pair] = []
    taken = np.zeros(len(found.links), int)
    for motion, flags in zip((*turns, *shifts), free, strict=True):
        flags[list(found.tree.floating)] = False
        for place in sorted({*taken[flags].tolist()}):
            here = flags & (taken == place)
            if place == len(columns):
                columns.append(_pack(zero, zero))
            columns[place] = jax.tree.map(
                lambda new, old, here=here[:, None, None]: new if here.all() else jnp.where(here, new, old),
                motion,
                columns[place],
            )
        taken += flags
    masses = tree.Masses(1.0 / inertia.inverse_mass, _moments(inertia))
    none = jnp.zeros((len(found.links), 0, 3, zero.x.shape[-1]), zero.x.dtype)
    stacked = jax.tree.map(lambda *parts: jnp.stack(parts, axis=1), *columns) if columns else (none, none)
    return duals, tree.factorize(found.tree, masses, jnp.stack(offset), stacked)


def _dual(rows: Any) -> tuple[Vec3, ...]:
    """Vectors along which one of three directions is 1 and the others are 0."""
    first, second, third = rows
    volumes = (cross(second, third), cross(third, first), cross(first, second))
    volume = dot(first, volumes[0])
    scale = safe_divide(jnp.ones_like(volume), volume)
    return tuple(side * scale for side in volumes)


def _shift_of_turn(translations: tuple[Side, ...], duals: tuple[Vec3, ...], turn: Vec3) -> Vec3:
    """How the centre of a link moves when it turns about its joint."""
    parts = [dual * -dot(side.angular, turn) for side, dual in zip(translations, duals, strict=True)]  # type: ignore[arg-type]
    return parts[0] + parts[1] + parts[2]


def _moments(inertia: Inertia) -> Array:
    """(link, 3, 3, world) in the world frame."""
    zero = jnp.zeros_like(inertia.moments.x)
    axes = [Vec3(*(zero + float(axis == k) for axis in range(3))) for k in range(3)]
    return jnp.stack([jnp.stack(inertia.apply(axis), axis=1) for axis in axes], axis=2)


def _pack(linear: Vec3, angular: Vec3) -> tree.Pair:
    """Two of (link, 3, world)."""
    return jnp.stack(linear, axis=1), jnp.stack(angular, axis=1)


def _unpack(pair: tree.Pair) -> tuple[Vec3, Vec3]:
    return Vec3(*unstack(pair[0], 1)), Vec3(*unstack(pair[1], 1))


def rates(links: Links, velocity: Array) -> Impulses:
    """Rates along all rows of the velocities (component, block, world)."""
    linear, angular = take(unpack_blocks(velocity), links.layout.blocks)
    closing = () if links.loops is None else (mechanism_loops.rates(links.loops, linear, angular),)
    parent_linear, parent_angular = (_of_parents(links.layout, part) for part in (linear, angular))
    linear = linear - parent_linear - cross(parent_angular, links.offset)
    linear, angular = _stored(links, linear, angular - parent_angular)
    found = [dot(side.linear, linear) + dot(side.angular, angular) for side in links.translations]  # type: ignore[arg-type]
    found += [dot(direction, angular) for direction in links.rotations]
    return store_cotangents(_held(links, (*found, *closing)))


def _stored(links: Links, linear: Vec3, angular: Vec3) -> tuple[Vec3, Vec3]:
    """Vectors (link, world) that go into all six rows, computed once; linear in the vectors."""
    # Different for each component: by a divisor that they share, XLA would multiply, and copy the product.
    return Vec3(*map(store, linear, links.offset)), Vec3(*map(store, angular, links.rotations[0]))


def push(links: Links, impulses: Impulses) -> Array:
    """Change of the velocities (component, block, world) by impulses."""
    force = torque = links.offset * 0.0
    for side, impulse in zip(links.translations, impulses[:3], strict=True):
        assert side.angular is not None
        force, torque = force + side.linear * impulse, torque + side.angular * impulse
    for direction, impulse in zip(links.rotations, impulses[3:6], strict=True):
        torque = torque + direction * impulse
    force, torque = store_cotangents(_stored(links, force, torque))
    carried = torque + cross(links.offset, force)
    force, torque = force - _to_parents(links.layout, force), torque - _to_parents(links.layout, carried)
    if links.loops is not None:
        force, torque = map(operator.add, (force, torque), mechanism_loops.forces(links.loops, impulses[6]))
    return _to_blocks(links.layout, pack_blocks(force * links.inertia.inverse_mass, links.inertia.solve(torque)))


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
        changes = _changes(links, _held(links, impulses))
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
    right = _held(links, jax.tree.map(jnp.subtract, d_wanted, changes))
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
    turn = compute_once(_combine(duals[1], wanted[3:]), wanted[0])
    shift = _combine(duals[0], wanted[:3]) + _shift_of_turn(translations, duals[0], turn)
    shift = compute_once(shift, wanted[0])
    force = tree.force_for(links.layout.tree, links.factors, _pack(shift, turn))
    along, about = _unpack(force)
    linear = [dot(dual, along) for dual in duals[0]]
    for side, impulse in zip(translations, linear, strict=True):
        about = about - side.angular * impulse
    return compute_once(_held(links, [*linear, *(dot(dual, about) for dual in duals[1])]), wanted[0])


@jax.custom_jvp
def respond(links: Links, impulse: Array) -> Array:
    """Velocities (component, block, world) under impulses on the bodies, likewise, with the joints held.

    Differentiable in both modes.
    """
    of_links = take(unpack_blocks(impulse), links.layout.blocks)
    worlds = max(impulse.shape[-1], links.factors.offset.shape[-1])
    motion = tree.respond(links.layout.tree, links.factors, in_every_world(_pack(*of_links), worlds))
    if links.loops is not None:
        motion = mechanism_loops.respond_to(links.loops, motion)
    return _to_blocks(links.layout, pack_blocks(*_unpack(motion)))


@respond.defjvp
def _respond_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    found = respond(*primals)

    def again(links: Links, impulse: Array) -> Array:
        """The same from the bodies alone, whose motion along the rows is taken back."""
        force, torque = take(unpack_blocks(impulse), links.layout.blocks)
        alone = pack_blocks(force * links.inertia.inverse_mass, links.inertia.solve(torque))
        excess = _to_blocks(links.layout, alone) - found
        # Of what is found the rates are 0, but not once the rows turn.
        wanted = jax.tree.map(lambda *parts: -sum(parts), rates(links, excess), rates(links, found))
        return excess + push(links, solve(links, wanted))

    return found, jax.jvp(again, primals, tangents)[1]


def _combine(directions: tuple[Vec3, ...], values: Impulses) -> Vec3:
    first, second, third = (direction * value for direction, value in zip(directions, values, strict=True))
    return first + second + third


def _held(links: Links, values: Any) -> Impulses:
    """Values of rows, 0 where nothing is held."""
    of_trees = (
        value if flags.all() else jnp.where(flags[:, None], value, 0.0)
        for value, flags in zip(values[:6], links.layout.held, strict=True)
    )
    return *of_trees, *values[6:]


def of_slots(links: Links, values: Array) -> Impulses:
    """Values of rows from those in slot order."""
    closing = [take(values, links.layout.closing_slots)] if links.layout.closings else []
    return _held(links, [*(take(values, slots) for slots in links.layout.row_slots), *closing])


def to_slots(links: Links, values: Impulses, slot_count: int) -> Array:
    """Values in slot order, 0 for rows that mechanisms do not hold."""
    held = links.layout.held
    closing = list(links.layout.closing_slots)
    place = np.full(slot_count, held.size + len(closing))
    place[links.layout.row_slots[held]] = np.flatnonzero(held)
    place[closing] = held.size + np.arange(len(closing))
    return take(jnp.concatenate([*values, jnp.zeros_like(values[0][:1])]), place)


def closing_shift(links: Links, errors: Impulses) -> Array:
    """Displacement (component, block, world) without turns that closes the joints, the floating trees about their centres.

    The place of a link follows from that of its parent: this is exact where all three translations of a joint are held. What
    is then left at the joints that close loops is shared by all.
    """
    duals = links.duals[0]
    jump = _combine(duals, errors[:3]) * -1.0
    shift, turn = _unpack(tree.follow(links.layout.tree, links.factors.offset, _pack(jump, jump * 0.0)))
    if links.loops is not None:
        left = errors[6] + mechanism_loops.rates(links.loops, shift, turn)
        shift = shift + mechanism_loops.share_gaps(links.layout, mechanism_loops.gaps(links.loops, left))
    mass = 1.0 / links.inertia.inverse_mass
    for members in links.layout.floating_trees:
        of_tree = _column(np.isin(np.arange(len(links.layout.links)), members))
        weight = jnp.where(of_tree, mass, 0.0)
        weight = weight / weight.sum(0)
        shift = shift.map(lambda x, weight=weight, of_tree=of_tree: x - jnp.where(of_tree, (weight * x).sum(0), 0.0))
    return _to_blocks(links.layout, pack_blocks(shift, shift * 0.0))


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
    of_all = to_slots(links, change, slot_count)
    new = [
        impulse + pack_scalars(table, [select(table, of_all)], of_all.shape[-1])
        for table, impulse in zip(tables, impulses[: len(tables)], strict=True)
    ]
    return velocity + push(links, change), (*new, *impulses[len(tables) :]), change


def _of_parents(found: Layout, values: Any) -> Any:
    """Values of the parents of all links, 0 for none."""
    places = np.array([link.parent for link in found.links]) + 1
    return jax.tree.map(lambda x: take(jnp.concatenate([jnp.zeros_like(x[:1]), x]), places), values)


def _to_parents(found: Layout, values: Any) -> Any:
    """Sums over the children of all links."""
    parents = np.array([link.parent for link in found.links])
    if (parents == np.arange(len(parents)) - 1).all():
        return jax.tree.map(lambda x: jnp.concatenate([x[1:], jnp.zeros_like(x[:1])]), values)
    return jax.tree.map(
        lambda x: jnp.zeros_like(x).at[np.where(parents < 0, len(parents), parents)].add(x, mode="drop"), values
    )


def _to_blocks(found: Layout, values: Array) -> Array:
    """(component, block, world) from (component, link, world), 0 for other bodies."""
    place = np.full(found.block_count, len(found.links))
    place[list(found.blocks)] = np.arange(len(found.links))
    if len(found.links) < found.block_count:
        values = jnp.concatenate([values, jnp.zeros_like(values[:, :1])], axis=1)
    return take(values, place, axis=1)
