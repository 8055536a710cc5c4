"""Trees of blocks that hold on to one another, solved exactly in time linear in their number.

A link is a body and the joint to its parent. Relative motions of a joint are spanned by its columns; the other relative
motions are given. From the leaves to the roots each joint is eliminated: what a parent feels of all that hangs on it is one
symmetric 6x6 matrix, its articulated inertia. No matrix of rows is formed, nothing is singular, and an error of round-off in
the inertia does not part the joints.

Source: R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapter 7. All about the centres of mass, axes of the world.
Motions and forces are pairs of arrays (..., 3, world), linear part first. (XLA compiles a concatenation of the two to code
that branches for every element, and whatever is fused with it.)
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.solver import dense
from mathota_jax.spatial.indexing import in_every_world
from mathota_jax.spatial.settle import store

GROUND = -1
"""Parent of the links that hang on a static body, and of those that hang on nothing."""


Visit = Callable[[Any, Any], Any]

Pair = tuple[Array, Array]
"""Linear and angular part, (link, 3, world) or, of one link, (3, world)."""


@dataclasses.dataclass(frozen=True)
class Tree:
    """Links in depth-first order, parents first.

    Attributes:
      parents: of each link, `GROUND` for none.
      floating: links that hang on nothing.
    """

    parents: tuple[int, ...]
    floating: tuple[int, ...]


class Masses(NamedTuple):
    """Inertia of the links.

    Attributes:
      mass: (link, world).
      moments: (link, 3, 3, world).
    """

    mass: Array
    moments: Array


class Factors(NamedTuple):
    """What the elimination leaves.

    Attributes:
      masses: of the links.
      offset: (link, 3, 3, world) the matrix of the vector product with the way from the parent's centre to that of the link.
      columns: free relative motions, two of (link, column, 3, world); a column of zeros is none.
      forces: the force that a unit of each takes, likewise.
      compliance: (link, column, world) one over the inertia along each.
      roots: (3, 3) blocks of the articulated inertia of the floating links, (floating, 3, 3, world) each.
    """

    masses: Masses
    offset: Array
    columns: Pair
    forces: Pair
    compliance: Array
    roots: tuple[Array, ...]


def factorize(tree: Tree, masses: Masses, offset: Array, columns: Pair) -> Factors:
    """Eliminates the joints.

    Args:
      tree: static structure.
      masses: of the links.
      offset: (3, link, world) from the parent's centre to the link's; anything for links without parent.
      columns: free relative motions as in `Factors`.
    """
    count = len(tree.parents)
    worlds = max(leaf.shape[-1] for leaf in (*masses, offset, columns[0]))
    matrix = _cross_matrix(offset, worlds)
    unit = jnp.eye(3, dtype=columns[0].dtype)[None, :, :, None]
    linear = unit * jnp.broadcast_to(masses.mass[:, None, None], (count, 3, 3, worlds))
    angular = jnp.broadcast_to(masses.moments, (count, 3, 3, worlds))

    def eliminate(inertia: tuple[Array, ...], link: tuple[Array, Pair]) -> tuple[tuple[Array, ...], tuple]:
        across, sides = link
        forces, compliance, whole = [], [], inertia
        for side in zip(*sides, strict=True):
            inertia, force, free = _eliminate(inertia, side)
            forces.append(force)
            compliance.append(free)
        left = (_stack(forces), jnp.stack(compliance)) if forces else (sides, sides[0][:, 0])
        return _to_parent(inertia, across), (*left, whole if tree.floating else ())

    own = (linear, jnp.zeros_like(linear), angular)
    forces, compliance, whole = _inward(tree, eliminate, own, (matrix, columns))
    roots = tuple(part[np.asarray(tree.floating)] for part in whole)
    return Factors(masses, matrix, columns, forces, compliance, roots)


def force_for(tree: Tree, factors: Factors, jump: Pair, against: Pair | None = None) -> tuple[Pair, Pair]:
    """Forces on the links, from their joints, that part them as wanted, and the motions that these give.

    The motions do not come from the forces, which all but cancel each other on a light link between heavy ones.

    Args:
      tree, factors: structure and what `factorize` gives.
      jump: motion of each link relative to its parent, but for any sum of its columns.
      against: forces on the links that the joints have to work against; None for none.
    """
    worlds = max(part.shape[-1] for part in jax.tree.leaves((jump, against, factors.offset)))
    jump, against = in_every_world((jump, against), worlds)
    # Any motion that has the jumps; then the one of least energy among those that differ by columns.
    wanted = follow(tree, factors.offset, jump)
    released = respond(tree, factors, jax.tree.map(jnp.negative, _needed(factors, wanted, against)))
    motion = _add_scaled(wanted, released, 1.0)
    return force_of(tree, factors, motion, against), motion


def force_of(tree: Tree, factors: Factors, motion: Pair, against: Pair | None = None) -> Pair:
    """Forces on the links, from their joints, that give these motions; `against` as in `force_for`."""
    needed = _needed(factors, motion, against)
    return _inward(tree, lambda force, across: (_onto_parent(force, across), force), needed, factors.offset)


def _needed(factors: Factors, motion: Pair, against: Pair | None) -> Pair:
    momentum = _momentum(factors.masses, motion)
    return momentum if against is None else _add_scaled(momentum, against, 1.0)


def respond(tree: Tree, factors: Factors, impulse: Pair) -> Pair:
    """Motions of the links under impulses on them, along which their joints hold.

    Nothing that the joints take back is ever computed, as it would be from the motion of the link alone, which may be
    thousands of times larger.
    """
    columns = (factors.columns, factors.forces, factors.compliance)

    def gather(force: Pair, link: tuple) -> tuple[Pair, tuple]:
        across, columns, forces, compliance = link
        errors, whole = [], force
        for column, reaction, free in zip(
            zip(*columns, strict=True), zip(*forces, strict=True), compliance, strict=True
        ):
            errors.append(_once(_inner(column, force) * free))
            force = _add_scaled(force, reaction, -errors[-1])
        left = jnp.stack(errors) if errors else compliance
        return _onto_parent(force, across), (left, whole if tree.floating else ())

    def release(motion: Pair, link: tuple) -> Pair:
        across, columns, forces, compliance, error, own = link
        own = _add_scaled(own, _with_parent(motion, across), 1.0)
        for place in range(compliance.shape[0] - 1, -1, -1):
            column, reaction = ((part[0][place], part[1][place]) for part in (columns, forces))
            rate = _once(_inner(reaction, own) * compliance[place] + error[place])
            own = _add_scaled(own, column, -rate)
        return own

    bias = jax.tree.map(jnp.negative, impulse)
    errors, whole = _inward(tree, gather, bias, (factors.offset, *columns))
    start = jax.tree.map(jnp.zeros_like, bias)
    if tree.floating:
        places = np.asarray(tree.floating)
        inertia = in_every_world(factors.roots, bias[0].shape[-1])
        roots = _solve_roots(inertia, jax.tree.map(lambda x: x[places], whole))
        start = jax.tree.map(lambda x, root: x.at[places].set(-root), start, roots)
    return _outward(tree, release, start, (factors.offset, *columns, errors, start))


def follow(tree: Tree, offset: Array, jump: Pair) -> Pair:
    """Motions of links that move relative to their parents by `jump`; `offset` as in `Factors`."""

    def visit(motion: Pair, link: tuple[Array, Pair]) -> Pair:
        across, relative = link
        return _add_scaled(relative, _with_parent(motion, across), 1.0)

    return _outward(tree, visit, jump, (offset, jump))


def _inward(tree: Tree, visit: Visit, own: Any, links: Any) -> Any:
    """From the leaves to the roots: `visit(own + what the children pass, link)` gives what is passed on, and a result.

    Links are in depth-first order: most hand over to the next that is visited, the others leave it at a place of their
    parent's. (One array of all links, read at one place and written at another, would be copied at every link.)
    """
    direct, slot, parent_slot, slot_count = _schedule(tree)

    def body(carry: tuple[Any, Any], entry: tuple) -> tuple[tuple[Any, Any], Any]:
        passed, left = carry
        own, link, direct, slot, parent_slot = entry
        total = jax.tree.map(lambda mine, theirs: mine + jnp.where(direct[1], theirs, 0.0), own, passed)
        if slot_count:
            total = jax.tree.map(lambda mine, theirs: mine + theirs[slot], total, left)
        passed, result = visit(*_once((total, link)))
        if slot_count:
            left = jax.tree.map(
                lambda all, more: all.at[parent_slot].add(jnp.where(direct[0], 0.0, more)), left, passed
            )
        return (passed, left), result

    nothing = jax.tree.map(lambda x: jnp.zeros_like(x[0]), own)
    left = jax.tree.map(lambda x: jnp.zeros((slot_count + 1, *x.shape[1:]), x.dtype), own) if slot_count else ()
    return lax.scan(body, (nothing, left), (own, links, direct, slot, parent_slot), reverse=True)[1]


def _outward(tree: Tree, visit: Visit, like: Any, links: Any) -> Any:
    """From the roots to the leaves: `visit(result of the parent, link)`, 0 for no parent; results are as `like`."""
    direct, slot, parent_slot, slot_count = _schedule(tree)

    def body(carry: tuple[Any, Any], entry: tuple) -> tuple[tuple[Any, Any], Any]:
        last, kept = carry
        link, direct, slot, parent_slot = entry
        if slot_count:
            parent = jax.tree.map(lambda near, far: jnp.where(direct[0], near, far[parent_slot]), last, kept)
        else:
            parent = jax.tree.map(lambda near: jnp.where(direct[0], near, 0.0), last)
        result = visit(*_once((parent, link)))
        if slot_count:
            kept = jax.tree.map(
                lambda all, one: all.at[slot].set(jnp.where(slot == slot_count, 0.0, one)), kept, result
            )
        return (result, kept), result

    nothing = jax.tree.map(lambda x: jnp.zeros_like(x[0]), like)
    kept = jax.tree.map(lambda x: jnp.zeros((slot_count + 1, *x.shape[1:]), x.dtype), like) if slot_count else ()
    return lax.scan(body, (nothing, kept), (links, direct, slot, parent_slot))[1]


@functools.cache
def _schedule(tree: Tree) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Whether each link hangs on the one before, and the next on it, (link, 2); places of links and parents that branch.

    A place past the last is that of no link.
    """
    parents = np.array(tree.parents)
    direct = parents == np.arange(len(parents)) - 1
    direct[0] = False
    branching = sorted(
        {parent for parent, near in zip(tree.parents, direct, strict=True) if parent != GROUND and not near}
    )
    slots = {link: place for place, link in enumerate(branching)}
    slot = np.array([slots.get(link, len(slots)) for link in range(len(parents))], np.int32)
    parent_slot = np.array(
        [
            len(slots) if near else slots.get(parent, len(slots))
            for parent, near in zip(tree.parents, direct, strict=True)
        ],
        np.int32,
    )
    return np.stack([direct, np.append(direct[1:], False)], axis=1), slot, parent_slot, len(branching)


