"""Trees of blocks that hold on to one another, solved exactly in time linear in their number.

A link is a body and the joint to its parent. Relative motions of a joint are spanned by its columns; the other relative
motions are given. From the leaves to the roots each joint is eliminated: what a parent feels of all that hangs on it is one
symmetric 6x6 matrix, its articulated inertia. No matrix of rows is formed, nothing is singular, and an error of round-off in
the inertia does not part the joints.

Source: R. Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapter 7. All about the centres of mass, axes of the world.
Motions and forces are arrays (..., 6, world), linear part first.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

GROUND = -1
"""Parent of the links that hang on a static body, and of those that hang on nothing."""


@dataclasses.dataclass(frozen=True)
class Tree:
    """Links, parents first.

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
      columns: (link, column, 6, world) free relative motions; a column of zeros is none.
      forces: (link, column, 6, world) the force that a unit of each takes.
      compliance: (link, column, world) one over the inertia along each.
      roots: (3, 3) blocks of the articulated inertia of the floating links, (floating, 3, 3, world) each.
    """

    masses: Masses
    offset: Array
    columns: Array
    forces: Array
    compliance: Array
    roots: tuple[Array, Array, Array]


def factorize(tree: Tree, masses: Masses, offset: Array, columns: Array) -> Factors:
    """Eliminates the joints.

    Args:
      tree: static structure.
      masses: of the links.
      offset: (3, link, world) from the parent's centre to the link's; anything for links without parent.
      columns: (link, column, 6, world).
    """
    count, worlds = len(tree.parents), columns.shape[-1]
    matrix = _cross_matrix(offset, worlds)
    # One more for what the links without parents pass on to nobody.
    room = ((0, 1), (0, 0), (0, 0), (0, 0))
    unit = jnp.eye(3, dtype=columns.dtype)[None, :, :, None]
    linear = jnp.pad(unit * jnp.broadcast_to(masses.mass[:, None, None], (count, 3, 3, worlds)), room)
    mixed = jnp.zeros_like(linear)
    angular = jnp.pad(jnp.broadcast_to(masses.moments, (count, 3, 3, worlds)), room)

    def eliminate(inertia: tuple[Array, Array, Array], link: tuple) -> tuple[tuple[Array, Array, Array], tuple]:
        place, parent, across, sides = link
        own = tuple(part[place] for part in inertia)
        forces, compliance = [], []
        for side in sides:
            own, force, free = _eliminate(own, side)
            forces.append(force)
            compliance.append(free)
        passed = _to_parent(own, across)
        inertia = tuple(part.at[parent].add(more) for part, more in zip(inertia, passed, strict=True))
        return inertia, (jnp.stack(forces), jnp.stack(compliance))

    links = (np.arange(count), _parents(tree), matrix, columns)
    inertia, (forces, compliance) = lax.scan(eliminate, (linear, mixed, angular), links, reverse=True)
    roots = tuple(part[np.asarray(tree.floating, np.int32)] for part in inertia)
    return Factors(masses, matrix, columns, forces, compliance, roots)  # type: ignore[arg-type]


def force_for(tree: Tree, factors: Factors, jump: Array) -> Array:
    """Forces (link, 6, world) on the links, from their joints, that part them as wanted.

    Args:
      tree, factors: structure and what `factorize` gives.
      jump: (link, 6, world) motion of each link relative to its parent, but for any sum of its columns.
    """
    count, worlds = jump.shape[0], max(jump.shape[-1], factors.columns.shape[-1])
    jump = jnp.broadcast_to(jump, (*jump.shape[:-1], worlds))
    parents, none = _parents(tree), jnp.zeros((count + 1, 6, worlds), jump.dtype)

    def follow(motion: Array, link: tuple) -> tuple[Array, None]:
        place, parent, across, relative = link
        return motion.at[place].set(_with_parent(motion[parent], across) + relative), None

    # Any motion that has the jumps; then the one of least energy among those that differ by columns.
    wanted, _ = lax.scan(follow, none, (np.arange(count), parents, factors.offset, jump))
    wanted = wanted[:count]

    def gather(force: Array, link: tuple) -> tuple[Array, Array]:
        place, parent, across, columns, forces, compliance = link
        own, errors = force[place], []
        for column, reaction, free in zip(columns, forces, compliance, strict=True):
            errors.append(_inner(column, own) * free)
            own = own - reaction * errors[-1]
        return force.at[parent].add(_onto_parent(own, across)), jnp.stack(errors)

    room = ((0, 1), (0, 0), (0, 0))
    start = jnp.pad(_momentum(factors.masses, wanted), room)
    force, errors = lax.scan(
        gather,
        start,
        (np.arange(count), parents, factors.offset, factors.columns, factors.forces, factors.compliance),
        reverse=True,
    )
    released = none[:count]
    if tree.floating:
        places = np.asarray(tree.floating, np.int32)
        released = released.at[places].set(-_solve_roots(factors.roots, force[places]))

    def release(motion: Array, link: tuple) -> tuple[Array, None]:
        place, parent, across, columns, forces, compliance, error, own = link
        own = own + _with_parent(motion[parent], across)
        for column in range(columns.shape[0] - 1, -1, -1):
            rate = _inner(forces[column], own) * compliance[column] + error[column]
            own = own - columns[column] * rate
        return motion.at[place].set(own), None

    links = (np.arange(count), parents, factors.offset, factors.columns, factors.forces, factors.compliance)
    released, _ = lax.scan(release, none, (*links, errors, released))

    def carry(force: Array, link: tuple) -> tuple[Array, None]:
        place, parent, across = link
        return force.at[parent].add(_onto_parent(force[place], across)), None

    start = jnp.pad(_momentum(factors.masses, wanted + released[:count]), room)
    force, _ = lax.scan(carry, start, (np.arange(count), parents, factors.offset), reverse=True)
    return force[:count]


def _parents(tree: Tree) -> np.ndarray:
    return np.asarray([len(tree.parents) if parent == GROUND else parent for parent in tree.parents], np.int32)


def _cross_matrix(vector: Array, worlds: int) -> Array:
    """(link, 3, 3, world) the matrices that multiply vectors (3, link, world) from the left."""
    x, y, z = jnp.broadcast_to(vector, (*vector.shape[:-1], worlds))
    zero = jnp.zeros_like(x)
    rows = (jnp.stack([zero, -z, y], axis=1), jnp.stack([z, zero, -x], axis=1), jnp.stack([-y, x, zero], axis=1))
    return jnp.stack(rows, axis=1)


def _apply(matrix: Array, vector: Array) -> Array:
    """Product (3, world) as a sum of columns: a reduction would not be vectorised over the worlds."""
    return matrix[:, 0] * vector[0] + matrix[:, 1] * vector[1] + matrix[:, 2] * vector[2]


def _product(left: Array, right: Array) -> Array:
    return sum((left[:, k, None] * right[k] for k in range(1, 3)), left[:, 0, None] * right[0])


def _transposed(matrix: Array) -> Array:
    return jnp.swapaxes(matrix, 0, 1)


def _inner(left: Array, right: Array) -> Array:
    """Inner product of (6, world) arrays."""
    return sum((left[k] * right[k] for k in range(1, 6)), left[0] * right[0])


def _eliminate(inertia: tuple[Array, ...], side: Array) -> tuple[tuple[Array, ...], Array, Array]:
    """Inertia (blocks) when the motion `side` (6, world) gives way; the force of a unit of it; one over its inertia."""
    linear, mixed, angular = inertia
    along = _apply(linear, side[:3]) + _apply(mixed, side[3:])
    about = _apply(_transposed(mixed), side[:3]) + _apply(angular, side[3:])
    force = jnp.concatenate([along, about])
    weight = _inner(side, force)
    free = jnp.where(weight > 0, 1.0 / jnp.where(weight > 0, weight, 1.0), 0.0)
    shared = force * free
    linear = linear - along[:, None] * shared[:3]
    mixed = mixed - along[:, None] * shared[3:]
    angular = angular - about[:, None] * shared[3:]
    return (linear, mixed, angular), force, free


def _to_parent(inertia: tuple[Array, ...], across: Array) -> tuple[Array, Array, Array]:
    """The same inertia about the parent's centre."""
    linear, mixed, angular = inertia
    moved = mixed - _product(linear, across)
    return linear, moved, angular + _product(across, moved) - _product(_transposed(mixed), across)


