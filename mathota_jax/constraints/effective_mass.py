"""Effective masses: those of contact points that are solved together, and what derivatives make of any."""

from __future__ import annotations

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.scene import Scene
from mathota_jax.solver.coupling import point_responses
from mathota_jax.solver.laws import Cone
from mathota_jax.solver.row_matrix import Entries
from mathota_jax.spatial.safe import safe_divide, safe_sqrt
from mathota_jax.spatial.settle import compute_once, materialize
from mathota_jax.spatial.spread import add_slices

NORMAL_RELAXATION = 10 / 9
"""Factor on the bounded normal step of three points and more: makes it exact for a cube on its face."""

TANGENT_RELAXATION = 4 / 3
"""Factor on the bounded tangential step of a manifold. Measured: ten boxes stand with 10 sweeps at 4/3 and lean at 1;
against the largest eigenvalue itself, boxes that were dropped creep."""

FIRST_GRIP = 1.3
"""Factor on the tangential steps of contacts that start without an impulse, in manifolds of three points and more. Those
are bounded for the points turning against one another, and take a third of a common slide: a slab pushed by 1 % too much
stuck in its first step, with 1.3 it slips (and a box thrown on a slope begins to slide as on a heightfield of that slope to
1.5 um; 1.35 leaves 10). All contacts may not have it: friction that overshoots while its limit changes was measured to keep
bodies creeping by mm/s. One or two points have a bound that is exact, and would swing."""


def step_length(scene: Scene, found: Any) -> Any:
    """What only decides how far a row steps, with the derivatives that it deserves.

    None where sweeps go on until it moves nothing. A small step consists of four sweeps, whose rows are as soft as they are
    light: of it, the lengths of their steps are a part.

    Args:
      scene: static scene.
      found: pytree of arrays.
    """
    return found if scene.options.solver == "soft_step" else lax.stop_gradient(found)


def meeting(together: int, active: Array, lowest: Array) -> Array:
    """1 for the points (turn, column, world) that meet in this step if nothing holds them, by which steps are measured.

    A box that lands on a corner is held there alone: of its speed ten sweeps were measured to leave 0.3 %, and 13 % in steps
    short enough for four corners. Where no point meets, all do: something else may push them.

    Args:
      together: points in a manifold, neighbouring columns.
      active: 1 for points.
      lowest: separation up to which the points get, less what may pass for touching.
    """
    here = active * jnp.where(lowest <= 0, 1.0, 0.0).astype(active.dtype)
    if together == 1:
        return compute_once(here, active)
    some = here.reshape(here.shape[0], -1, together, here.shape[-1]).max(2)
    return compute_once(jnp.where(jnp.repeat(some, together, axis=1) > 0, here, active), active)


def normal_bound(entries: tuple[Entries, Entries], together: int, active: Array, meets: Array) -> Array:
    """Bound (turn, column, world) of the response of the points of a manifold to normal impulses on all that meet.

    The points of a manifold are solved together, which keeps the symmetry of a stack: solved one after the other they
    tilt it. A step divided by the largest eigenvalue of the matrix of all ``J_i M^-1 J_j^T`` can not overshoot. At most
    three of its eigenvalues are not 0, since two bodies approach at points of one plane in three ways only; so trace and
    Frobenius norm bound the largest one within a third, and exactly for one or two points or where one eigenvalue dominates
    (Wolkowicz and Styan 1980, theorem 2.1). A point alone gets its exact effective mass. Points that meet nothing yet get
    the trace of all: should they be pressed, too, nothing is multiplied by more than -1.
    """
    jacobian, response = entries
    own = compute_once(_largest_eigenvalue(jacobian, response, (0,)), active)
    if together == 1:
        return own
    every, points = (x.reshape(x.shape[0], -1, together, x.shape[-1]) for x in (active, meets))
    squared = _block(entries, together, 0, 0) ** 2 * (points[:, :, :, None] * points[:, :, None])
    norm = add_slices(add_slices(squared, 2), 2)
    own = own.reshape(points.shape)
    trace = add_slices(own * points, 2)
    rank = jnp.clip(add_slices(points, 2), 1.0, 3.0)
    bound = (trace + safe_sqrt(jnp.maximum((rank - 1.0) * (rank * norm - trace * trace), 0.0))) / rank
    bound = bound / jnp.where(rank > 2.0, NORMAL_RELAXATION, 1.0)
    # Repeated after they are stored: XLA turns a division by what is repeated into a product, which it copies.
    bound, whole = (jnp.repeat(compute_once(x, active), together, axis=1) for x in (bound, add_slices(own * every, 2)))
    return jnp.where(meets > 0, bound, whole)


