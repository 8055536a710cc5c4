"""Joints that close loops of links, solved exactly beside the tree of the others.

A loop is a tree and some rows more. What a unit impulse of each such row does to the tree makes a small dense matrix, the
Schur complement of the rows of the tree; with the impulses that follow from it the tree is solved once more.

Where loops say the same twice, as the hinges of a plane four-bar linkage do of what leaves its plane, or stretch to their
full length, the matrix is singular. So each row gives way a little: the system then has one solution everywhere, close to
the impulses of least norm, and a derivative that is finite and that of the very solution found. (Those of least norm
themselves jump, and their derivative has no bound, where a loop passes through a pose of lower rank.)
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.bodies import Inertia
from mathota_jax.constraints.assembly import Side, inner, respond
from mathota_jax.constraints.joint_rows import JointRows
from mathota_jax.constraints.mechanism_layout import Layout
from mathota_jax.solver import dense, tree
from mathota_jax.spatial.indexing import take, unstack
from mathota_jax.spatial.settle import compute_once
from mathota_jax.spatial.spread import add_scaled, repeat_worlds
from mathota_jax.spatial.vector import Vec3
from mathota_jax.struct import pytree, static

COMPLIANCE = 2 / 3
"""How far a row gives way: this power of the machine epsilon, relative to the motion that its two bodies alone allow.

A balance: less, and round-off becomes impulses that cancel each other; more, and a loop that is nearly stretched opens.
"""


@pytree
class Loops:
    """The rows that close loops, at one pose.

    Attributes:
      parent, child: Jacobians, components (row, world).
      responses: linear and angular motions (link, 3, row, world) of the trees under a unit impulse of each row.
      matrix: (row, row, world) what a unit impulse of the second does to the rate of the first, compliance included.
      inverse: of it.
      compliance: (row, world).
      layout: which links they are rows of.
    """

    parent: Side
    child: Side
    responses: tree.Pair
    matrix: Array
    inverse: Array
    compliance: Array
    layout: Layout = static()


def loops(
    found: Layout, joints: JointRows, inertia: Inertia, factors: tree.Factors, yielding: Array | None = None
) -> Loops:
    """The rows that close loops.

    Args:
      found: mechanisms with loops.
      joints: rows at the pose.
      inertia: of the links.
      factors: of the trees.
      yielding: of each row (slot, world), how far it gives way beyond `COMPLIANCE`; None for nothing.
    """
    slots = np.asarray(found.closing_slots)
    worlds = max(leaf.shape[-1] for leaf in jax.tree.leaves((joints.parent, factors)))
    like = jnp.zeros((len(slots), worlds), joints.error.dtype)
    sides = jax.tree.map(lambda x: x + like, take((joints.parent, joints.child), slots))
    sides = compute_once(sides, like)
    more = jnp.zeros(()) if yielding is None else take(yielding, slots)
    parent, child = sides
    responses, matrix, inverse, compliance = lax.stop_gradient(_condense(found, sides, inertia, factors, more))
    return Loops(parent, child, responses, matrix, inverse, compliance, found)


def _condense(
    found: Layout, sides: tuple[Side, Side], inertia: Inertia, factors: tree.Factors, yielding: Array
) -> tuple[tree.Pair, Array, Array, Array]:
    """Responses, matrix, its inverse and compliance."""
    count, worlds = sides[0].linear.x.shape
    places = _places(found)
    alone = jnp.zeros((count, worlds), sides[0].linear.x.dtype)
    for side, of_side in zip(sides, places, strict=True):
        of_row = take(inertia, np.maximum(of_side, 0))
        alone = alone + jnp.where((of_side >= 0)[:, None], inner(side, respond(side, of_row)), 0.0)
    compliance = (jnp.finfo(alone.dtype).eps ** COMPLIANCE + yielding) * alone
    units = jnp.repeat(jnp.eye(count, dtype=alone.dtype), worlds, axis=1)
    of_rows, side_by_side = repeat_worlds((sides, factors), count, worlds)
    force, torque = _forces(found, of_rows, units)
    motion = compute_once(tree.respond(found.tree, side_by_side, (_packed(force), _packed(torque))), units)
    matrix = _rates(found, of_rows, *(Vec3(*unstack(part, 1)) for part in motion)).reshape(count, count, worlds)
    unit = jnp.broadcast_to(jnp.eye(count, dtype=alone.dtype)[..., None], matrix.shape)
    matrix = 0.5 * (matrix + jnp.swapaxes(matrix, 0, 1)) + unit * compliance
    inverse = dense.solve(matrix[None], unit[None])
    responses = jax.tree.map(lambda x: x.reshape(*x.shape[:2], count, worlds), motion)
    return responses, matrix, inverse[0], compliance


def _packed(components: Vec3) -> Array:
    return jnp.stack(components, axis=1)


def _places(found: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Links of each row, as parent and as child."""
    rows = [closing for closing in found.closings for _ in closing.rows]
    return np.array([row.parent for row in rows]), np.array([row.child for row in rows])