def _with_parent(motion: Array, across: Array) -> Array:
    """Motion at the link's centre of what moves with its parent."""
    return jnp.concatenate([motion[:3] - _apply(across, motion[3:]), motion[3:]])


def _onto_parent(force: Array, across: Array) -> Array:
    """A force on the link about the parent's centre."""
    return jnp.concatenate([force[:3], force[3:] + _apply(across, force[:3])])


def _momentum(masses: Masses, motion: Array) -> Array:
    """Momenta (link, 6, world) of motions."""
    linear = masses.mass[:, None] * motion[:, :3]
    angular = sum((masses.moments[:, :, k] * motion[:, 3 + k, None] for k in range(1, 3)), jnp.zeros(()))
    angular = angular + masses.moments[:, :, 0] * motion[:, 3, None]
    return jnp.concatenate([linear, angular], axis=1)


def _solve_roots(inertia: tuple[Array, Array, Array], force: Array) -> Array:
    """Motions (floating, 6, world) that floating links take under forces."""
    linear, mixed, angular = inertia
    upper = jnp.concatenate([linear, mixed], axis=2)
    lower = jnp.concatenate([jnp.swapaxes(mixed, 1, 2), angular], axis=2)
    rows = jnp.concatenate([jnp.concatenate([upper, lower], axis=1), force[:, :, None]], axis=2)

    def pivot(rows: Array, place: Array) -> tuple[Array, None]:
        # Gauss-Jordan: positive definite, and so without exchanges.
        row = lax.dynamic_index_in_dim(rows, place, axis=1)
        row = row / lax.dynamic_index_in_dim(row, place, axis=2)
        others = lax.dynamic_index_in_dim(rows, place, axis=2)
        is_pivot = (jnp.arange(6) == place)[None, :, None, None]
        return jnp.where(is_pivot, row, rows - others * row), None

    rows, _ = lax.scan(pivot, rows, jnp.arange(6))
    return rows[:, :, 6]