def _once(values: Any) -> Any:
    """Stores what XLA would compute again for every element that depends on it; the price is that of ten products."""
    return jax.tree.map(lambda value: store(value, value), values)


def _cross_matrix(vector: Array, worlds: int) -> Array:
    """(link, 3, 3, world) the matrices that multiply vectors (3, link, world) from the left."""
    x, y, z = jnp.broadcast_to(vector, (*vector.shape[:-1], worlds))
    zero = jnp.zeros_like(x)
    rows = (jnp.stack([zero, -z, y], axis=1), jnp.stack([z, zero, -x], axis=1), jnp.stack([-y, x, zero], axis=1))
    return jnp.stack(rows, axis=1)


def _apply(matrix: Array, vector: Array) -> Array:
    """Product (3, world) as a sum of columns: a reduction would not be vectorised over the worlds."""
    return matrix[:, 0] * vector[0] + matrix[:, 1] * vector[1] + matrix[:, 2] * vector[2]


def _transposed(matrix: Array) -> Array:
    return jnp.swapaxes(matrix, 0, 1)


def _inner(left: Pair, right: Pair) -> Array:
    """Inner product of (3, world) pairs."""
    parts = [a[k] * b[k] for a, b in zip(left, right, strict=True) for k in range(3)]
    return sum(parts[1:], parts[0])


