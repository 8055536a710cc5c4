"""From the pieces that the search found to exact, differentiable distances, normals and witness points.

The separation is the maximum over unit directions n of ``min_i s_i(n)``, where ``s_i(n) = n . w_i(n)`` belongs to a piece
pair and is smooth. At the solution up to three piece pairs tie. With three, n is the normal of the triangle they span (a
face with a vertex, two crossed edges, the side of a cylinder with an edge ...): well conditioned at touch, where the
difference vector vanishes. With two, n is perpendicular to their difference and stationary along the circle that leaves
free; with one, stationary in both tangent directions. The stationarity is solved by Newton's method with the curvature of
the rims; shapes without rims need a single step.

The last step is taken differentiably from the undifferentiated solution: by the implicit function theorem it gives the
derivative of n, hence those of witness points, and second derivatives of the separation (envelope theorem).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from mathota_jax.collision.convex.difference import Difference, Weights, barycentric, code_of, combine
from mathota_jax.collision.convex.gjk import Simplex
from mathota_jax.collision.convex.support import SUPPORT
from mathota_jax.collision.convex.ties import Ties, distinct, join, leave, single
from mathota_jax.spatial.safe import safe_divide
from mathota_jax.spatial.settle import compute_once, settle_code
from mathota_jax.spatial.vector import Vec3, cross, dot, norm, tangent_basis, where

STEPS = 12
"""Most Newton steps; all lanes stop as soon as they have converged."""
LONGEST_STEP = 0.5
"""Newton steps turn the normal by at most this angle [rad]; a longer one means that the pieces are not the right ones."""
ROUNDING = 16.0
"""Separations that differ by fewer round-offs of the size are equal."""
ASIDE = 1e-7
"""Closest points this far [size] beside the normal do not lie along it; in float32 some round-offs more."""
ASCENT = 0.2
"""Where the separation of the tied pieces has no maximum nearby, the normal turns by this angle [rad] the way it grows,
until another piece undercuts them."""
TIED = 64.0
"""Points whose heights over a flat end differ by fewer units of `ROUNDING` lie on a face that is parallel to it."""
STIFFNESS_ROUNDING = 64.0
"""A stiffness below this many round-offs leaves the normal where it is."""


class Closest(NamedTuple):
    """Unit normal from A to B and the closest points of the cores, in the frame of A, in units of the scale.

    `consistent`: no other piece undercuts the tied ones. `inside`: the points are known to belong to their cores, but for
    `excess` [size]. `reach`: true separation along the normal, a lower bound, not differentiated.
    """

    normal: Vec3
    point_a: Vec3
    point_b: Vec3
    ties: Ties
    consistent: Array
    inside: Array
    excess: Array
    reach: Array


class Solution(NamedTuple):
    """Unit normal from A to B of the largest separation seen [size], and the pieces tied there.

    `exact`: no other piece undercuts them.
    """

    normal: Vec3
    separation: Array
    ties: Ties
    exact: Array


class _Search(NamedTuple):
    turn: Array
    normal: Vec3
    ties: Ties
    best: Solution
    left: Array
    done: Array


def polish(shapes: Difference, simplex: Simplex, solution: Solution) -> Closest:
    """Exact closest points from what `solve` found for the closest simplex. Differentiable in the shapes."""
    simplex, solution = lax.stop_gradient((simplex, solution))
    rounding = rounding_of(shapes)
    ties = solution.ties
    normal = compute_once(_implicit_normal(shapes, solution.normal, ties, solution.exact), solution.separation)
    points = _tied_points(shapes, ties, normal)
    weights = compute_once(barycentric(_differences(points), ties.two, ties.three), solution.separation)
    lowest = lax.stop_gradient(jnp.minimum(weights[0], jnp.minimum(weights[1], weights[2])))
    point_a, point_b = (combine(weights, list(of_shape)) for of_shape in zip(*points, strict=True))
    if _curved(shapes):
        # Around the axis of a rim its points turn faster than a Newton step knows: what the search found is close enough.
        lost = ~solution.exact & (solution.separation > 0)
        searched_a, searched_b = _searched_points(shapes, simplex)
        point_a, point_b = where(lost, searched_a, point_a), where(lost, searched_b, point_b)
        point_a, point_b = compute_once((point_a, point_b), solution.separation)
        # A rim seen almost along its axis turns the round-off of the normal into a hundred times that along the rim.
        middle, half_gap = (point_a + point_b) * 0.5, normal * (0.5 * dot(normal, point_b - point_a))
        point_a, point_b = middle - half_gap, middle + half_gap
    result = Closest(
        normal,
        point_a,
        point_b,
        ties,
        solution.exact,
        lowest >= -rounding,
        jnp.zeros_like(solution.separation),
        solution.separation,
    )
    for of_b, kind in enumerate((shapes.kind_a, shapes.kind_b)):
        if SUPPORT[kind].rim_radius is not None:
            result = _flat_end(shapes, simplex, result, bool(of_b), rounding)
    return result


def _searched_points(shapes: Difference, simplex: Simplex) -> tuple[Vec3, Vec3]:
    """Closest points that the search found, each carried along by its shape."""
    assert simplex.point_a is not None
    assert simplex.point_b is not None
    frozen = lax.stop_gradient(shapes)
    local = frozen.rotation.apply_transposed(simplex.point_b - frozen.position)
    return simplex.point_a, shapes.position + shapes.rotation.apply(local)


@jax.custom_jvp
def _implicit_normal(shapes: Difference, start: Vec3, ties: Ties, exact: Array) -> Vec3:
    """The solution `start` with the derivative of a Newton step from it where it is exact, and none elsewhere.

    The value of the step is round-off, which a soft contact would amplify; it is not computed where no derivative is.
    """
    return start


@_implicit_normal.defjvp
def _implicit_normal_jvp(primals: tuple, tangents: tuple) -> tuple[Vec3, Vec3]:
    shapes, start, ties, exact = primals

    def step(shapes: Difference) -> Vec3:
        return newton_step(shapes, ties, start, _differences(_tied_points(shapes, ties, start)))

    _, change = jax.jvp(step, (shapes,), (tangents[0],))
    none = change.map(jnp.zeros_like)
    return _implicit_normal(shapes, start, ties, exact), where(exact, change, none)


def solve(shapes: Difference, simplex: Simplex, wanted: Array) -> Solution:
    """Tied pieces and normal of the solution of shapes of which one has a rim, by Newton's method with an active set.

    The true separation along any direction is a lower bound of the separation: the best direction seen is kept, and a
    piece that undercuts the tied ones joins them.

    Args:
        shapes: The shapes, not differentiated.
        simplex: The closest simplex that the search found.
        wanted: bool, False where the result is not needed: those lanes stop at once.
    """
    rounding = rounding_of(shapes)

    def advance(state: _Search) -> _Search:
        points = stacked_differences(shapes, state.ties, state.normal)
        normal = compute_once(newton_step(shapes, state.ties, state.normal, points), state.best.separation)
        points = stacked_differences(shapes, state.ties, normal)
        extreme, pieces = compute_once(shapes.least(normal), state.best.separation)
        reach = dot(normal, extreme)
        turned = normal - state.normal
        weights = compute_once(barycentric(points, state.ties.two, state.ties.three), state.best.separation)
        # Where a piece pair has left, what remains must have its closest point along the normal.
        across = combine(weights, points)
        across = across - normal * dot(normal, across)
        sound = ~state.left | (dot(across, across) <= max(8.0 * rounding, ASIDE) ** 2)
        best, exact = better(
            state.best,
            Solution(normal, reach, state.ties, dot(normal, points[0]) <= reach + 4.0 * rounding),
            sound,
            state.done,
            rounding,
        )
        still = dot(turned, turned) <= rounding * rounding
        shares = barycentric([point - extreme for point in points], state.ties.two, state.ties.three)
        ties = join(state.ties, pieces, weights, shares, ~exact)
        ties, leaves = leave(ties, weights, rounding, exact)
        done = state.done | (exact & still & ~leaves)
        return _Search(state.turn + 1, normal, ties, best, state.left | leaves, done)

    first = Solution(simplex.direction, simplex.reach, single(simplex.extreme_pieces), wanted & ~wanted)
    state = _Search(
        jnp.zeros((), jnp.int32), simplex.direction, distinct(simplex.pieces), first, wanted & ~wanted, ~wanted
    )
    return lax.while_loop(lambda s: (s.turn < STEPS) & ~jnp.all(s.done), advance, state).best


def better(best: Solution, here: Solution, sound: Array | bool, done: Array, rounding: float) -> tuple[Solution, Array]:
    """The better of two solutions, and whether the second is exact, both settled; the first and no where `done`.

    Near the solution the separation is flat: the latest exact normal is the best, to more than half the digits.
    """
    reach = here.separation
    code = (reach > best.separation).astype(reach.dtype) + 2.0 * (reach > best.separation - rounding)
    code = settle_code(jnp.where(done, 0.0, code + 4.0 * here.exact + 8.0 * sound))
    exact = (code & 4) == 4
    replaces = (code & 14 == 14) | ((code & 1 == 1) & ~best.exact)
    return jax.tree.map(lambda new, old: jnp.where(replaces, new, old), here._replace(exact=exact), best), exact


def _curved(shapes: Difference) -> bool:
    """Whether one of the shapes has a rim."""
    return any(SUPPORT[kind].rim_radius is not None for kind in (shapes.kind_a, shapes.kind_b))


def rounding_of(shapes: Difference) -> float:
    """Separations [size] that differ by less are equal."""
    return ROUNDING * float(jnp.finfo(shapes.position.x.dtype).eps)


def _reach(shapes: Difference, direction: Vec3) -> Array:
    """True separation along a unit direction."""
    return dot(direction, shapes.least(direction)[0])


def _rim_tangent(direction: Vec3) -> tuple[Vec3, Array]:
    """Unit tangent of circles about the y axis at their extreme point along a direction, and 1 / |direction in plane|."""
    zero = jnp.zeros_like(direction.x)
    inverse = safe_divide(jnp.ones_like(zero), norm(Vec3(direction.x, zero, direction.z)))
    return Vec3(-direction.z * inverse, zero, direction.x * inverse), inverse


def rim_radii(shapes: Difference, ties: Ties, weights: Weights) -> list[tuple[bool, Array]]:
    """Average radius of the rims of the tied pieces, of each shape that has rims: is it B, radius [size]."""
    result = []
    for of_b, kind, shape in ((False, shapes.kind_a, shapes.a), (True, shapes.kind_b, shapes.b)):
        rim_radius = SUPPORT[kind].rim_radius
        if rim_radius is not None:
            codes = [code_of(pieces, of_b=of_b) for pieces in ties.pieces]
            mean = sum(
                (w * rim_radius(shape, c) for w, c in zip(weights, codes, strict=True)), jnp.zeros_like(weights[0])
            )
            result.append((of_b, mean))
    return result


def _curvatures(shapes: Difference, ties: Ties, weights: Weights, normal: Vec3) -> list[tuple[Vec3, Array]]:
    """Minus the Hessian of the tied separations, as a sum of ``curvature * tangent tangent^T``."""
    result = []
    for of_b, radius in rim_radii(shapes, ties, weights):
        tangent, inverse = _rim_tangent(shapes.rotation.apply_transposed(normal) if of_b else normal)
        result.append((shapes.rotation.apply(tangent) if of_b else tangent, radius * inverse))
    return result


def _tied_points(shapes: Difference, ties: Ties, normal: Vec3) -> list[tuple[Vec3, Vec3]]:
    """Points of A and of B of the tied piece pairs along a normal, each looked up once."""
    return [compute_once(shapes.points(pieces, normal), normal.x) for pieces in ties.pieces]


def stacked_differences(shapes: Difference, ties: Ties, normal: Vec3) -> list[Vec3]:
    """Difference points of the ties, looked up side by side: compiled three times faster, but not made for derivatives."""
    count = len(ties.pieces)
    along = normal.map(lambda c: jnp.broadcast_to(c, (count, *c.shape)))
    points = compute_once(shapes.point(jnp.stack(ties.pieces), along), normal.x)
    return [points.map(lambda c, k=k: c[k]) for k in range(count)]


def _differences(points: list[tuple[Vec3, Vec3]]) -> list[Vec3]:
    return [b - a for a, b in points]


def newton_step(shapes: Difference, ties: Ties, normal: Vec3, points: list[Vec3]) -> Vec3:
    """One Newton step for the normal, from the difference points of the ties along it."""
    eps = float(jnp.finfo(normal.x.dtype).eps)
    weights = barycentric(points, ties.two, ties.three)
    middle = combine(weights, points)
    curvatures = _curvatures(shapes, ties, weights, normal)
    # Stored: each case has its own kernels, and they need all of it.
    middle, curvatures, separation = compute_once((middle, curvatures, dot(normal, middle)), normal.x)

    # Three ties: the normal of their triangle.
    edge, other = points[1] - points[0], points[2] - points[0]
    face = cross(edge, other)
    squared = dot(face, face)
    usable = ties.three & (squared > 0)
    face = face * (lax.rsqrt(jnp.where(usable, squared, 1.0)) * jnp.where(dot(face, normal) < 0, -1.0, 1.0))

    # Two ties: perpendicular to the edge, stationary along the tangent.
    inverse = safe_divide(jnp.ones_like(separation), norm(edge))
    along = edge * inverse
    tangent = cross(normal, along)
    alpha = -dot(normal, along)
    stiffness = separation + sum(k * dot(t, tangent) ** 2 for t, k in curvatures)
    coupling = sum(k * dot(t, tangent) * dot(t, along) for t, k in curvatures)
    force = dot(tangent, middle) - coupling * alpha
    firm = ties.two & (stiffness > STIFFNESS_ROUNDING * eps)
    beta = jnp.where(firm, force / jnp.where(firm, stiffness, 1.0), 0.0)
    firm &= jnp.abs(beta) < LONGEST_STEP
    line = along * alpha + tangent * jnp.where(firm, beta, _climb(force, stiffness))

    # One: stationary in both tangent directions.
    basis = tangent_basis(normal)
    force_1, force_2 = dot(basis[0], middle), dot(basis[1], middle)
    k11 = separation + sum(k * dot(t, basis[0]) ** 2 for t, k in curvatures)
    k22 = separation + sum(k * dot(t, basis[1]) ** 2 for t, k in curvatures)
    k12 = sum((k * dot(t, basis[0]) * dot(t, basis[1]) for t, k in curvatures), jnp.zeros_like(separation))
    determinant = k11 * k22 - k12 * k12
    scale = jnp.abs(k11) + jnp.abs(k22)
    firm = determinant > STIFFNESS_ROUNDING * eps * jnp.maximum(scale, STIFFNESS_ROUNDING * eps) * scale
    firm &= scale == k11 + k22
    inverse = jnp.where(firm, 1.0 / jnp.where(firm, determinant, 1.0), 0.0)
    change_1, change_2 = (k22 * force_1 - k12 * force_2) * inverse, (k11 * force_2 - k12 * force_1) * inverse
    firm &= change_1 * change_1 + change_2 * change_2 < LONGEST_STEP**2
    climb_1, climb_2 = _climb_in_plane(force_1, force_2, k11, k12, k22)
    spot = basis[0] * jnp.where(firm, change_1, climb_1) + basis[1] * jnp.where(firm, change_2, climb_2)

    moved = where(usable, face, normal + where(ties.two, line, spot))
    return moved * lax.rsqrt(dot(moved, moved))


def _climb(force: Array, stiffness: Array) -> Array:
    """Bounded Newton step towards a maximum, or uphill where the function of the angle has none. No derivative."""
    force, stiffness = lax.stop_gradient((force, stiffness))
    eps = float(jnp.finfo(force.dtype).eps)
    reachable = stiffness * ASCENT > jnp.abs(force)
    uphill = jnp.where(jnp.abs(force) > ROUNDING * eps, jnp.sign(force) * ASCENT, 0.0)
    return jnp.where(reachable, force / jnp.where(reachable, stiffness, 1.0), uphill)


def _climb_in_plane(force_1: Array, force_2: Array, k11: Array, k12: Array, k22: Array) -> tuple[Array, Array]:
    """`_climb` along both eigenvectors of a stiffness."""
    force_1, force_2, k11, k12, k22 = lax.stop_gradient((force_1, force_2, k11, k12, k22))
    half = 0.5 * (k11 - k22)
    spread = jnp.sqrt(half * half + k12 * k12)
    # Of twice the angle of the stiffer one.
    cosine = jnp.where(spread > 0, half / jnp.where(spread > 0, spread, 1.0), 1.0)
    x = jnp.sqrt(jnp.maximum(0.5 + 0.5 * cosine, 0.0))
    y = jnp.sqrt(jnp.maximum(0.5 - 0.5 * cosine, 0.0)) * jnp.where(k12 < 0, -1.0, 1.0)
    middle = 0.5 * (k11 + k22)
    stiff = _climb(x * force_1 + y * force_2, middle + spread)
    soft = _climb(x * force_2 - y * force_1, middle - spread)
    return x * stiff - y * soft, y * stiff + x * soft


def _flat_end(shapes: Difference, simplex: Simplex, result: Closest, of_b: bool, rounding: float) -> Closest:
    """Contact with the flat end of a cylinder or cone, where its axis separates best: the end's normal is exact.

    The other body's point is its extreme one. Where the search's point is extreme too (parallel faces) it is taken,
    carried along by the body: it lies over the end.
    """
    frozen, best = lax.stop_gradient(shapes), result.reach
    axis = shapes.rotation.column_y if of_b else Vec3(*(jnp.full_like(best, c) for c in (0.0, 1.0, 0.0)))
    upward = settle_code((dot(lax.stop_gradient(axis), simplex.direction) >= 0).astype(best.dtype)) == 1
    normal = axis * jnp.where(upward, 1.0, -1.0)
    along = _reach(frozen, lax.stop_gradient(normal))
    # Off the axis the separation falls with the angle itself, so a near tie means that the end is flat on something.
    # Half the round-off: two evaluations of the same separation were seen to differ by three epsilons.
    level = along >= best - rounding / 2.0

    pieces = frozen.pieces(lax.stop_gradient(normal))
    point_a, point_b = compute_once(shapes.points(pieces, normal), best)
    other, searched = (point_a, simplex.point_a) if of_b else (point_b, simplex.point_b)
    assert searched is not None
    offset = searched - lax.stop_gradient(other)
    # Closer by, points of a curved rim are as extreme; the search knows them less well than their formula does.
    tied = jnp.abs(dot(lax.stop_gradient(normal), offset)) <= TIED * rounding
    tied &= dot(offset, offset) > 4.0 * TIED * rounding
    offset = offset * jnp.where(tied, 1.0, 0.0)
    # What the search found lies in its shape, but further from the end than the extreme point.
    excess = jnp.abs(dot(lax.stop_gradient(normal), offset))
    if not of_b:  # carried along by B; A is at rest in its own frame
        offset = shapes.rotation.apply(lax.stop_gradient(shapes.rotation).apply_transposed(offset))
    other = other + offset
    # A point just beyond the rim is as far from the end as from the rim, to round-off; but the end does not reach so far.
    beside = lax.stop_gradient(shapes.rotation.apply_transposed(other - shapes.position) if of_b else other)
    rim_radius = SUPPORT[shapes.kind_b if of_b else shapes.kind_a].rim_radius
    assert rim_radius is not None
    radius = rim_radius(frozen.b if of_b else frozen.a, code_of(pieces, of_b=of_b))
    over = beside.x * beside.x + beside.z * beside.z <= (radius + 4.0 * rounding) ** 2
    chosen = settle_code((level & over).astype(best.dtype)) == 1
    gap = dot(normal, point_b - point_a)
    point_a, point_b = (other, other + normal * gap) if of_b else (other - normal * gap, other)
    return Closest(
        where(chosen, normal, result.normal),
        where(chosen, point_a, result.point_a),
        where(chosen, point_b, result.point_b),
        jax.tree.map(lambda new, old: jnp.where(chosen, new, old), single(pieces), result.ties),
        chosen | result.consistent,
        chosen | result.inside,
        jnp.where(chosen, lax.stop_gradient(excess), result.excess),
        jnp.where(chosen, along, best),
    )
