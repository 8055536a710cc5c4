"""Mechanisms at one pose: the rows of their links, factorised, and what goes between rows, links and blocks.

Joints that close loops are added to the tree of the others (`mechanism_loops`).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import Inertia, unpack_blocks
from mathota_jax.constraints import mechanism_loops
from mathota_jax.constraints.assembly import Side
from mathota_jax.constraints.joint_rows import JointRows
from mathota_jax.constraints.mechanism_layout import Layout, layout
from mathota_jax.scene import Scene
from mathota_jax.solver import tree
from mathota_jax.spatial.indexing import put, take, unstack
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once, store, store_cotangents
from mathota_jax.spatial.vector import Vec3, cross, dot, normalize, tangent_basis, where
from mathota_jax.struct import pytree, static

Impulses = tuple[Array, ...]
"""Of the three translations and then the three rotations between each link and its parent, (link, world); 0 where free.

Where there are loops, those of the rows that close them, (row, world), follow.
"""


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
    grounded = column([link.parent == tree.GROUND for link in found.links])
    offset = offset.map(lambda x: jnp.where(grounded, 0.0, x))
    # Its derivative comes from all over a step, and would be computed again for what is padded to all bodies.
    offset = store_cotangents(offset, for_one_reader=True)
    translations, rotations = compute_once(_basis(found, joints, position.x), position.x)
    fixed = lax.stop_gradient((translations, rotations, offset, inertia))
    duals, factors = _factorize(found, *fixed)
    loops = mechanism_loops.loops(found, joints, inertia, factors, yielding) if found.closings else None
    return Links(translations, rotations, offset, inertia, duals, factors, loops, found)


def column(flags: Any) -> np.ndarray:
    """Flags of links, (link, 1)."""
    return np.asarray(flags)[:, None]


def _basis(found: Layout, joints: JointRows, like: Array) -> tuple[tuple[Side, ...], tuple[Vec3, ...]]:
    is_child = np.array([link.is_child for link in found.links])

    def row(slots: np.ndarray) -> Side:
        child, parent = (take(side, slots) for side in (joints.child, joints.parent))
        if is_child.all():
            return child
        return jax.tree.map(lambda a, b: jnp.where(is_child[:, None], a, b), child, parent)

    rows = [row(slots) for slots in found.row_slots]
    held = [column(flags) for flags in found.held]
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
    shifts = [pack(dual, zero) for dual in duals[0]]
    turns = [pack(shift_of_turn(translations, duals[0], dual), dual) for dual in duals[1]]
    free = [*~found.held[3:], *~found.held[:3]]
    columns: list[tree.Pair] = []
    taken = np.zeros(len(found.links), int)
    for motion, flags in zip((*turns, *shifts), free, strict=True):
        flags[list(found.tree.floating)] = False
        for place in sorted({*taken[flags].tolist()}):
            here = flags & (taken == place)
            if place == len(columns):
                columns.append(pack(zero, zero))
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


def shift_of_turn(translations: tuple[Side, ...], duals: tuple[Vec3, ...], turn: Vec3) -> Vec3:
    """How the centre of a link moves when it turns about its joint."""
    parts = [dual * -dot(side.angular, turn) for side, dual in zip(translations, duals, strict=True)]  # type: ignore[arg-type]
    return parts[0] + parts[1] + parts[2]


def _moments(inertia: Inertia) -> Array:
    """(link, 3, 3, world) in the world frame."""
    zero = jnp.zeros_like(inertia.moments.x)
    axes = [Vec3(*(zero + float(axis == k) for axis in range(3))) for k in range(3)]
    return jnp.stack([jnp.stack(inertia.apply(axis), axis=1) for axis in axes], axis=2)


def pack(linear: Vec3, angular: Vec3) -> tree.Pair:
    """Two of (link, 3, world)."""
    return jnp.stack(linear, axis=1), jnp.stack(angular, axis=1)


def unpack(pair: tree.Pair) -> tuple[Vec3, Vec3]:
    """The reverse of `pack`."""
    return Vec3(*unstack(pair[0], 1)), Vec3(*unstack(pair[1], 1))


def rates(links: Links, velocity: Array) -> Impulses:
    """Rates along all rows of the velocities (component, block, world)."""
    return rates_of_links(links, *take(unpack_blocks(velocity), links.layout.blocks))


def rates_of_links(links: Links, linear: Vec3, angular: Vec3) -> Impulses:
    """The same of the velocities (link, world)."""
    closing = () if links.loops is None else (mechanism_loops.rates(links.loops, linear, angular),)
    parent_linear, parent_angular = (_of_parents(links.layout, part) for part in (linear, angular))
    linear = linear - parent_linear - cross(parent_angular, links.offset)
    linear, angular = _stored(links, linear, angular - parent_angular)
    found = [dot(side.linear, linear) + dot(side.angular, angular) for side in links.translations]  # type: ignore[arg-type]
    found += [dot(direction, angular) for direction in links.rotations]
    return store_cotangents(only_held(links, (*found, *closing)))


def _stored(links: Links, linear: Vec3, angular: Vec3) -> tuple[Vec3, Vec3]:
    """Vectors (link, world) that go into all six rows, computed once; linear in the vectors."""
    # Different for each component: by a divisor that they share, XLA would multiply, and copy the product.
    return Vec3(*map(store, linear, links.offset)), Vec3(*map(store, angular, links.rotations[0]))


def forces_on_links(links: Links, impulses: Impulses) -> tuple[Vec3, Vec3]:
    """Sums (link, world) of impulses, and of their moments about the centres of mass."""
    force = torque = links.offset * 0.0
    for side, impulse in zip(links.translations, impulses[:3], strict=True):
        assert side.angular is not None
        force, torque = force + side.linear * impulse, torque + side.angular * impulse
    for direction, impulse in zip(links.rotations, impulses[3:6], strict=True):
        torque = torque + direction * impulse
    force, torque = store_cotangents(_stored(links, force, torque))
    carried = torque + cross(links.offset, force)
    force, torque = force - to_parents(links.layout, force), torque - to_parents(links.layout, carried)
    if links.loops is None:
        return force, torque
    closing_force, closing_torque = mechanism_loops.forces(links.loops, impulses[6])
    return force + closing_force, torque + closing_torque


def along_directions(directions: tuple[Vec3, ...], values: Impulses) -> Vec3:
    """Sum of three directions times their values."""
    first, second, third = (direction * value for direction, value in zip(directions, values, strict=True))
    return first + second + third


def only_held(links: Links, values: Any) -> Impulses:
    """Values of rows, 0 where nothing is held."""
    of_trees = (
        value if flags.all() else jnp.where(flags[:, None], value, 0.0)
        for value, flags in zip(values[:6], links.layout.held, strict=True)
    )
    return *of_trees, *values[6:]


def of_slots(links: Links, values: Array) -> Impulses:
    """Values of rows from those in slot order."""
    closing = [take(values, links.layout.closing_slots)] if links.layout.closings else []
    return only_held(links, [*(take(values, slots) for slots in links.layout.row_slots), *closing])


def to_slots(found: Layout, values: Impulses, slot_count: int) -> Array:
    """Values in slot order, 0 for rows that mechanisms do not hold."""
    held = found.held
    closing = list(found.closing_slots)
    place = np.full(slot_count, held.size + len(closing))
    place[found.row_slots[held]] = np.flatnonzero(held)
    place[closing] = held.size + np.arange(len(closing))
    return take(jnp.concatenate([*values, jnp.zeros_like(values[0][:1])]), place)


def _of_parents(found: Layout, values: Any) -> Any:
    """Values of the parents of all links, 0 for none."""
    places = np.array([link.parent for link in found.links]) + 1
    return jax.tree.map(lambda x: take(jnp.concatenate([jnp.zeros_like(x[:1]), x]), places), values)


def to_parents(found: Layout, values: Any) -> Any:
    """Sums over the children of all links."""
    parents = np.array([link.parent for link in found.links])
    if (parents == np.arange(len(parents)) - 1).all():
        return jax.tree.map(lambda x: jnp.concatenate([x[1:], jnp.zeros_like(x[:1])]), values)
    return jax.tree.map(
        lambda x: jnp.zeros_like(x).at[np.where(parents < 0, len(parents), parents)].add(x, mode="drop"), values
    )


def to_blocks(found: Layout, values: Array) -> Array:
    """(component, block, world) from (component, link, world), 0 for other bodies."""
    return put(values, found.blocks, found.block_count, axis=1)