def tangent_bound(entries: tuple[Entries, Entries], together: int, active: Array, meets: Array) -> Array:
    """The same for impulses along the tangents: the sum of the norms of the blocks of a point (Gershgorin), relaxed.

    A step must not overshoot at all here: what a friction impulse may be changes with the normal impulses.
    """
    own = compute_once(_largest_eigenvalue(*entries, (1, 2)), active)
    if together == 1:
        return own
    # All in one kernel is not vectorised, and takes ten times as long.
    blocks = materialize([_block(entries, together, row, column) for row in (1, 2) for column in (1, 2)])
    squared = functools.reduce(jnp.add, [part**2 for part in blocks])
    others = 1.0 - np.eye(together)[:, :, None]
    norms = safe_sqrt(squared) * (others * meets.reshape(meets.shape[0], -1, 1, together, meets.shape[-1]))
    total = functools.reduce(jnp.add, [norms[:, :, :, k].reshape(own.shape) for k in range(together)], own)
    # Of two points that respond to each other by no more than the mean of how they do to themselves.
    count, whole = (_over_points(x, together) for x in (active, own * active))
    apart = own + (count * own + whole) / 2
    return jnp.where(meets > 0, *(compute_once(x / TANGENT_RELAXATION, active) for x in (total, apart)))


def first_grip(together: int, meets: Array, slow: Array) -> Array | None:
    """`FIRST_GRIP` (turn, column, world) where it applies, else 1; None where it never does.

    `slow` is 1 for contacts that hardly approach: among others, which may hit anything at any speed, friction that
    overshoots was measured to gain up to half of a world's energy.
    """
    if together < 3:
        return None
    many = jnp.where(_over_points(meets, together) > 2.0, 1.0, 0.0).astype(meets.dtype)
    return 1.0 + (FIRST_GRIP - 1.0) * many * slow


def sliding_step(
    entries: tuple[Entries, Entries], together: int, meets: Array, law: Cone, approach: Array, slip: Array
) -> Array:
    """Factor (turn, column, world) on the normal steps of points that slide: friction that follows them turns the body, too.

    Without it, over-relaxed steps of a cube that slides on its edge with friction 0.8 swing. For one or two points, which
    carry the load alone; of four, friction turns some up and others down.

    Args:
      approach: (turn, column, world) speed that the normals have to stop.
      slip: (turn, row, column, world) velocities along the tangents.
    """
    jacobian, response = entries
    own, *coupling = (_response(jacobian, response, 0, column) for column in range(3))
    slip = compute_once(slip, meets)  # else all is in one kernel, which is not vectorised
    pull = [-part * law.tangent_mass for part in (slip[:, 0], slip[:, 1])]
    size = safe_sqrt(pull[0] * pull[0] + pull[1] * pull[1])
    along = law.friction * safe_divide(pull[0] * coupling[0] + pull[1] * coupling[1], size)
    factor = safe_divide(own, own + jnp.maximum(along, 0.0))
    slides = size > law.friction * law.normal_mass * approach
    if together > 2:
        slides &= _over_points(meets, together) < 2.5
    return compute_once(jnp.where(slides & (meets > 0), factor, 1.0), meets)


def _block(entries: tuple[Entries, Entries], together: int, row: int, column: int) -> Array:
    """``J_i M^-1 J_j^T`` (turn, manifold, point i, point j, world) of `row` at i to `column` at j."""
    jacobian, response = entries
    return point_responses([side[row] for side in jacobian], [side[column] for side in response], together)


def _largest_eigenvalue(jacobian: Entries, response: Entries, rows: tuple[int, ...]) -> Array:
    """Of the response of one point along one or two rows; the arguments hold components by side and row."""
    pairs = [(rows[0], rows[0]), (rows[-1], rows[-1]), (rows[0], rows[-1])]
    first, second, coupling = (_response(jacobian, response, *pair) for pair in pairs)
    if len(rows) == 1:
        return first
    half_difference = (first - second) / 2
    return (first + second) / 2 + safe_sqrt(half_difference * half_difference + coupling * coupling)


def _over_points(values: Array, together: int) -> Array:
    """Sum over the points of a manifold (turn, column, world), for each of them."""
    return jnp.repeat(add_slices(values.reshape(values.shape[0], -1, together, values.shape[-1]), 2), together, axis=1)


def _response(jacobian: Entries, response: Entries, row: int, column: int) -> Array:
    """Of a point along a row to its own impulse along another."""
    terms = [a * b for j, r in zip(jacobian, response, strict=True) for a, b in zip(j[row], r[column], strict=True)]
    return functools.reduce(jnp.add, terms)
