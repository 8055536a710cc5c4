"""Coordinates of mechanisms: the ways in which their joints, and bodies without any, can move.

A link has one for each of its six rows that is not held: the rate along that row while the rates along its others are 0.
All is about the centres of mass.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mathota_jax.bodies import Inertia, pack_blocks, respond_alone
from mathota_jax.constraints import mechanism
from mathota_jax.constraints.mechanism_layout import Layout
from mathota_jax.constraints.mechanism_links import Links, pack, shift_of_turn, to_blocks, to_parents, unpack
from mathota_jax.solver import tree
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.spread import repeat_worlds
from mathota_jax.spatial.vector import Vec3, cross


def coordinate_count(found: Layout) -> int:
    """Number of coordinates."""
    return int((~found.held).sum()) + 6 * len(found.alone)


def motions(links: Links, worlds: int) -> Array:
    """Velocities (component, block, coordinate, world) at unit rates of the coordinates."""
    alone = _alone(links, worlds)
    rows, count = _rows(links.layout)
    if not count:
        return alone
    shifts = links.duals[0]
    turns = tuple(shift_of_turn(links.translations, shifts, turn) for turn in links.duals[1])
    nothing = [dual * 0.0 for dual in shifts]
    shift = _select(rows, (*shifts, *turns), worlds)
    turn = _select(rows, (*nothing, *links.duals[1]), worlds)
    offset = repeat_worlds(links.factors.offset, count, worlds)
    shift, turn = (vector.map(lambda x: x.reshape(len(x), -1)) for vector in (shift, turn))
    linear, angular = unpack(tree.follow(links.layout.tree, offset, pack(shift, turn)))
    moved = to_blocks(links.layout, pack_blocks(linear, angular))
    moved = moved.reshape(*moved.shape[:2], count, -1)
    return jnp.concatenate([moved, alone], axis=2)


def responses(links: Links, inertia: Inertia, worlds: int) -> Array:
    """Velocities (component, block, coordinate, world) under unit generalized impulses, with the joints held."""
    alone = respond_alone(jax.tree.map(lambda x: x[:, None], inertia), _alone(links, worlds))
    rows, count = _rows(links.layout)
    if not count:
        return alone
    nothing = links.offset * 0.0
    sides = links.translations
    force = _select(rows, (*(side.linear for side in sides), nothing, nothing, nothing), worlds)
    torque = _select(rows, (*(side.angular for side in sides), *links.rotations), worlds)  # type: ignore[arg-type]
    carried = torque + cross(links.offset.map(lambda x: x[:, None]), force)
    force, torque = force - to_parents(links.layout, force), torque - to_parents(links.layout, carried)
    flat = pack_blocks(force, torque)
    flat = to_blocks(links.layout, flat.reshape(*flat.shape[:2], -1))
    tiled = repeat_worlds(links, count, worlds)
    moved = mechanism.respond(tiled, compute_once(flat, flat))
    moved = moved.reshape(*moved.shape[:2], count, -1)
    return jnp.concatenate([moved, alone], axis=2)


def _rows(found: Layout) -> tuple[np.ndarray, int]:
    """(6, link, coordinate) whether a coordinate of the links is along a row; their number."""
    row, link = np.nonzero(~found.held)
    order = np.argsort(link, kind="stable")
    row, link = row[order], link[order]
    here = (np.arange(6)[:, None, None] == row) & (np.arange(len(found.links))[:, None] == link)
    return here, len(link)


def _select(rows: np.ndarray, of_rows: tuple[Vec3, ...], worlds: int) -> Vec3:
    """(link, coordinate, world) of the row that each coordinate is along, 0 elsewhere."""
    total = Vec3(*(jnp.zeros((*rows.shape[1:], worlds), of_rows[0].x.dtype) for _ in range(3)))
    for here, vector in zip(rows, of_rows, strict=True):
        if here.any():
            total = jax.tree.map(
                lambda own, new, here=here[..., None]: jnp.where(here, new[:, None], own), total, vector
            )
    return total


def _alone(links: Links, worlds: int) -> Array:
    """(component, block, coordinate, world) 1 for the component of the body without joints that a coordinate is, else 0."""
    found = links.layout
    component, of_block = np.tile(np.arange(6), len(found.alone)), np.repeat(np.asarray(found.alone, int), 6)
    here = (np.arange(6)[:, None, None] == component) & (np.arange(found.block_count)[:, None] == of_block)
    return jnp.broadcast_to(jnp.asarray(here, links.offset.x.dtype)[..., None], (*here.shape, worlds))