def rates(loops: Loops, linear: Vec3, angular: Vec3) -> Array:
    """Rates (row, world) of velocities of the links."""
    return _rates(loops.layout, (loops.parent, loops.child), linear, angular)


def _rates(found: Layout, sides: tuple[Side, Side], linear: Vec3, angular: Vec3) -> Array:
    # The last is the ground, which is where -1 points.
    padded = jax.tree.map(lambda x: jnp.concatenate([x, jnp.zeros_like(x[:1])]), (linear, angular))
    parts = [
        inner(side, Side(*take(padded, np.where(places < 0, len(found.links), places))))
        for side, places in zip(sides, _places(found), strict=True)
    ]
    return parts[0] + parts[1]


def forces(loops: Loops, impulses: Array) -> tuple[Vec3, Vec3]:
    """Forces and torques on the links by impulses (row, world)."""
    return _forces(loops.layout, (loops.parent, loops.child), impulses)


def _forces(found: Layout, sides: tuple[Side, Side], impulses: Array) -> tuple[Vec3, Vec3]:
    def total(parts: list[Array]) -> Array:
        worlds = max(part.shape[-1] for part in parts)
        nothing = jnp.zeros((len(found.links), worlds), impulses.dtype)
        for part, places in zip(parts, _places(found), strict=True):
            nothing = nothing.at[np.where(places < 0, len(found.links), places)].add(part, mode="drop")
        return nothing

    linear, angular = ([getattr(side, name) * impulses for side in sides] for name in ("linear", "angular"))
    return tuple(Vec3(*(total(list(pair)) for pair in zip(*parts, strict=True))) for parts in (linear, angular))  # type: ignore[return-value]


def impulses(loops: Loops, rates: Array) -> Array:
    """Impulses (row, world) that change the rates of the rows, with the trees held, by these."""
    found = add_scaled(loops.inverse, rates)
    # Where the matrix is all but singular its inverse is large, and so is the round-off.
    return found + add_scaled(loops.inverse, rates - add_scaled(loops.matrix, found))


def respond_to(loops: Loops, motion: tree.Pair) -> tuple[tree.Pair, Array]:
    """Motions (link, 3, world) of trees of which the loops hold as well, and the impulses (row, world) of these."""
    wanted = -rates(loops, *(Vec3(*unstack(part, 1)) for part in motion))
    found = impulses(loops, compute_once(wanted, wanted))
    return jax.tree.map(lambda part, response: part + add_scaled(response, found), motion, loops.responses), found


def share_gaps(found: Layout, gaps: Vec3) -> Vec3:
    """Shifts (link, world) that leave as little as possible of the gaps (closing joint, world): as much at every joint.

    Links that hang on nothing keep their mean place.
    """
    count = len(found.links)
    ends = [(link.parent, place) for place, link in enumerate(found.links) if any(link.slots)]
    ends += [(closing.parent, closing.child) for closing in found.closings]
    incidence = np.zeros((len(ends), count + 1))
    for row, (parent, child) in enumerate(ends):
        incidence[row, child] += 1.0
        incidence[row, parent] -= 1.0
    weights = -np.linalg.pinv(incidence[:, :count])[:, len(ends) - len(found.closings) :]
    return gaps.map(lambda x: jnp.einsum("lc,cw->lw", jnp.asarray(weights, x.dtype), x, precision="highest"))


def gaps(loops: Loops, errors: Array) -> Vec3:
    """Gaps (closing joint, world) along what closing joints hold, from the errors of their rows."""
    joint = np.concatenate([[place] * len(closing.rows) for place, closing in enumerate(loops.layout.closings)])
    along = loops.child.linear * errors
    nothing = jnp.zeros((len(loops.layout.closings), along.x.shape[-1]), along.x.dtype)
    return along.map(lambda x: nothing.at[joint].add(x))
