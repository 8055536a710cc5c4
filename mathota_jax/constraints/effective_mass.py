"""Effective masses: those of contact points that are solved together, and what derivatives make of any."""

from __future__ import annotations

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mathota_jax.scene import Scene
from mathota_jax.solver.coupling import point_responses
from mathota_jax.solver.row_matrix import Entries
from mathota_jax.spatial.safe import safe_sqrt
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

    None where sweeps go on until it moves nothing. A small step consists of two sweeps, whose rows are as soft as they are
    light: of it, the lengths of their steps are a part.

    Args:
      scene: static scene.
      found: pytree of arrays.
    """
    return found if scene.options.solver == "soft_step" else lax.stop_gradient(found)


def normal_bound(entries: tuple[Entries, Entries], together: int, active: Array) -> Array:
    """Bound (turn, column, world) of the response of the points of a manifold to normal impulses on all of them.

    The points of a manifold are solved together, which keeps the symmetry of a stack: solved one after the other they
    tilt it. A step divided by the largest eigenvalue of the matrix of all ``J_i M^-1 J_j^T`` can not overshoot. At most
    three of its eigenvalues are not 0, since two bodies approach at points of one plane in three ways only; so trace and
    Frobenius norm bound the largest one within a third, and exactly for one or two points or where one eigenvalue dominates
    (Wolkowicz and Styan 1980, theorem 2.1). A point alone gets its exact effective mass.
    """
    jacobian, response = entries
    own = _largest_eigenvalue(jacobian, response, (0,))
    if together == 1:
        return compute_once(own, active)
    points = active.reshape(active.shape[0], -1, together, active.shape[-1])
    squared = _block(entries, together, 0, 0) ** 2 * (points[:, :, :, None] * points[:, :, None])
    norm = add_slices(add_slices(squared, 2), 2)
    trace = add_slices(own.reshape(points.shape) * points, 2)
    rank = jnp.clip(add_slices(points, 2), 1.0, 3.0)
    bound = (trace + safe_sqrt(jnp.maximum((rank - 1.0) * (rank * norm - trace * trace), 0.0))) / rank
    bound = bound / jnp.where(rank > 2.0, NORMAL_RELAXATION, 1.0)
    # Repeated after it is stored: XLA turns a division by what is repeated into a product, which it copies.
    return jnp.repeat(compute_once(bound, active), together, axis=1)


def tangent_bound(entries: tuple[Entries, Entries], together: int, active: Array) -> Array:
    """The same for impulses along the tangents: the sum of the norms of the blocks of a point (Gershgorin), relaxed.

    A step must not overshoot at all here: what a friction impulse may be changes with the normal impulses.
    """
    own = _largest_eigenvalue(*entries, (1, 2))
    if together == 1:
        return compute_once(own, active)
    # All in one kernel is not vectorised, and takes ten times as long.
    blocks = materialize([_block(entries, together, row, column) for row in (1, 2) for column in (1, 2)])
    squared = functools.reduce(jnp.add, [part**2 for part in blocks])
    others = 1.0 - np.eye(together)[:, :, None]
    norms = safe_sqrt(squared) * (others * active.reshape(active.shape[0], -1, 1, together, active.shape[-1]))
    total = functools.reduce(jnp.add, [norms[:, :, :, k].reshape(own.shape) for k in range(together)], own)
    return compute_once(total / TANGENT_RELAXATION, active)


def first_grip(together: int, active: Array, slow: Array) -> Array | None:
    """`FIRST_GRIP` (turn, column, world) where it applies, else 1; None where it never does.

    `slow` is 1 for contacts that hardly approach: among others, which may hit anything at any speed, friction that
    overshoots was measured to gain up to half of a world's energy.
    """
    if together < 3:
        return None
    count = add_slices(active.reshape(active.shape[0], -1, together, active.shape[-1]), 2)
    many = jnp.repeat(jnp.where(count > 2.0, 1.0, 0.0).astype(active.dtype), together, axis=1)
    return 1.0 + (FIRST_GRIP - 1.0) * many * slow


def _block(entries: tuple[Entries, Entries], together: int, row: int, column: int) -> Array:
    """``J_i M^-1 J_j^T`` (turn, manifold, point i, point j, world) of `row` at i to `column` at j."""
    jacobian, response = entries
    return point_responses([side[row] for side in jacobian], [side[column] for side in response], together)


def _largest_eigenvalue(jacobian: Entries, response: Entries, rows: tuple[int, ...]) -> Array:
    """Of the response of one point along one or two rows; the arguments hold components by side and row."""

    def entry(row: int, column: int) -> Array:
        terms = [a * b for j, r in zip(jacobian, response, strict=True) for a, b in zip(j[row], r[column], strict=True)]
        return functools.reduce(jnp.add, terms)

    if len(rows) == 1:
        return entry(rows[0], rows[0])
    first, second, coupling = entry(rows[0], rows[0]), entry(rows[1], rows[1]), entry(rows[0], rows[1])
    half_difference = (first - second) / 2
    return (first + second) / 2 + safe_sqrt(half_difference * half_difference + coupling * coupling)