def _add_scaled(pair: Pair, other: Pair, scale: Array | float) -> Pair:
    return pair[0] + other[0] * scale, pair[1] + other[1] * scale


def _stack(pairs: list[Pair]) -> Pair:
    return jnp.stack([pair[0] for pair in pairs]), jnp.stack([pair[1] for pair in pairs])


def _eliminate(inertia: tuple[Array, ...], side: Pair) -> tuple[tuple[Array, ...], Pair, Array]:
    """Inertia (blocks) when the motion `side` gives way; the force of a unit of it; one over its inertia."""
    linear, mixed, angular = inertia
    shift, turn = side
    along, about = force = _once(
        (_apply(linear, shift) + _apply(mixed, turn), _apply(_transposed(mixed), shift) + _apply(angular, turn))
    )
    # Of a column of zeros the force is 0, whatever this is.
    free = 1.0 / jnp.maximum(_inner(side, force), jnp.finfo(along.dtype).tiny)
    linear = linear - along[:, None] * (along * free)
    mixed = mixed - along[:, None] * (about * free)
    angular = angular - about[:, None] * (about * free)
    return (linear, mixed, angular), force, free


def _to_parent(inertia: tuple[Array, ...], across: Array) -> tuple[Array, Array, Array]:
    """The same inertia about the parent's centre."""
    linear, mixed, angular = inertia
    moved = _once(mixed - dense.product(linear, across))
    return linear, moved, angular + dense.product(across, moved) - dense.product(_transposed(mixed), across)


def _with_parent(motion: Pair, across: Array) -> Pair:
    """Motion at the link's centre of what moves with its parent."""
    return motion[0] - _apply(across, motion[1]), motion[1]


def _onto_parent(force: Pair, across: Array) -> Pair:
    """A force on the link about the parent's centre."""
    return force[0], force[1] + _apply(across, force[0])


def _momentum(masses: Masses, motion: Pair) -> Pair:
    """Momenta of the motions of all links."""
    turn = motion[1]
    angular = [masses.moments[:, :, k] * turn[:, k, None] for k in range(3)]
    return masses.mass[:, None] * motion[0], angular[0] + angular[1] + angular[2]


def _solve_roots(inertia: tuple[Array, ...], force: Pair) -> Pair:
    """Motions (floating, 3, world) that floating links take under forces."""
    linear, mixed, angular = inertia
    upper = jnp.concatenate([linear, mixed], axis=2)
    lower = jnp.concatenate([jnp.swapaxes(mixed, 1, 2), angular], axis=2)
    right = jnp.concatenate(force, axis=1)[:, :, None]
    motion = dense.solve(jnp.concatenate([upper, lower], axis=1), right)[:, :, 0]
    return motion[:, :3], motion[:, 3:]
